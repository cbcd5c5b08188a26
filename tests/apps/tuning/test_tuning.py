"""Search spaces, the objective, the committed values and their check."""

import itertools
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from kit.nightly import some
from kit.tuning import SMALL, cost_by_formula, read_tuned
from servobench import controllers
from servobench.controllers.aids import EQUIPPED
from servobench.harness.apps.tuning.objective import (
    KINDS,
    LEVELS,
    MODELS,
    MOVE,
    WEIGHTS,
    Trial,
    TuningSet,
    evaluate,
    run_cost,
    score,
)
from servobench.harness.apps.tuning.spaces import (
    SPACES,
    default_values,
    edges,
    find_space,
    find_tunable,
    first_points,
    inside,
    nested_settings,
    values_of,
    widened,
)
from servobench.harness.batch.isolation import Workers
from servobench.harness.batch.plan import TUNING
from servobench.harness.config.registry import controller_names
from servobench.harness.config.settings import (
    apply_settings,
    default_config,
    flatten,
    tuned_settings,
)
from servobench.harness.run.metrics import log_error, settling_time

CORNERS = 64
AIDS = {f"aids.{word}" for word in EQUIPPED}
TUNED = {
    path.stem: path for path in sorted((Path(controllers.__file__).parent / "tuned").glob("*.toml"))
}
CHECKED = some(TUNED, "regression_mfac", "rbfnn_mfac", "rls.published", "constant")
ROUNDING = 0.02  # the curves of ukf_mpc and rbfnn_mfac enlarge it: 0.1.0 differs by so much between two processors


@pytest.fixture
def made_up(monkeypatch):
    """Runs whose cost is a formula; the list of what was scored."""
    return cost_by_formula(monkeypatch)


def tuning_set(tuned):
    return TuningSet(tuned.plants, tuned.robots, tuned.offset)


def ends(distribution):
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices
    return distribution.low, distribution.high


def test_every_controller_of_this_package_but_two_bounds_has_a_space():
    # One does not look at the camera, the other is made of two tuned methods.
    never = {"nmpc_calibrated", "revealed"}
    assert set(SPACES) | never == set(controller_names())


