"""`make results`: studies carried out, gone on with, tried with few robots, stored and compared with what is stored."""

import sys
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import generated_tables
import renewal
import stored_tables
from kit.command import carried_out, servobench
from kit.documents import ROOT
from kit.documents import tables as page_tables
from kit.nightly import NIGHTLY, some
from kit.own import write
from page_studies import STUDIES, cells, held_out, knowledge, physical, pictures, worlds
from page_studies.pictures import README
from page_studies.study import ENGINES, REPRODUCTION, Study, nothing, sweep
from servobench.harness.apps.studies import robustness
from servobench.harness.batch import results
from servobench.harness.batch.plan import TUNING, Batch, SweepPlan, parse_seeds
from servobench.harness.batch.trials import choose
from servobench.harness.config.settings import read_settings
from servobench.harness.run.resolution import resolve_sections, select

TRIED = ("--set", "random.duration=0.5", "--workers", "1")


def settled_counts(folder: Path) -> dict[str, pd.DataFrame]:
    runs = results.load_runs(folder / "moves")
    counts = runs.groupby("controller").size()
    return {"counts": pd.DataFrame({"method": counts.index, "runs": counts.astype(str).to_numpy()})}


MOVES = Study(
    "toy",
    "how many runs there are",
    1,
    {"moves": sweep("kinematic", ["constant"], "random", "500:503")},
    settled_counts,
)


@pytest.fixture
def toy(monkeypatch, tmp_path):
    """A study of few runs, whose command is carried out in this process, and a folder that stands for docs."""

    def run_here(words, **_):
        return SimpleNamespace(returncode=servobench(monkeypatch, *words[3:]))

    monkeypatch.setattr(renewal, "subprocess", SimpleNamespace(run=run_here))
    monkeypatch.setattr(renewal, "STUDIES", {"toy": MOVES})
    monkeypatch.setattr(stored_tables, "FOLDER", tmp_path / "docs" / "tables")
    return tmp_path


def call(folder: Path, *options: str) -> int:
    return renewal.main(
        ["toy", "--runs", str(folder / "runs"), "--into", str(folder / "docs"), *TRIED, *options]
    )


def test_a_study_is_stored_with_how_it_was_made_and_stands_on_a_page(toy):
    assert call(toy) == 0
    stored = stored_tables.read(toy / "docs" / "tables" / "counts.csv")
    assert stored.table.to_dict("records") == [{"method": "constant", "runs": "3"}]
    assert stored.stamp["study"] == "toy"
    assert stored.stamp["command"].startswith(
        "servobench sweep --plants kinematic --controllers constant"
    )
    assert len(stored.stamp["commit"]) >= 40
    page = write(toy / "docs", "<!-- table: counts -->\nold\n<!-- end -->\n", "page.md")
    shown = generated_tables.renewed(page)
    assert "| method | runs |\n|---|---|\n| constant | 3 |" in shown
    assert f"commit {stored.stamp['commit'][:12]}; [commands](tables/counts.csv)" in shown
    assert "(tables/counts.csv)" in shown
    page.write_text(shown)
    assert generated_tables.renewed(page) == shown
    page.write_text("<!-- stored: counts -->\nold\n<!-- end -->\n")
    assert "[`counts`](tables/counts.csv) (commit" in generated_tables.renewed(page)


def test_a_study_that_was_interrupted_goes_on_and_one_of_other_code_begins_anew(toy, monkeypatch):
    carried_out = []
    monkeypatch.setattr(
        renewal, "run", lambda words, out: carried_out.append((out.name, list(words))) or "line"
    )
    study = replace(
        MOVES,
        commands={"first": ("sweep", "--seeds", "0:9"), "second": lambda _: ("sweep",), "none": ()},
    )
    folder = renewal.carry_out(study, toy, 2, ["--x"], keep=False)
    assert carried_out == [
        ("first", ["sweep", "--seeds", "0:2", "--x"]),
        ("second", ["sweep", "--x"]),
    ]
    (folder / "second.done").unlink()
    renewal.carry_out(study, toy, None, [], keep=False)
    assert carried_out[2:] == [("second", ["sweep"])]
    (folder / renewal.DIGEST).write_text("other code")
    renewal.carry_out(study, toy, None, [], keep=True)
    assert len(carried_out) == 3
    (folder / renewal.DIGEST).write_text("other code")
    renewal.carry_out(study, toy, None, [], keep=False)
    assert [name for name, _ in carried_out[3:]] == ["first", "second"]


