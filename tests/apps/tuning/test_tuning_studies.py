"""Studies that go on where they stopped, and the files they leave."""

from dataclasses import replace
from pathlib import Path

import pytest

from kit.tuning import SMALL, carried_out, cost_by_formula, outcomes, plan_of, read_tuned
from servobench import controllers
from servobench.harness.apps.tuning import objective
from servobench.harness.apps.tuning.campaign import (
    TuningPlan,
    advance,
    open_methods,
    write_results,
    write_tuned,
)
from servobench.harness.apps.tuning.objective import (
    WORST,
    Ledger,
    TuningSet,
    fill,
    open_ledger,
    score,
)
from servobench.harness.apps.tuning.spaces import (
    StudyRecord,
    default_values,
    find_tunable,
    first_points,
    nested_settings,
    tuned_point,
)
from servobench.harness.batch.isolation import Workers
from servobench.plant.contract.faults import ConfigurationError

TUNED = Path(controllers.__file__).parent / "tuned" / "constant.toml"


@pytest.fixture
def made_up(monkeypatch):
    """Runs whose cost is a formula, and loops that bear any delay; the list of what was scored."""
    monkeypatch.setattr(objective, "bears_delay", lambda _: True)
    return cost_by_formula(monkeypatch)


def test_the_defaults_come_first_and_no_two_trials_are_alike(made_up, tmp_path):
    trials = len(first_points("broyden")) + 6
    (method,) = carried_out(tmp_path, plan_of("broyden", trials=trials))
    assert made_up[0][2] == str(find_tunable("broyden").config())
    assert len(method.ledger.path.read_text().splitlines()) == 1 + trials


def test_the_sampler_finds_better_values_than_the_known_ones(made_up, tmp_path):
    known = len(first_points("broyden"))
    few = outcomes(tmp_path / "few", plan_of("broyden", trials=known))[0][0]
    more = outcomes(tmp_path / "more", plan_of("broyden", trials=known + 10))[0][0]
    assert more.best_trial >= known
    assert more.score < few.score


def test_a_campaign_taken_up_again_is_that_which_was_never_interrupted(made_up, tmp_path):
    whole = outcomes(tmp_path / "whole", plan_of("ukf_mfac", "broyden", trials=12, studies=2))
    once = len(made_up)
    part = plan_of("ukf_mfac", "broyden", trials=12, studies=2)
    (tmp_path / "parts").mkdir()
    halfway = advance(open_methods(tmp_path / "parts", part), part, Workers())
    for _ in range(25):  # leaves in the middle of a round, as a kill does
        next(halfway)
    halfway.close()
    for name in part.controllers:
        with (tmp_path / "parts" / f"{name}.jsonl").open("ab") as ledger:
            ledger.write(b'{"settings": {"law": {"cut')
    assert repr(outcomes(tmp_path / "parts", part)) == repr(whole)  # which hold NaN
    assert len(made_up) <= 2 * once + 1  # at most the point that was under way is scored twice


def test_each_study_has_a_sampler_of_its_own_that_the_seed_decides(made_up, tmp_path):
    trials = len(first_points("rls")) + 3
    (method,) = carried_out(tmp_path / "a", plan_of("rls", trials=trials, studies=2))
    assert len(method.ledger.path.read_text().splitlines()) == 1 + trials + 3
    second = outcomes(tmp_path / "b", plan_of("rls", trials=trials, study_seed=1))[0]
    assert repr(second) == repr([method.studies[1].outcome])  # which holds NaN


def test_settings_that_cannot_be_built_have_the_worst_cost_and_are_not_carried_out(
    made_up, tmp_path
):
    ledger = open_ledger(tmp_path, "rls", SMALL)
    point = {**default_values(find_tunable("rls")), "estimator.forgetting": 7.0}
    assert list(fill([(ledger, "rls", nested_settings(point))], SMALL, Workers())) == ["rls"]
    assert score(ledger.costs(nested_settings(point))) == pytest.approx(WORST)
    assert not made_up


@pytest.mark.parametrize(("gain", "runs"), [(2.5, 1), (29.0, 0)])
def test_a_loop_with_too_small_a_delay_margin_has_the_worst_cost_without_a_run(
    monkeypatch, tmp_path, gain, runs
):
    scored = cost_by_formula(monkeypatch)
    ledger = open_ledger(tmp_path, "constant", SMALL)
    point = {**default_values(find_tunable("constant")), "law.proportional_gain": gain}
    assert list(fill([(ledger, "constant", nested_settings(point))], SMALL, Workers())) == [
        "constant"
    ]
    assert len(scored) == runs
    assert (score(ledger.costs(nested_settings(point))) == pytest.approx(WORST)) == (runs == 0)