@pytest.mark.parametrize("name", SPACES)
def test_every_corner_of_the_numbers_can_be_built_and_keeps_to_the_preview(name):
    space = SPACES[name]
    corners = list(itertools.product(*(ends(distribution) for distribution in space.values())))
    for corner in corners[:: max(1, len(corners) // CORNERS)]:
        settings = nested_settings(dict(zip(space, corner, strict=True)))
        flat = flatten(apply_settings(find_tunable(name), settings))
        assert flat.get("law.horizon_time", 0.0) <= 0.5
        assert all(value >= 1 for key, value in flat.items() if key.endswith("horizon"))


def test_a_number_at_an_edge_is_found_and_its_box_widened_up_to_what_is_no_choice():
    space = {
        "gain": FloatDistribution(1.0, 100.0, log=True),
        "share": FloatDistribution(0.0, 1.0),
        "law.k": FloatDistribution(0.01, 1.0, log=True),
        "steps": FloatDistribution(2.0, 5.0, step=1.0),
        "word": CategoricalDistribution(("a", "b")),
    }
    # A lower end of 0 is no choice
    inside = {"gain": 10.0, "share": 0.0, "law.k": 0.1, "steps": 3.0, "word": "a"}
    assert edges(space, inside) == {}
    assert dict(widened(space, inside)) == space
    at_ends = {"gain": 1.1, "share": 0.97, "law.k": 0.95, "steps": 5.0}
    assert edges(space, at_ends) == {
        "gain": "lower",
        "share": "upper",
        "law.k": "upper",
        "steps": "upper",
    }
    wider = widened(space, at_ends)
    assert [(wider[key].low, wider[key].high) for key in at_ends] == [
        (0.25, 100),
        (0, 2),
        (0.01, 1.9),
        (2, 8),
    ]
    assert edges(wider, at_ends) == {}
    beyond = widened(space, {"gain": 150.0})["gain"]
    assert (beyond.low, beyond.high) == (1.0, 600.0)


@pytest.mark.parametrize("name", SPACES)
def test_values_in_use_lie_inside_of_their_widened_boxes(name):
    assert edges(find_space(name), flatten(tuned_settings(name))) == {}


def test_settings_are_nested_and_rounded_to_three_digits():
    values = {
        "law.gain": 0.123456,
        "aids.filter": True,
        "training.controller.gain": 12345.6,
        "law.horizon": 9,
    }
    assert nested_settings(values) == {
        "law": {"gain": 0.123, "horizon": 9},
        "aids": {"filter": True},
        "training": {"controller": {"gain": 12300.0}},
    }


@pytest.mark.parametrize("name", SPACES)
def test_best_equipped_methods_have_the_aids_as_switches_and_published_ones_none(name):
    words = {
        key.removeprefix("aids.")
        for key, values in SPACES[name].items()
        if key in AIDS and isinstance(values, CategoricalDistribution)
    }
    own = {"ukf_mpc": {"feedforward", "limit"}, "calibrating_mfac": {"model"}}.get(name, set())
    bounded = name.endswith(":published") or name in {"constant", "calibrated"}
    assert words == (set() if bounded else set(EQUIPPED) - own - {"posture", "calming"})


@pytest.mark.parametrize("name", SPACES)
def test_the_first_points_hold_defaults_values_in_use_and_every_value_of_a_switch(name):
    entry, space, points = find_tunable(name), find_space(name), first_points(name)
    settings = [nested_settings(point) for point in points]
    assert len(space) >= 3
    assert points[0] == default_values(entry)
    again = values_of(name, apply_settings(entry, settings[0]))
    assert nested_settings(again) == settings[0]
    assert nested_settings(values_of(name, default_config(entry))) in settings
    for key in (key for key in space if isinstance(space[key], CategoricalDistribution)):
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
    assert inside(space, {"word": "c", "gain": 5.0, "count": 6.9}, default) == {
        "word": "a",
        "gain": 2.0,
        "count": 7,
    }
    assert inside(space, {"word": "b", "gain": 0.5, "count": 3}, default) == {
        "word": "b",
        "gain": 1.0,
        "count": 3,
    }


def test_tuned_files_do_not_matter_to_a_trial():
    trial = Trial(
        "rls:published",
        apply_settings(find_tunable("rls:published"), {"law": {"integral_gain": 0.5}}),
    )
    assert [run.controller for run in trial.resolved(SMALL.runs()[:1])] == [trial.config]
    assert default_config(find_tunable("rls:published")) != find_tunable("rls:published").config()


def test_every_run_has_its_own_robot_and_every_model_and_level_occurs_equally_often():
    chosen = TuningSet(robots=4, offset=100)
    runs, worlds = chosen.runs(), chosen.runs()[::4]
    assert [run.seed for run in runs] == list(
        range(TUNING.start + 100, TUNING.start + 100 + len(runs))
    )
    models = Counter(
        next(model for model in reversed(MODELS) if str(run.mismatch).startswith(model))
        for run in runs
    )
    assert models == dict.fromkeys(MODELS, 4)
    assert Counter(dict(run.varied)["plant.sensing.latency"] for run in worlds) == dict.fromkeys(
        LEVELS["latency"], 2
    )
    assert Counter(dict(run.varied)["plant.sensing.noise_factor"] for run in worlds) == {
        1.0: 4,
        4.0: 4,
    }
    assert {dict(run.varied).get("run.period", 0.05) for run in worlds} == {0.2, 0.1, 0.05, 0.008}
    for detector in filter(None, LEVELS["detector"]):
        assert [str(run.mismatch).endswith(detector) for run in worlds].count(True) == 1
    for world in range(len(KINDS)):
        assert len({(run.task, run.varied) for run in runs[4 * world : 4 * world + 4]}) == 1


def test_the_worlds_are_drawn_by_the_seed_of_the_set_and_are_others_in_the_second():
    assert TuningSet().runs() == TuningSet().runs()
    sets = TuningSet(), TuningSet().second(), TuningSet(offset=32)
    drawn = [[(run.task, run.varied) for run in each.runs()[:: each.robots]] for each in sets]
    assert drawn[0] != drawn[1] != drawn[2] != drawn[0]


def test_plants_share_robots_and_only_one_whose_drives_can_overshoot_has_overshoot():
    twice = TuningSet(("kinematic", "bullet"), 2).runs()
    here, there = twice[:16], twice[16:]
    assert ({run.plant for run in here}, {run.plant for run in there}) == (
        {"kinematic"},
        {"bullet"},
    )
    assert [run.seed for run in here] == [run.seed for run in there]
    keys = [[key for run in runs for key, _ in run.varied] for runs in (here, there)]
    assert [each.count("plant.overshoot") for each in keys] == [2, 0]
    assert [each.count("plant.command_delay") for each in keys] == [2, 2]


def test_the_worlds_reach_the_plant_the_rate_and_the_task():
    runs = Trial("constant", default_config(find_tunable("constant"))).resolved(SMALL.runs())
    assert {run.plant.overshoot for run in runs} == {0.0, 0.3}
    assert {run.plant.command_delay for run in runs} == {0.0, 0.05}
    assert {run.plant.sensing.outliers for run in runs} == {0.0, 0.05, 0.2}
    assert {run.run.period for run in runs} == {0.2, 0.1, 0.05, 0.008}
    moves = [run.task for run in runs if run.request.task == MOVE]
    assert {task.duration for task in moves} == {6.0, 2.0}
    assert {round(task.upper[0] - task.lower[0], 6) for task in moves} == {1.1, 2.1}


@pytest.mark.parametrize(
    ("task", "row", "cost"),
    [
        (MOVE, {"log_error": 0.0}, 0.0),
        (MOVE, {"log_error": np.log10(1.0 / 0.0015) / 4.0}, 0.25),
        (MOVE, {"log_error": 5.0}, 1.0),
        (MOVE, {"log_error": 0.1, "status": "plant_diverged"}, 1.0),
        ("circle", {"rms_error_evaluated": 0.001}, 0.0),
        ("lemniscate", {"rms_error_evaluated": np.sqrt(0.0015)}, 0.5),
        ("circle", {"rms_error_evaluated": np.nan, "status": "solver_failed"}, 1.0),
    ],
)
def test_the_cost_of_a_run_computed_by_hand(task, row, cost):
    row = {"log_error": np.nan, "status": "completed"} | row
    assert run_cost(task, row) == pytest.approx(WEIGHTS[task] * cost)
    assert np.mean([WEIGHTS[each] for each, _ in KINDS]) == pytest.approx(1.0)


def test_the_cost_of_a_move_is_continuous_and_orders_runs_by_speed_and_rest():
    """An approach exp(−t/τ), a rest, and an error that comes back for a tenth of a second before the end."""
    times = np.arange(0.0, 6.0, 0.05)

    def judged(rate=0.2, rest=0.0005, late=0.0):
        error = np.maximum(0.3 * np.exp(-times / rate), rest)
        error[-3:-1] = np.maximum(error[-3:-1], late)
        row = {"status": "completed", "log_error": log_error(error, 0.005)}
        return run_cost(MOVE, row), settling_time(error, 0.005, 0.05)

    sizes = np.linspace(0.0, 0.02, 401)
    costs, settled = np.array([judged(late=late) for late in sizes]).T
    assert np.isnan(settled).any()  # the error leaves the band
    assert not np.isnan(settled).all()
    assert (np.diff(costs) >= 0.0).all()
    assert np.diff(costs).max() < 5e-4 * costs[0] / 0.05
    rates, rests = np.linspace(0.1, 1.0, 50), np.linspace(0.002, 0.3, 50)
    assert (np.diff([judged(rate=rate)[0] for rate in rates]) > 0.0).all()
    assert (np.diff([judged(rest=rest)[0] for rest in rests]) > 0.0).all()
    slow, fast = judged(rate=0.4)[0], judged(rate=0.2)[0]
    assert slow == pytest.approx(2.0 * fast, rel=0.1)  # it grows in proportion to the settling time


def test_a_better_tuned_controller_has_the_better_score():
    """Resolved-rate control by the true Jacobian: with feedforward it follows the circle, without it lags behind."""
    entry = find_tunable("calibrated")
    trials = [
        Trial("calibrated", apply_settings(entry, {"aids": {"feedforward": switch}}))
        for switch in (True, False)
    ]
    runs = [replace(run, mismatch="moderate") for run in SMALL.runs() if run.task == "circle"]
    costs = np.zeros((2, len(runs)))
    for trial, run, cost in evaluate(trials, runs, Workers()):
        costs[trial, run] = cost
    assert (costs[0] < 0.5 * costs[1]).all()


@pytest.mark.parametrize("name", CHECKED)
def test_committed_values_reach_the_score_in_their_file_and_studies_beat_defaults(name):
    tuned = read_tuned(TUNED[name])
    assert tuned.controller.replace(":", ".") == name
    runs = [tuning_set(tuned).runs()[index] for index in tuning_set(tuned).checked()]
    trial = Trial(tuned.controller, apply_settings(find_tunable(tuned.controller), tuned.settings))
    costs = {run: cost for _, run, cost in evaluate([trial], runs, Workers())}
    assert score([costs[run] for run in range(len(runs))]) == pytest.approx(
        tuned.checked_score, abs=ROUNDING
    )
    if tuned.studies:
        assert tuned.score <= tuned.score_of_defaults
        best = min(tuned.studies, key=lambda study: study.second_score)
        assert tuned.second_score <= best.second_score
        # Those in use before stay
        assert tuned.settings == best.settings or tuned.second_score < best.second_score


def test_committed_values_of_all_methods_have_the_same_budget_on_the_same_runs():
    tuned = [read_tuned(path) for path in TUNED.values()]
    assert len({tuning_set(each) for each in tuned}) == 1
    assert len({tuple((study.seed, study.trials) for study in each.studies) for each in tuned}) == 1
