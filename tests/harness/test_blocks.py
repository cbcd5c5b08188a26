"""Blocks of runs: the same rows however runs are put into blocks, and whatever becomes of the blocks."""

import contextlib
import itertools
import json
import math
import pickle
import time
from concurrent.futures import (
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pandas as pd
import pytest

from kit.command import judged
from kit.nightly import some
from servobench.harness.batch import blocks, isolation, results, store
from servobench.harness.batch.blocks import (
    Block,
    Job,
    carry_out_blocks,
    cut,
    even_size,
    open_workers,
)
from servobench.harness.batch.campaign import Campaign, Execution, carry_out
from servobench.harness.batch.isolation import Answer, End, Task, Workers
from servobench.harness.batch.plan import Batch, Cell, Grid, SweepPlan, survey
from servobench.harness.batch.processes import Bounds
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import identity, run_experiment
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.result import Ending, RunResult
from servobench.plant.contract.faults import ConfigurationError

PLAN = SweepPlan.parse(
    Batch(("kinematic",), ("constant", "broyden"), ("random",), ("moderate",), range(6)),
    ("camera_rotation=0:40:40deg",),
)
CAMPAIGN = Campaign(PLAN.cells(), Settings({"random": {"duration": 0.5}}))
SEED_OF_A_CRASH = 2


def times(runs: pd.DataFrame) -> pd.DataFrame:
    return runs[["controller_time_median_us", "controller_time_p99_us", "plant_time_median_us"]]


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> pd.DataFrame:
    """The table of runs that were carried out one by one."""
    folder = tmp_path_factory.mktemp("alone") / "out"
    carry_out(CAMPAIGN, folder, Execution(1, block=1))
    assert ResultsFolder(folder).manifest["side_by_side"] == {}
    runs = results.load_runs(folder)
    assert times(runs).notna().all(axis=None)
    return judged(runs)


class Here(Executor):
    """An executor with `submit` only, which carries everything out at once; all goes as to another machine and back."""

    def submit(self, function, /, *arguments, **named):
        future = Future()
        function, arguments, named = pickle.loads(pickle.dumps((function, arguments, named)))
        future.set_result(pickle.loads(pickle.dumps(function(*arguments, **named))))
        return future


def processes():
    return ProcessPoolExecutor(2, get_context("spawn"))


@pytest.mark.parametrize("make", some((Here, processes), Here))
def test_any_executor_gives_the_rows_of_this_process(alone, tmp_path, make):
    with make() as executor:
        carry_out(CAMPAIGN, tmp_path / "out", Execution(2, executor, block=7))
    pd.testing.assert_frame_equal(
        judged(results.load_runs(tmp_path / "out")), alone, check_exact=True
    )


def test_an_executor_of_threads_or_with_limits_of_runs_is_refused(tmp_path):
    with (
        ThreadPoolExecutor(1) as threads,
        pytest.raises(ConfigurationError, match="an executor must have processes"),
    ):
        carry_out(CAMPAIGN, tmp_path / "out", Execution(1, threads))
    with pytest.raises(
        ConfigurationError, match="limits of time and memory are for processes of this machine"
    ):
        carry_out(CAMPAIGN, tmp_path / "out", Execution(1, Here(), Bounds(5.0)))


class Ended(Executor):
    """An executor whose workers have ended."""

    def __init__(self, error):
        self.error = error

    def submit(self, function, /, *arguments, **named):
        future = Future()
        future.set_exception(self.error)
        return future


@pytest.mark.parametrize(
    ("error", "why"),
    [(BrokenProcessPool("a process died."), "a process died"), (CancelledError(), "no scheduler")],
)
def test_an_executor_whose_workers_end_is_one_line_that_says_how_to_go_on(tmp_path, error, why):
    line = f"^the workers ended: {why}.*; finished runs are kept, and the same call with out and resume=True carries"
    with pytest.raises(ConfigurationError, match=line):
        carry_out(CAMPAIGN, tmp_path / "out", Execution(1, Ended(error)))
    carry_out(CAMPAIGN, tmp_path / "out", Execution(1, resume=True))


def test_an_executor_that_says_how_many_workers_it_has_gets_work_for_all():
    with ProcessPoolExecutor(3) as executor, open_workers(1, executor) as workers:
        assert workers.count == 3


def test_an_executor_that_has_or_tells_no_workers_gets_work_for_the_number_given():
    silent = Here()
    silent._max_workers = None
    distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")
    adaptive = distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=":0")
    with adaptive, distributed.Client(adaptive) as client:
        for executor in (silent, client.get_executor()):
            with open_workers(2, executor) as workers:
                assert workers.count == 2