def test_the_reproduction_of_the_paper_goes_on_and_keeps_its_least_number_of_robots(
    monkeypatch, tmp_path
):
    called = []

    def note(words, **_):
        called.append(words[1:])
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(renewal, "subprocess", SimpleNamespace(run=note))
    words = renewal.fewer((REPRODUCTION, "--seeds", "500"), 2)
    assert words == [REPRODUCTION, "--seeds", "6"]
    assert renewal.run(words, tmp_path / "new") == "python docs/reproduction.py --seeds 6"
    renewal.run(words, tmp_path)
    begun = [str(ROOT / REPRODUCTION), "--seeds", "6", "--out"]
    assert called == [[*begun, str(tmp_path / "new")], [*begun, str(tmp_path), "--resume"]]


def test_a_command_that_fails_ends_the_call_with_one_line(toy):
    with pytest.raises(SystemExit, match="ended with exit code 2; the same call goes on"):
        call(toy, "--set", "nonsense=1")


def test_a_check_names_each_figure_that_does_not_come_out_again(toy, capfd):
    assert call(toy, "--check") == 1
    assert "counts: not stored; call make results ONLY=toy" in capfd.readouterr().out
    assert call(toy) == 0
    assert call(toy, "--check") == 0
    assert "every stored figure comes out again" in capfd.readouterr().out
    path = toy / "docs" / "tables" / "counts.csv"
    path.write_text(path.read_text().replace("constant,3", "constant,9"))
    assert call(toy, "--check") == 1
    assert "counts: constant, runs: 3, stored is 9" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("found", "wanted", "same"),
    [
        ("0.75 [0.70, 0.80]", "0.80 [0.75, 0.80]", True),
        ("0.75", "0.86", False),
        ("38 of 40", "36 of 40", True),
        ("38 of 40", "30 of 40", False),
        ("3 4", "4 4", True),
        ("2 4", "4 4", False),
        ("1.2e-04", "1.5e-04", True),
        ("1.2e-04", "2.2e-04", False),
        ("−0.45", "−0.50", True),
        ("-0.45", "+0.45", False),
        ("faster", "slower", False),
    ],
)
def test_cells_may_differ_as_rounding_makes_them(found, wanted, same):
    assert stored_tables.alike(found, wanted) == same


def test_an_unknown_study_is_one_line_that_names_them_all():
    with pytest.raises(
        SystemExit, match="no study is called nonsense; there are challenges, held_out, rendered, "
    ):
        renewal.main(["nonsense"])


def test_all_tables_of_pages_belong_to_a_study_and_all_stored_ones_are_on_a_page():
    parts = [
        part
        for page in generated_tables.PAGES
        for part in generated_tables.PART.findall(page.read_text())
    ]
    shown = {
        name
        for _, kind, names, *_ in parts
        if kind in {"table", "stored"}
        for name in names.partition(":")[0].split(",")
    }
    stored = {
        path.stem: stored_tables.read(path).stamp["study"]
        for path in stored_tables.FOLDER.glob("*.csv")
    }
    assert set(stored) <= shown
    assert set(stored.values()) <= set(STUDIES)
    source = "".join(path.read_text() for path in (ROOT / "docs" / "page_studies").glob("*.py"))
    assert [name for name in shown if f'"{name}"' not in source] == []


def test_no_study_judges_on_seeds_of_the_tuning_and_names_are_those_of_the_folders():
    for name, study in STUDIES.items():
        assert study.name == name
        for command in study.commands.values():
            words = () if callable(command) else command
            if "--seeds" in words:
                assert not set(parse_seeds(words[words.index("--seeds") + 1])) & set(TUNING)


def option(words, name, default=""):
    return words[words.index(name) + 1] if name in words else default