def test_any_number_of_workers_gives_the_same_studies_and_files_say_what_they_hold(
    monkeypatch, tmp_path
):
    brief = {objective.MOVE: {"duration": 1.0}}
    brief |= {task: {"radius": 0.1, "lap_time": 1.0} for task in ("circle", "lemniscate")}
    monkeypatch.setattr(objective, "TASKS", brief)
    monkeypatch.setattr(objective, "SECOND_FACTOR", 1)
    plan = replace(plan_of("broyden:published", trials=2, studies=2), runs=TuningSet(robots=1))
    one, two = carried_out(tmp_path / "one", plan), carried_out(tmp_path / "two", plan, workers=2)
    written, again = write_results(tmp_path / "one", one), write_results(tmp_path / "two", two)
    assert written == again
    (tuned,) = written.values()
    assert read_tuned(tmp_path / "one" / "broyden.published.toml") == tuned
    assert TuningSet(tuned.plants, tuned.robots, tuned.offset) == plan.runs
    assert (tuned.runs_a_trial, tuned.runs_of_second_set) == (8, 8)
    assert [(each.seed, each.trials) for each in tuned.studies] == [(0, 2), (1, 2)]
    on_second = [tuned.second_score_of_defaults, *(each.second_score for each in tuned.studies)]
    assert tuned.second_score <= min(on_second), "the values in use stay unless a study is better"
    assert tuned.settings == nested_settings(tuned_point(find_tunable("broyden:published")))
    first, costs = plan.runs.checked(), one[0].ledger.costs(tuned.settings)
    assert tuned.checked_score == pytest.approx(score([costs[index] for index in first]))


def test_the_study_that_is_best_on_the_second_set_is_in_use_for_a_division_too(made_up, tmp_path):
    plan = plan_of("rls:published", trials=len(first_points("rls:published")) + 15, studies=3)
    methods = carried_out(tmp_path, plan)
    (tuned,) = write_results(tmp_path, methods).values()
    best = min(tuned.studies, key=lambda each: each.second_score)
    assert (tuned.settings, tuned.second_score, tuned.score) == (
        best.settings,
        best.second_score,
        best.score,
    )
    assert len({str(each.settings) for each in tuned.studies}) > 1
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "rls.published.jsonl",
        "rls.published.second.jsonl",
        "rls.published.toml",
    ]


def test_no_result_is_written_before_every_study_has_ended(made_up, tmp_path):
    plan = plan_of("rls", trials=6, studies=2)
    methods = open_methods(tmp_path, plan)
    next(advance(methods, plan, Workers()))
    assert write_results(tmp_path, methods) == {}


def test_no_result_is_written_before_all_known_values_have_scores_on_the_second_set(
    made_up, tmp_path
):
    plan = plan_of("rls", trials=len(first_points("rls")) + 2)
    assert write_results(tmp_path, carried_out(tmp_path, plan))
    ledger = tmp_path / "rls.second.jsonl"
    header, *points = ledger.read_bytes().splitlines(keepends=True)
    assert len(points) > 1
    for k in range(len(points)):
        ledger.write_bytes(b"".join([header, *points[:k], *points[k + 1 :]]))
        methods = open_methods(tmp_path, plan)
        methods[0].wanted()
        assert all(study.outcome is not None for study in methods[0].studies)
        assert write_results(tmp_path, methods) == {}


@pytest.mark.parametrize(
    ("runs", "part"),
    [
        (TuningSet(robots=4), "robots"),
        (TuningSet(robots=2, offset=50), "robots"),
        (TuningSet(("bullet",), 2), "plants"),
    ],
)
def test_a_ledger_of_other_runs_is_refused_and_no_other_is_begun(made_up, tmp_path, runs, part):
    carried_out(tmp_path, plan_of("rls"))
    with pytest.raises(
        ConfigurationError, match=f"rls.jsonl was made with other {part}; name another folder"
    ):
        open_methods(tmp_path, TuningPlan(("broyden", "rls"), 1, runs))
    assert not (tmp_path / "broyden.jsonl").exists()


@pytest.mark.parametrize("text", ["hello\nworld\n", "[]\n", '{"a": 1}\n{"b": 2}\n'])
def test_a_file_that_is_no_ledger_is_refused_and_left_alone(tmp_path, text):
    (tmp_path / "rls.jsonl").write_text(text)
    with pytest.raises(
        ConfigurationError, match=r"rls.jsonl (cannot be opened|was made with other)"
    ):
        Ledger(tmp_path / "rls.jsonl", {"a": 1})
    assert (tmp_path / "rls.jsonl").read_text() == text


def test_a_ledger_forgets_half_a_line_and_goes_on(tmp_path):
    path = tmp_path / "rls.jsonl"
    path.write_text('{"a": 1')  # killed while its first line was written
    ledger = Ledger(path, {"a": 1})
    ledger.add({"law": {"gain": 1.0}}, [0.5])
    with path.open("a") as file:
        file.write('{"settings": {"law"')
    again = Ledger(path, {"a": 1})
    again.add({"law": {"gain": 2.0}}, [0.25])
    last = Ledger(path, {"a": 1})
    assert (last.costs({"law": {"gain": 1.0}}), last.costs({"law": {"gain": 2.0}})) == (
        [0.5],
        [0.25],
    )
    assert (last.best(), last.costs({})) == (0.25, None)


def test_a_ledger_that_cannot_be_written_says_so(tmp_path):
    with pytest.raises(ConfigurationError, match="rls.jsonl cannot be written"):
        Ledger(tmp_path / "none" / "rls.jsonl", {}).add({}, [0.0])


@pytest.mark.parametrize("studies", [0, 2])
def test_words_with_quotes_and_any_number_of_studies_survive_the_file(tmp_path, studies):
    settings = {"law": {"kind": 'x"y', "inner": {"on": True}}}
    record = StudyRecord(0, 2, 1, 0.25, 0.3, settings)
    whole = read_tuned(TUNED)
    odd = replace(whole, version='1.0+"a"\\b', settings=settings, studies=(record,) * studies)
    write_tuned(tmp_path / "odd.toml", odd)
    assert read_tuned(tmp_path / "odd.toml") == odd