def _say_twice(_argument, tell):
    tell(time.monotonic())
    time.sleep(0.05)
    tell(time.monotonic())


def test_threads_of_a_worker_of_an_executor_take_turns():
    task = Task(_say_twice, pickle.dumps(None))
    with ThreadPoolExecutor(3) as threads:
        spans = sorted(json.loads(each) for each in threads.map(blocks._gather, [task] * 3))
    assert all(end <= begin for (_, end), (begin, _) in itertools.pairwise(spans))


@pytest.mark.parametrize(("block", "workers"), [(7, 1), (1000, 1), (1000, 2)])
def test_rows_do_not_depend_on_the_blocks_and_those_of_a_block_have_no_times(
    alone, tmp_path, block, workers
):
    carry_out(CAMPAIGN, tmp_path / "out", Execution(workers, block=block))
    runs = results.load_runs(tmp_path / "out")
    pd.testing.assert_frame_equal(judged(runs), alone, check_exact=True)
    assert times(runs).isna().all(axis=None)
    assert set(times(runs).dtypes) == {np.dtype(float)}
    manifest = ResultsFolder(tmp_path / "out").manifest
    assert manifest["side_by_side"] == {"kinematic": ["constant", "broyden"]}
    assert manifest["seeds"] == "0:6"


def test_runs_that_are_missing_may_form_other_blocks(alone, tmp_path):
    folder = tmp_path / "out"
    carry_out(CAMPAIGN, folder, Execution(1, block=5))
    rows = results.load_runs(folder).to_dict("records")
    (folder / results.RUNS).unlink()
    (folder / results.PARTS).mkdir()
    store.write_part(folder, 3, [RunResult(row, None) for row in rows[3:8]])
    carry_out(CAMPAIGN, folder, Execution(1, block=4, resume=True))
    pd.testing.assert_frame_equal(judged(results.load_runs(folder)), alone, check_exact=True)


def test_where_runs_cannot_advance_together_each_is_carried_out_by_itself(
    alone, tmp_path, monkeypatch
):
    def leave(_runs, *, keep):
        raise SystemExit(keep)

    monkeypatch.setattr("servobench.harness.run.episode.carry_out_together", leave)
    carry_out(CAMPAIGN, tmp_path / "out", Execution(1))
    runs = results.load_runs(tmp_path / "out")
    pd.testing.assert_frame_equal(judged(runs), alone, check_exact=True)
    assert times(runs).notna().all(axis=None)


class ProcessDied(Exception):
    """What the future of a cluster raises."""


class Struck(Exception):
    """Ends a task in the middle of a run."""


def dying_workers(how: Exception | End, sizes: list[int], *, guard: bool = False) -> Workers:
    """Return workers that lose each task at the run of one seed, and note how many runs tasks have.

    Where the guard is lost, the last answer is lost with it.
    """

    def submit(task):
        block = blocks.pickle.loads(blocks.pickle.loads(task.argument)[1])[0]
        sizes.append(len(block.jobs))
        items, future = [], Future()
        strikes = [job.cell.request.seed == SEED_OF_A_CRASH for job in block.jobs]

        def tell(item):
            if item is not None:
                items.append(item)
            if strikes[len(items)]:
                raise Struck

        if not any(strikes):
            task.carry_out(lambda item: item is None or items.append(item))
            future.set_result(Answer(items))
        elif isinstance(how, Exception):
            future.set_exception(how)
        else:
            if not block.together:
                with contextlib.suppress(Struck):
                    task.carry_out(tell)
            future.set_result(Answer(items[:-1] if guard else items, how))
        return future

    return Workers(submit, 2, lost=(ProcessDied,))