@pytest.mark.parametrize("study", STUDIES.values(), ids=lambda study: study.name)
def test_methods_tasks_and_settings_of_the_sweeps_are_known_and_fit_each_other(study):
    for words in study.commands.values():
        if callable(words) or words[0] != "sweep":
            continue
        pairs = list(pairwise(words))
        settings, varied = (
            [value for name, value in pairs if name == each] for each in ("--set", "--vary")
        )
        usual = {"plants": "", "controllers": "", "tasks": "", "mismatch": "moderate"}
        lists = [
            tuple(option(words, f"--{name}", value).split(",")) for name, value in usual.items()
        ]
        lists[1] = tuple(choose("controller", name) for name in lists[1])
        seeds = parse_seeds(option(words, "--seeds"))[:1]
        batch = Batch(
            *lists,
            seeds,
            option(words, "--robot", "ur5"),
            (option(words, "--sensing", "position"),),
        )
        varied += [
            f"{name}={option(words, f'--{name}')}"
            for name in ("latency", "period")
            if f"--{name}" in words
        ]
        requests = [cell.request for cell in SweepPlan.parse(batch, varied).cells()]
        given = read_settings(None, settings)
        sections = resolve_sections(requests, given, to_run=False)  # PyBullet need not be installed
        assert set(given.sections) <= set(sections)
        assert [select(request, sections) for request in requests]


def toy_runs(words):
    """Runs that a sweep could have given, two robots a cell."""
    random = np.random.default_rng(0)
    seeds = parse_seeds(option(words, "--seeds"))[:2]
    lists = [option(words, f"--{name}", usual).split(",") for name, usual in (
        ("plants", ""), ("controllers", ""), ("tasks", "random"), ("mismatch", "moderate"), ("latency", "nan"),
        ("period", "nan"),
    )]  # fmt: skip
    return pd.DataFrame([
        {
            "run_id": "-".join(map(str, cell)), "plant": cell[0], "controller": cell[1], "task": cell[2],
            "mismatch": cell[3], "latency_s": float(cell[4]), "period_s": float(cell[5]), "seed": cell[6],
            "status": "completed", "outcome": "settled", "sensing": "position",
            **{name: random.uniform(0.5, 1.0) for name in (
                "settling_time_s", "overshoot", "steady_state_error", "rms_error_evaluated", "rms_error_second_lap",
                "path_length_ratio", "feature_invalid_fraction",
            )},
        }
        for cell in product(*lists, seeds)
    ])  # fmt: skip


def lay_out_suite(folder, challenges):
    """Write the tables of a suite with all methods that studies compare, alike in every challenge."""
    folder.mkdir()
    own = {
        "grade": "I", "measure": "settling", "reference": 0.7, "score": 0.5, "good.value": 99.0,
        "median.value": 0.8, "median.low": 0.7, "median.high": 0.9, "median.count": 2,
    }  # fmt: skip
    methods = dict.fromkeys((*worlds.COMPARED, *worlds.FROZEN))
    rows = [
        {**own, "challenge": challenge, "controller": name}
        for challenge, name in product(challenges, methods)
    ]
    pd.DataFrame(rows).to_csv(folder / "methods.csv")
    scores = [
        {**row, "seed": seed, "score": score}
        for row in rows
        for seed, score in enumerate((0.4, 0.6))
    ]
    pd.DataFrame(scores).to_csv(folder / "scores.csv")
    rank = {
        "rank": 1,
        "score.value": 0.5,
        "score.low": 0.4,
        "score.high": 0.6,
        "lost, %": 1.0,
        "within 2×": 0.5,
    }
    pd.DataFrame([{**rank, "controller": name} for name in worlds.RENDERED]).to_csv(
        folder / "ranking.csv"
    )


MODULES = {"held_out": held_out, "physical": physical, "worlds": worlds}


