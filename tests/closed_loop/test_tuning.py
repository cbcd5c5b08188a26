"""Search spaces, the objective, the committed values and their check."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from kit.nightly import some
from kit.tuning import SMALL, cost_by_formula, read_tuned
from servobench import controllers
from servobench.controllers.aids import EQUIPPED
from servobench.harness.batch.plan import TUNING
from servobench.harness.batch.sandbox import Workers
from servobench.harness.config.registry import controller_names, find_controller
from servobench.harness.config.settings import apply_settings, default_config, flatten
from servobench.harness.studies.tuning.campaign import TOLERANCE, Change, Check, improvements
from servobench.harness.studies.tuning.objective import (
    CONDITIONS,
    MOVE,
    WEIGHTS,
    Trial,
    TuningSet,
    evaluate,
    run_cost,
    score,
)
from servobench.harness.studies.tuning.search import first_points, inside
from servobench.harness.studies.tuning.spaces import (
    SPACES,
    default_values,
    find_space,
    find_tunable,
    is_switch,
    nested_settings,
    values_of,
)

CORNERS = 64
AIDS = {f"aids.{word}" for word in EQUIPPED}
TUNED = {path.stem: path for path in sorted((Path(controllers.__file__).parent / "tuned").glob("*.toml"))}
CHECKED = some(TUNED, "map_mfac", "rbfnn_mfac", "rls.published", "constant")
ROUNDING = 0.02  # the curves of ukf_mpc and rbfnn_mfac enlarge it: 0.1.0 differs by so much between two processors


@pytest.fixture
def made_up(monkeypatch):
    """Runs whose cost is a formula; the list of what was scored."""
    return cost_by_formula(monkeypatch)


def ends(distribution):
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices
    return distribution.low, distribution.high


def test_every_controller_of_this_package_but_one_bound_has_a_space():
    never = {"nmpc_calibrated"}  # a bound that does not look at the camera
    assert set(SPACES) | never == set(controller_names())


@pytest.mark.parametrize("name", SPACES)
def test_a_space_has_at_least_three_parameters_and_the_default_lies_inside(name):
    space, default = find_space(name), default_values(find_tunable(name))
    assert len(space) >= 3
    for key, distribution in space.items():
        assert distribution._contains(distribution.to_internal_repr(default[key])), key
    entry = find_controller(name)
    again = values_of(name, apply_settings(entry, nested_settings(default)))
    assert nested_settings(again) == nested_settings(default)


@pytest.mark.parametrize("name", SPACES)
def test_every_corner_of_the_numbers_can_be_built_and_keeps_to_the_preview(name):
    space = SPACES[name]
    corners = list(itertools.product(*(ends(distribution) for distribution in space.values())))
    for corner in corners[:: max(1, len(corners) // CORNERS)]:
        settings = nested_settings(dict(zip(space, corner, strict=True)))
        flat = flatten(apply_settings(find_tunable(name), settings))
        assert flat.get("law.horizon_time", 0.0) <= 0.5
        assert all(value >= 1 for key, value in flat.items() if key.endswith("horizon"))


def test_settings_are_nested_and_rounded_to_three_digits():
    values = {"law.gain": 0.123456, "aids.filter": True, "training.controller.gain": 12345.6, "law.horizon": 9}
    assert nested_settings(values) == {
        "law": {"gain": 0.123, "horizon": 9},
        "aids": {"filter": True},
        "training": {"controller": {"gain": 12300.0}},
    }


@pytest.mark.parametrize("name", SPACES)
def test_best_equipped_methods_have_the_words_of_the_aids_as_switches_and_published_ones_none(name):
    words = {key.removeprefix("aids.") for key, values in SPACES[name].items() if key in AIDS and is_switch(values)}
    own = {"ukf_mpc": {"feedforward", "limit"}}.get(name, set())
    bounded = name.endswith(":published") or name in {"constant", "calibrated"}
    assert words == (set() if bounded else set(EQUIPPED) - own - {"posture"})


@pytest.mark.parametrize("name", SPACES)
def test_the_first_points_hold_the_defaults_the_values_in_use_and_every_value_of_every_switch(name):
    entry, space, points = find_tunable(name), find_space(name), first_points(name)
    settings = [nested_settings(point) for point in points]
    assert points[0] == default_values(entry)
    assert nested_settings(values_of(name, default_config(entry))) in settings
    for key in filter(lambda key: is_switch(space[key]), space):
        for choice in space[key].choices:
            assert nested_settings({**points[0], key: choice}) in settings
    assert len({str(each) for each in settings}) == len(points)
    for point in points:
        for key, distribution in space.items():
            assert distribution._contains(distribution.to_internal_repr(point[key])), key


def test_values_outside_a_space_go_to_its_ends_and_unknown_words_to_the_default():
    space = {
        "word": CategoricalDistribution(("a", "b")),
        "gain": FloatDistribution(1.0, 2.0),
        "count": IntDistribution(1, 9, step=2),
    }
    default = {"word": "a", "gain": 1.5, "count": 1}
    assert inside(space, {"word": "c", "gain": 5.0, "count": 6.9}, default) == {"word": "a", "gain": 2.0, "count": 7}
    assert inside(space, {"word": "b", "gain": 0.5, "count": 3}, default) == {"word": "b", "gain": 1.0, "count": 3}


def test_tuned_files_do_not_matter_to_a_trial():
    trial = Trial("rls:published", apply_settings(find_tunable("rls:published"), {"law": {"integral_gain": 0.5}}))
    assert [run.controller for run in trial.resolved(SMALL.runs()[:1])] == [trial.config]
    assert default_config(find_tunable("rls:published")) != find_tunable("rls:published").config()


def test_every_run_has_a_robot_of_its_own_and_every_condition_plain_and_turned_cameras():
    runs = TuningSet(robots=4, offset=100).runs()
    assert [run.seed for run in runs] == list(range(TUNING.start + 100, TUNING.start + 100 + len(runs)))
    for index in range(len(CONDITIONS)):
        of_condition = runs[4 * index : 4 * index + 4]
        turned = [run.mismatch.size("camera_rotation") for run in of_condition]
        assert turned[0] == turned[2] < turned[3] < turned[1]
        assert len({(run.task, run.varied) for run in of_condition}) == 1
    twice = TuningSet(("kinematic", "bullet"), 2).runs()
    assert [run.plant for run in twice] == ["kinematic"] * 14 + ["bullet"] * 14
    assert twice[0].seed == twice[14].seed


def test_on_one_circle_commands_take_effect_at_once_and_on_the_others_with_the_delay_of_the_plant():
    entry = find_tunable("constant")
    circles = [run for run in SMALL.runs() if run.task == "circle"]
    plants = [run.plant for run in Trial("constant", default_config(entry)).resolved(circles)]
    assert [(plant.command_delay, plant.sensing.latency) for plant in plants] == [(0.05, 0.0)] * 2 + [(0.0, 0.05)] * 2


@pytest.mark.parametrize(
    ("task", "row", "cost"),
    [
        (MOVE, {"settling_time_s": 1.5, "rms_error_evaluated": 0.001}, 0.25),
        (MOVE, {"settling_time_s": np.nan, "rms_error_evaluated": 0.05}, 1.5),
        (MOVE, {"settling_time_s": 1.0, "rms_error_evaluated": 0.001, "status": "plant_diverged"}, 2.0),
        ("circle", {"rms_error_evaluated": 0.0125}, 0.4),
        ("lemniscate", {"rms_error_evaluated": 0.15}, 1.5),
        ("circle", {"rms_error_evaluated": np.nan, "status": "solver_failed"}, 2.0),
    ],
)
def test_the_cost_of_a_run_computed_by_hand(task, row, cost):
    row = {"settling_time_s": np.nan, "status": "completed"} | row
    assert run_cost(task, row) == pytest.approx(WEIGHTS[task] * cost)


def test_a_better_tuned_controller_has_the_better_score():
    """Resolved-rate control by the true Jacobian: with feedforward it follows the circle, without it lags behind."""
    entry = find_tunable("calibrated")
    trials = [Trial("calibrated", apply_settings(entry, {"aids": {"feedforward": switch}})) for switch in (True, False)]
    runs = [run for run in SMALL.runs() if run.task == "circle"]
    costs = np.zeros((2, len(runs)))
    for trial, run, cost in evaluate(trials, runs, Workers()):
        costs[trial, run] = cost
    assert (costs[0] < 0.5 * costs[1]).all()


@pytest.mark.parametrize("name", CHECKED)
def test_committed_values_reach_the_score_that_their_file_states_and_studies_beat_the_defaults(name):
    tuned = read_tuned(TUNED[name])
    assert tuned.controller.replace(":", ".") == name
    runs = [tuned.tuning_set().runs()[index] for index in tuned.tuning_set().checked()]
    trial = Trial(tuned.controller, apply_settings(find_tunable(tuned.controller), tuned.settings))
    costs = {run: cost for _, run, cost in evaluate([trial], runs, Workers())}
    assert score([costs[run] for run in range(len(runs))]) == pytest.approx(tuned.checked_score, abs=ROUNDING)
    if tuned.studies:
        assert tuned.score <= tuned.score_of_defaults
        assert tuned.settings in [each.settings for each in tuned.studies]
        assert tuned.second_score == min(each.second_score for each in tuned.studies)


def test_committed_values_of_all_methods_have_the_same_budget_on_the_same_runs():
    tuned = [read_tuned(path) for path in TUNED.values()]
    assert len({each.tuning_set() for each in tuned}) == 1
    assert len({tuple((study.seed, study.trials) for study in each.studies) for each in tuned}) == 1


def test_the_check_of_every_change_finds_the_one_that_helps(made_up, tmp_path):
    check = Check(tmp_path, ("rls", "broyden"), SMALL)
    assert (len(check) > 20, check.known()) == (True, 0)
    assert len(list(check.carry_out(Workers()))) == len(check) == check.known()
    judged = check.changes()
    assert {(each.controller, each.key) for each in judged} == {
        (name, key) for name in ("rls", "broyden") for key in find_space(name)
    }
    found = improvements(judged)
    assert found == sorted(found, key=lambda change: -change.gain)
    assert all((change in found) == (change.score_after < (1.0 - TOLERANCE) * change.score_before) for change in judged)
    scored = len(made_up)
    again = Check(tmp_path, ("rls", "broyden"), SMALL)
    assert list(again.carry_out(Workers())) == []
    assert (again.changes(), len(made_up)) == (judged, scored)


def test_a_change_that_gains_little_is_no_improvement():
    little, much = (Change("rls", "law.damping", 1.0, 1.2, 1.0, after) for after in (0.975, 0.965))
    assert improvements([little, much]) == [much]
    assert much.gain == pytest.approx(0.035)