@pytest.mark.parametrize(
    ("how", "end"),
    [
        (ProcessDied(), ("crashed", "the run killed the process that carried it out")),
        (End(Ending("timed_out", "it took long"), certain=True), ("timed_out", "it took long")),
        (
            End(Ending("out_of_memory", "it held much"), certain=False),
            ("out_of_memory", "it held much"),
        ),
    ],
)
def test_a_block_that_is_lost_costs_only_the_run_that_did_it(
    alone, tmp_path, monkeypatch, how, end
):
    sizes: list[int] = []
    workers = contextlib.nullcontext(dying_workers(how, sizes))
    monkeypatch.setattr("servobench.harness.batch.campaign.open_workers", lambda *_, **__: workers)
    carry_out(CAMPAIGN, tmp_path / "out", Execution(2))
    runs = results.load_runs(tmp_path / "out")
    lost = runs["seed"] == SEED_OF_A_CRASH
    assert sizes.count(6) == 4
    assert sizes.count(1) == (24 if isinstance(how, End) and how.certain else 28)
    assert set(zip(runs["status"][lost], runs["reason"][lost], strict=True)) == {end}
    pd.testing.assert_frame_equal(judged(runs)[~lost], alone[~lost], check_exact=True)
    assert times(runs)[~lost].notna().all(axis=None)


@pytest.mark.parametrize(
    ("certain", "guard", "again"), [(True, False, 0), (False, False, 8), (False, True, 8)]
)
def test_of_runs_that_go_one_by_one_no_other_is_blamed_and_few_are_carried_out_again(
    alone, tmp_path, monkeypatch, certain, guard, again
):
    sizes: list[int] = []
    workers = contextlib.nullcontext(
        dying_workers(End(Ending("crashed", "it died"), certain), sizes, guard=guard)
    )
    monkeypatch.setattr("servobench.harness.batch.campaign.open_workers", lambda *_, **__: workers)
    carry_out(CAMPAIGN, tmp_path / "out", Execution(2, block=1))
    runs = results.load_runs(tmp_path / "out")
    lost = runs["seed"] == SEED_OF_A_CRASH
    assert lost.sum() == 4
    assert set(runs["reason"][lost]) == {"it died"}
    pd.testing.assert_frame_equal(judged(runs)[~lost], alone[~lost], check_exact=True)
    assert sum(sizes) <= len(runs) + 8 * 4 + again * 4


@pytest.mark.parametrize("answers", [0, 1, 3])
def test_unanswered_runs_of_a_process_ended_once_from_outside_are_carried_out_again(answers):
    sizes: list[int] = []

    def submit(task):
        block = blocks.pickle.loads(blocks.pickle.loads(task.argument)[1])[0]
        told = [
            blocks.pack_result(RunResult.failed(identity(each.run), Ending("collision")))
            for each in block.jobs
        ]
        sizes.append(len(block.jobs))
        future = Future()
        end = End(Ending("crashed", "SIGTERM"), certain=False) if len(sizes) == 1 else None
        future.set_result(Answer(told[:answers] if end else told, end))
        return future

    outcomes = list(
        carry_out_blocks([Block(tuple(job(index, None) for index in range(3)))], Workers(submit))
    )
    assert sorted(result.row["seed"] for _, found in outcomes for result in found) == [0, 1, 2]
    assert all(result.row["status"] == "collision" for _, found in outcomes for result in found)
    assert sizes == [size for size in (3, answers < 3, 2 - answers) if size > 0]


def job(index: int, kind: object) -> Job:
    request = RunRequest("kinematic", "constant", "random", "none", index)
    return Job(index, Cell(request), ResolvedRun(request, RunSettings(), None, None, None), kind)