@pytest.mark.parametrize("name", some(MODULES, "worlds"))
def test_the_tables_of_sweeps_are_text_and_stand_on_a_page(monkeypatch, tmp_path, name):
    module = MODULES[name]
    steps = pd.DataFrame({"error_norm": np.full(50, 0.001)})
    monkeypatch.setattr(module, "load_steps", lambda *_: steps, raising=False)
    parts = [
        part
        for page in generated_tables.PAGES
        for part in generated_tables.PART.findall(page.read_text())
    ]
    shown = {name for _, _, names, *_ in parts for name in names.partition(":")[0].split(",")}
    lay_out_suite(tmp_path / "runs", set(worlds.LEARNED_IN) - set(worlds.UNGRADED))
    lay_out_suite(tmp_path / "ungraded", worlds.UNGRADED)
    for part in worlds.LEARNING.commands:
        lay_out_suite(tmp_path / part, ["severe"])
    for study in (
        value
        for value in vars(module).values()
        if isinstance(value, Study) and value.tables is not nothing
    ):
        monkeypatch.setattr(
            module, "load_runs", lambda path, study=study: toy_runs(study.commands[path.name])
        )
        for title, table in study.tables(tmp_path).items():
            assert len(table) or title == "held_out_studies"
            assert table.map(lambda cell: isinstance(cell, str)).all(axis=None), title
            assert title in shown


def test_the_readmes_pictures_are_drawn_from_a_batch(monkeypatch, tmp_path):
    short = (
        "compare", "--plants", "kinematic", "--controllers", "calibrated", "--tasks", "exp2,circle", "--mismatch",
        "none", "--seeds", "0:1", "--no-figures", "--no-report", "--workers", "1",
    )  # fmt: skip
    folder = renewal.carry_out(
        replace(README, commands={"batch": short}), tmp_path, None, [], keep=False
    )
    for name, content in pictures.readme_pictures(folder).items():
        path = tmp_path / Path(name).name
        path.write_bytes(content)
        assert path.stat().st_size < 300e3
        with Image.open(path) as picture:
            assert picture.size[0] >= 450
    assert {path.name for path in tmp_path.glob("*.png")} == {
        "bench.png",
        "errors.png",
        "paths.png",
        "circle.png",
    }


def test_the_command_draws_the_map(output_of, monkeypatch, tmp_path):
    lines = (
        replace(robustness.LINES[4], places=robustness.LINES[4].places[:2]),
        robustness.LINES[-1],
    )
    monkeypatch.setattr(robustness, "LINES", lines)
    monkeypatch.setattr(robustness, "KNOWN_LINES", {line.axis: line for line in lines})
    out = tmp_path / "robustness" / "map"
    arguments = (
        "robustness", "--plant", "kinematic", "--controllers", "constant", "--seeds", "1", "--workers", "1",
        "--set", "random.duration=1", "--out", str(out),
    )  # fmt: skip
    assert "the map is in" in output_of(*arguments)
    assert len(results.load_runs(out)) == 7
    assert {path.name for path in (out / "figures").iterdir()} == {
        "robustness.png", "robustness.pdf", "robustness_settling.png", "robustness_settling.pdf",
    }  # fmt: skip
    shown = STUDIES["robustness"].files(out.parent)
    assert set(shown) == {"pictures/robustness.png", "pictures/robustness_settling.png"}
    assert all(len(content) < 300e3 for content in shown.values())


def test_numbers_of_runs_that_crashed_are_not_stored(toy):
    assert call(toy) == 0
    table = next((toy / "runs").rglob(results.RUNS))
    runs = pd.read_parquet(table)
    runs.loc[0, ["status", "reason"]] = "crashed", "OSError: no more room"
    runs.to_parquet(table)
    with pytest.raises(
        SystemExit, match=r"1 of 3 runs in .* crashed, nothing is stored: OSError: no more room"
    ):
        call(toy)


def test_a_median_of_curves_tells_the_share_of_lost_runs():
    runs = pd.DataFrame({
        "task": "circle", "task_kind": "curve", "status": "completed", "settling_band": 0.005,
        "rms_error_evaluated": [0.002, 0.002, 0.15, 0.002],
    })  # fmt: skip
    assert cells.millimetres(runs) == "2.0 [2.0, 150.0], 25 % lost"
    assert cells.millimetres(runs[runs["rms_error_evaluated"] < 0.1]) == "2.0 [2.0, 2.0]"