@pytest.mark.parametrize("kind", [None, "alike"])
def test_runs_that_wait_at_a_worker_of_dask_that_dies_are_not_blamed(kind):
    held: list[Block] = []

    def die_or_answer(block):
        time.sleep(0.02)  # as long as other tasks come
        died = any(each.index in {3, 13} for other in held for each in other.jobs)
        held.remove(block)
        if died:
            raise ProcessDied
        return Answer(
            [
                blocks.pack_result(RunResult.failed(identity(each.run), Ending("collision")))
                for each in block.jobs
            ]
        )

    def submit(task):
        held.append(blocks.pickle.loads(blocks.pickle.loads(task.argument)[1])[0])
        return thread.submit(die_or_answer, held[-1])

    with ThreadPoolExecutor(1) as thread:
        made = cut([job(index, kind) for index in range(24)], size=12)
        outcomes = list(
            carry_out_blocks(made, Workers(submit, 1, cluster=True, lost=(ProcessDied,)))
        )
    ends = {result.row["seed"]: result.row["status"] for _, found in outcomes for result in found}
    assert ends == {index: "crashed" if index in {3, 13} else "collision" for index in range(24)}


def test_a_block_has_consecutive_runs_of_one_kind():
    kinds = "aaaaabbxxxxxaa"
    jobs = [job(i, None if kind == "x" else kind) for i, kind in enumerate(kinds) if i != 4]
    made = [
        ([each.index for each in block.jobs], block.together)
        for block in cut(jobs, size=3, chunk=2)
    ]
    assert made == [
        ([0, 1, 2], True), ([3], True), ([5, 6], True), ([7, 8], False), ([9, 10], False), ([11], False),
        ([12, 13], True),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("count", "workers", "size"),
    [(200, 2, 100), (300, 2, 75), (1000, 1, 125), (5, 8, 1), (100_000, 2, 128), (0, 2, 0)],
)
def test_all_workers_get_the_same_share(count, workers, size):
    assert even_size(count, workers, 128) == size


def test_blocks_are_made_when_a_worker_is_about_to_need_them():
    made: list[int] = []

    def jobs():
        for index in itertools.count():
            made.append(index)
            yield job(index, None)

    def submit(task):
        block = blocks.pickle.loads(blocks.pickle.loads(task.argument)[1])[0]
        done = Future()
        failed = (RunResult.failed(identity(each.run), Ending("crashed")) for each in block.jobs)
        done.set_result(Answer([blocks.pack_result(result) for result in failed]))
        return done

    workers = Workers(submit, 3)
    outcomes = carry_out_blocks(cut(jobs(), 1, chunk=1), workers)
    assert [block.jobs[0].index for block, _ in itertools.islice(outcomes, 20)] == list(range(20))
    assert len(made) <= 20 + blocks.TASKS_PER_WORKER * workers.count


def test_cells_of_a_plan_are_made_one_by_one():
    made = []
    grid = Grid(lambda *values: made.append(values) or values, range(10**6), "ab", range(10**6))
    assert len(grid) == 2 * 10**12
    assert grid[10**6 + 3] == (0, "b", 3)
    assert grid[-1] == (10**6 - 1, "b", 10**6 - 1)
    assert len(made) == 2
    assert list(Grid(lambda *values: values, "ab", range(2))) == [
        ("a", 0),
        ("a", 1),
        ("b", 0),
        ("b", 1),
    ]
    with pytest.raises(IndexError):
        grid[len(grid)]


def test_further_plants_take_the_first_seed_only():
    batch = Batch(
        ("kinematic",), ("constant",), ("exp2", "circle"), ("none",), (3, 4), first_seed_on=("fmu",)
    )
    runs = [(run.plant, run.task, run.seed) for run in batch.requests()]
    assert runs == [
        ("kinematic", "exp2", 3),
        ("kinematic", "exp2", 4),
        ("kinematic", "circle", 3),
        ("kinematic", "circle", 4),
        ("fmu", "exp2", 3),
        ("fmu", "circle", 3),
    ]


def test_a_survey_finds_what_the_runs_are_without_keeping_them():
    batch = Batch(
        ("kinematic", "fmu"), ("constant", "rls"), ("random",), ("none", "moderate"), (3, 4, 9, 5)
    )
    found = survey(batch.requests())
    assert (found.count, found.seeds) == (32, [range(3, 6), range(9, 10)])
    assert [list(each) for each in (found.plants, found.controllers, found.mismatches)] == [
        ["kinematic", "fmu"], ["constant", "rls"], ["none", "moderate"],
    ]  # fmt: skip
    assert len(found.examples) == 6
    assert (
        found.digest
        == survey(list(batch.requests())).digest
        != survey(batch.requests()[::-1]).digest
    )
    with pytest.raises(
        ConfigurationError, match="the run kinematic-constant-random-none-3 is asked for twice"
    ):
        survey([*batch.requests(), batch.requests()[0]])
    upper = [RunRequest("kinematic", name, "random", "none", 3) for name in ("mine", "Mine")]
    with pytest.raises(
        ConfigurationError, match="the run kinematic-mine-random-none-3 is asked for twice"
    ):
        survey(upper)


def told(**changes: object) -> dict[str, object]:
    row = RunResult.failed(identity(job(0, None).run), Ending("collision")).row
    return {"row": row, "steps": None, "picture": None, "trace": ""} | changes


def steps_of(**values: object) -> str | None:
    return blocks._pack_array(pd.DataFrame(values, index=[0]).to_records(index=False))


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (None, "it is not the result of a run"),
        ("cos\nsystem\n(S'true'\ntR.", "it is not the result of a run"),
        (told(steps=[1]), "it is not the result of a run"),
        (told(row={}), "it lacks controller"),
        (told(row=told()["row"] | {"run_id": "../../escaped"}), "it is that of another run"),
        (told(row=told()["row"] | {"controller": "rls"}), "it is that of another run"),
        (told(row=told()["row"] | {"status": 3}), "its status is '3', wanted a value of type str"),
        (told(row=told()["row"] | {"rms_error": "small"}), "its rms_error is 'small', wanted a value of type float"),
        (told(row=told()["row"] | {"controller_time_p99_us": -math.inf}), "its controller_time_p99_us is -inf"),
        (told(row=told()["row"] | {"saturation_fraction": 1.5}), "its saturation_fraction is 1.5"),
        (told(row=told()["row"] | {"two\nlines": 1.0}),
         "it has two columns of one name, or a name that cannot be printed"),
        (told(steps="AAAA"), "reading magic string"),
        (told(steps=blocks._pack_array(np.array([("a",)], dtype=[("x", "U1")]))), "its steps are no numbers"),
        (told(steps=steps_of(time_s=0.0)), "its table of steps lacks the column error_norm"),
        (told(steps=steps_of(time_s=math.nan, error_norm=0.0)), "its steps have no times"),
        (told(steps=steps_of(time_s=0.0, error_norm=0.0, **{"a\x1b": 0.0})),
         "its table of steps has two columns of one"),
        (told(picture=blocks._pack_array(np.zeros((2, 2)))), "its picture is no image"),
    ],
)  # fmt: skip
def test_an_answer_that_was_falsified_is_refused(answer, why):
    with pytest.raises(ValueError, match=why):
        blocks.unpack_result(job(0, None), answer)


@pytest.fixture(scope="module")
def real() -> RunResult:
    return run_experiment(job(0, None).run.request, Settings({"random": {"duration": 2.0}}))


def sent(
    result: RunResult, row: dict[str, object] | None = None, steps: pd.DataFrame | None = None
) -> RunResult:
    """Return a result as it comes back from a process that changed some of it."""
    changed = replace(
        result, row=result.row | (row or {}), steps=result.steps if steps is None else steps
    )
    return blocks.unpack_result(job(0, None), json.loads(json.dumps(blocks.pack_result(changed))))


def test_a_result_is_the_same_after_its_way_through_a_process(real):
    picture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    back = sent(replace(real, picture=picture, trace="trace"))
    pd.testing.assert_frame_equal(back.steps, real.steps, check_exact=True)
    np.testing.assert_array_equal(back.picture, picture)
    assert list(back.row) == list(real.row)
    pd.testing.assert_frame_equal(
        pd.DataFrame([back.row]), pd.DataFrame([real.row]), check_exact=True
    )
    assert back.trace == "trace"
    assert sent(replace(real, steps=None)).steps is None