def test_a_difference_that_holds_on_one_engine_only_is_in_bold_on_both():
    robots = np.arange(20)

    def runs(**times):
        return pd.concat([
            pd.DataFrame({
                "plant": "", "task": "random", "seed": robots, "controller": name, "status": "completed",
                "settling_time_s": seconds,
            })
            for name, seconds in times.items()
        ])  # fmt: skip

    def bold(*both):
        pairs = [("changed", "usual")]
        found = dict(zip(ENGINES, both, strict=True))
        (shown,) = cells.MOVES.on_engines(found, pairs)
        assert len({cell.startswith("**") for cell in shown.values()}) == 1
        return shown["bullet"].startswith("**")

    spread = 0.1 * np.sin(robots)
    later, earlier, alike = (
        runs(usual=1.0, changed=1.0 + shift + spread) for shift in (0.5, -0.5, 0.0)
    )
    assert bold(later, alike)
    assert bold(later, earlier)
    assert not bold(later, runs(usual=2.0, changed=2.9 + spread))
    assert not bold(alike, alike)
    barely = runs(usual=1.0, changed=1.07 + spread)
    hardly = runs(usual=1.0, changed=1.04 + 0.2 * np.cos(5 * robots))
    # One interval leaves 0 out and the other does not, but they differ by chance
    assert not bold(barely, hardly)


def test_a_table_whose_study_was_not_carried_out_leaves_its_page_as_it_is(toy):
    page = write(toy, "<!-- table: nothing -->\n\nas it was\n\n<!-- end -->\n", "page.md")
    assert generated_tables.renewed(page) == page.read_text()


def test_the_quick_page_of_performance_has_tables_and_its_picture(tmp_path):
    # Shares of the time of a period take half a minute
    parts = some(("limits", "shares"), "limits")
    command = [sys.executable, "benchmarks/page.py", "--quick", "--out", tmp_path, "--only", *parts]
    done = carried_out(*command, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "performance.md").read_text(encoding="utf-8")
    limits, *others = (rows for _, _, rows in page_tables(page))
    assert limits[-1][0] == "the package, a block of 4"
    if not NIGHTLY:
        return
    (shares,) = others
    assert [row[0] for row in shares] == ["alone"] * 3 + ["block"] * 3  # three methods
    for row in shares:
        parts, whole = map(float, row[2:-1]), float(row[-1])
        assert abs(sum(parts) - whole) < 0.5
    assert "(pictures/performance_shares.png)" in page
    assert (tmp_path / "pictures" / "performance_shares.png").stat().st_size < 100e3


def scored_by(value) -> pd.DataFrame:
    """Return scores of two methods on two robots in each of two worlds, as a function of world, robot and method."""
    rows = [
        {"challenge": world, "seed": robot, "controller": method, "score": value(world, robot, method)}
        for world in (0, 1)
        for robot in (0, 1)
        for method in (0, 1)
    ]  # fmt: skip
    return pd.DataFrame(rows)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (lambda world, robot, method: world, {"world": 1.0}),
        (lambda world, robot, method: method, {"method": 1.0}),
        (lambda world, robot, method: world ^ method, {"method in a world": 1.0}),
        (lambda world, robot, method: world ^ robot, {"robot": 1.0}),
        (lambda world, robot, method: robot ^ method, {"rest": 1.0}),
        (lambda world, robot, method: 3 * world + method, {"world": 0.9, "method": 0.1}),
    ],
)
def test_the_variance_of_scores_is_shared_out(value, expected):
    shares = worlds.variance_shares(scored_by(value))
    assert {name: share for name, share in shares.items() if share > 1e-12} == pytest.approx(
        expected
    )


def test_knowledge_is_judged_by_references_that_all_parts_share(monkeypatch):
    errors = {
        "references": {"calibrated": 0.002, "nmpc_calibrated": 0.003, "constant": 0.9},
        "arm": {"mfac+constant": 0.004, "calibrated": 0.1},
    }

    def runs(path: Path) -> pd.DataFrame:
        rows = [
            {
                "plant": "kinematic", "controller": name, "seed": seed, "status": "completed",
                "outcome": "followed", "rms_error_evaluated": error,
            }
            for name, error in errors[path.parent.name].items()
            for seed in (0, 1)
        ]  # fmt: skip
        return pd.DataFrame(rows)

    monkeypatch.setattr(knowledge, "load_runs", runs)
    judged = knowledge.scored_runs(Path("known"), ["arm"])
    assert set(judged["controller"]) == {"mfac+constant"}
    assert len(judged) == 2 * len(knowledge.WORLDS)
    np.testing.assert_allclose(judged["score"], 0.5)