@pytest.mark.parametrize(
    ("row", "why"),
    [
        (
            {"outcome": "followed"},
            "its outcome 'followed' contradicts its status, settling time or error",
        ),
        ({"outcome": "settled", "settling_time_s": math.nan}, "its outcome 'settled' contradicts"),
        (
            {"outcome": "not_settled", "settling_time_s": 0.1},
            "its outcome 'not_settled' contradicts",
        ),
        ({"outcome": "brilliant"}, "its outcome 'brilliant' contradicts"),
        ({"outcome": "settled", "settling_time_s": 9.0}, "its settling time 9 s is beyond its 2 s"),
        (
            {"outcome": "settled", "settling_time_s": 0.0},
            "its steady_state_error is outside the band",
        ),
        ({"status": "collision"}, "its outcome '[a-z_]+' contradicts its status"),
        ({"rms_error": 1e3}, "its rms_error is larger than its largest error"),
        ({"rms_error": 0.0}, "its rms_error is 0, and by its steps"),
        ({"control_effort_rad": 0.0}, "its control_effort_rad is 0, and by its steps"),
        (
            {"controller_time_median_us": 1.0},
            "its controller_time_median_us is 1, and by its steps",
        ),
        ({"periods": 3}, "it has 3 periods and "),
    ],
)
def test_a_row_that_contradicts_itself_or_its_steps_is_refused(real, row, why):
    assert real.row["outcome"] != "settled"
    with pytest.raises(ValueError, match=f"^{why}"):
        sent(real, row)


@pytest.mark.parametrize(
    ("column", "factor", "why"),
    [
        ("error_norm", 0.0, "its error_norm is not that of its steps"),
        ("time_s", 0.5, "its steps are not a period apart"),
        ("joint_velocity_command_elbow_rad_s", 0.5, "its control_effort_rad is "),
    ],
)
def test_steps_that_do_not_fit_their_row_are_refused(real, column, factor, why):
    with pytest.raises(ValueError, match=f"^{why}"):
        sent(real, steps=real.steps.assign(**{column: factor * real.steps[column]}))


def table_of(*rows: dict[str, object]) -> dict[str, object]:
    """The table of columns in which answers travel from a worker of an executor."""
    return blocks.pack_together([told(row=row) for row in rows])


def rows_of(*changes: dict[str, object]) -> list[dict[str, object]]:
    return [
        RunResult.failed(identity(job(index, None).run), Ending("collision")).row | changed
        for index, changed in enumerate(changes)
    ]


def test_rows_are_the_same_after_their_way_as_columns(real):
    rows = [real.row, real.row | {"run_id": job(1, None).run.request.run_id, "seed": 1}]
    sent_table = json.loads(json.dumps(table_of(*rows)))
    back = list(blocks._unpacked([job(0, None), job(1, None)], [sent_table]))
    pd.testing.assert_frame_equal(
        pd.DataFrame([each.row for each in back]), pd.DataFrame(rows), check_exact=True
    )
    assert [list(each.row) for each in back] == [list(real.row)] * 2


@pytest.mark.parametrize("change", [{}, {"status": 3}])
def test_answers_of_runs_are_read_at_once_and_one_by_one_where_one_is_wrong(change, monkeypatch):
    read = []
    monkeypatch.setattr(blocks, "unpack_result", lambda job, item: read.append(job))
    items = [told(row=row) for row in rows_of({}, change)]
    jobs = [job(0, None), job(1, None)]
    found = list(blocks._unpacked(jobs, items))
    assert read == (jobs if change else [])
    assert [each and each.row for each in found] == [
        None if change else each["row"] for each in items
    ]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"run_id": "../../escaped"}, "it is that of another run"),
        ({"seed": 1.0}, "it is that of another run"),
        ({"controller": "rls"}, "it is that of another run"),
        ({"status": 3}, "its status is '3', wanted a value of type str"),
        ({"rms_error": "small"}, "its rms_error is 'small', wanted a value of type float"),
        ({"controller_time_p99_us": -math.inf}, "its controller_time_p99_us is -inf"),
        ({"saturation_fraction": 1.5}, "its saturation_fraction is 1.5"),
        ({"outcome": "settled"}, "its outcome 'settled' contradicts its status"),
    ],
)
def test_one_falsified_row_among_columns_is_refused(change, why):
    rows = rows_of({name: None for name in change if "_" in name and name != "run_id"}, change)
    with pytest.raises(ValueError, match=why):
        list(blocks._unpacked([job(0, None), job(1, None)], [table_of(*rows)]))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda table: table["columns"].pop("status"),
        lambda table: table["columns"]["status"].pop(),
        lambda table: table["columns"].update(status="collision"),
        lambda table: table["columns"].update({"two\nlines": [1.0, 1.0]}),
        lambda table: table["traces"].append(""),
        lambda table: table.update(traces=[1, 2]),
        lambda table: table.update(columns=[]),
    ],
)
def test_a_table_that_is_not_one_of_its_runs_is_refused(spoil):
    table = table_of(*rows_of({}, {}))
    spoil(table)
    with pytest.raises((TypeError, ValueError)):
        list(blocks._unpacked([job(0, None), job(1, None)], [table]))


@pytest.mark.parametrize(
    ("forge", "again"), [("row", [1, 1]), ("length", [1]), ("kind", [1, 1, 1])]
)
def test_runs_of_a_falsified_table_are_carried_out_again_one_by_one(forge, again):
    sizes: list[int] = []

    def submit(task):
        block = blocks.pickle.loads(blocks.pickle.loads(task.argument)[1])[0]
        sizes.append(len(block.jobs))
        items = [
            blocks.pack_result(RunResult.failed(identity(each.run), Ending("collision")))
            for each in block.jobs
        ]
        answer = blocks.pack_together(items)
        if len(sizes) == 1:
            if forge == "row":
                answer["columns"]["outcome"][1] = "settled"
            elif forge == "length":
                answer["columns"]["outcome"].pop()
            else:
                answer["columns"]["rms_error"] = 5
        future = Future()
        future.set_result(json.dumps([answer]).encode())
        return future

    block = Block(tuple(job(index, "alike") for index in range(3)), together=True)
    found = [result for _, part in carry_out_blocks([block], Workers(submit)) for result in part]
    assert sizes == [3, *again]
    assert sorted(each.row["seed"] for each in found) == [0, 1, 2]
    assert {each.row["outcome"] for each in found} == {"collision"}


def test_a_batch_ends_with_a_line_if_the_workers_of_a_cluster_never_come_back(monkeypatch):
    distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")
    monkeypatch.setattr(blocks, "LOOK_EVERY", 0.1)
    monkeypatch.setattr(blocks, "ABSENCE_TIME", 0.5)
    cluster = distributed.LocalCluster(1, processes=False, dashboard_address=":0")
    line = "^the workers ended: none has come back for 0.5 s; finished runs are kept"
    with cluster, distributed.Client(cluster) as client, client.get_executor() as executor:

        def submit(task):
            cluster.scale(0)
            return Future()

        def sweep():
            with open_workers(1, executor) as workers:
                workers.check()
                list(carry_out_blocks([Block((job(0, None),))], replace(workers, submit=submit)))

        with pytest.raises(ConfigurationError, match=line):
            sweep()


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("unreadable", [False, True])
def test_a_task_that_is_done_with_fewer_answers_than_runs_has_a_row_for_each_run(count, unreadable):
    forged = [{"unreadable": ["completed", "", ""]}] * unreadable

    def submit(task):
        block = blocks.pickle.loads(blocks.pickle.loads(task.argument)[1])[0]
        future = Future()
        future.set_result(Answer(forged or [told()][: count * (block.jobs[0].index == 0)]))
        return future

    jobs = tuple(job(index, None) for index in range(3))
    found = [
        result for _, part in carry_out_blocks([Block(jobs)], Workers(submit)) for result in part
    ]
    ends = {result.row["seed"]: result.row["status"] for result in found}
    assert ends == {
        0: "collision" if count and not unreadable else "crashed",
        1: "crashed",
        2: "crashed",
    }
    reasons = {result.row["reason"] for result in found if result.row["status"] == "crashed"}
    assert (isolation.SILENT in reasons) == (not unreadable)


def test_more_answers_than_runs_are_no_answer():
    def submit(task):
        block = blocks.pickle.loads(blocks.pickle.loads(task.argument)[1])[0]
        future = Future()
        future.set_result(Answer([told(), told()] if block.jobs[0].index == 0 else [told()]))
        return future

    (found,) = [
        result
        for _, part in carry_out_blocks([Block((job(0, None),))], Workers(submit))
        for result in part
    ]
    assert (found.row["status"], found.row["reason"]) == ("crashed", isolation.TALKATIVE)
