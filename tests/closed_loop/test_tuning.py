"""Search spaces, the objective, and studies that go on where they stopped."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from optuna.distributions import CategoricalDistribution
from optuna.trial import TrialState

from servobench import controllers
from servobench.harness.batch.compare import TUNING
from servobench.harness.batch.workers import Workers, open_workers
from servobench.harness.config.defaults import apply_settings, default_config
from servobench.harness.config.registry import controller_names, find_controller
from servobench.harness.config.settings import ConfigurationError, flatten
from servobench.harness.studies.tuning import objective, study
from servobench.harness.studies.tuning.files import read_tuned, write_tuned
from servobench.harness.studies.tuning.objective import CURVE, MOVE, Trial, TuningSet, evaluate, run_cost, score
from servobench.harness.studies.tuning.spaces import SPACES, default_values, find_tunable, nested_settings
from servobench.harness.studies.tuning.study import TuningPlan, advance, open_studies, write_outcomes

CORNERS = 64
SMALL = TuningSet(seeds=4)
TUNED = sorted((Path(controllers.__file__).parent / "tuned").glob("*.toml"))
ROUNDING = 0.02  # the circles of ukf_mpc and rbfnn_mfac enlarge it: 0.1.0 differs by so much between two processors


def ends(distribution):
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices
    return distribution.low, distribution.high


def trials_of(folder, plan, workers=1):
    """Carry a plan out and return the numbers tried and the scores of each study."""
    studies = open_studies(folder, plan)
    with open_workers(workers) as place:
        for _ in advance(studies, plan, place):
            pass
    return [[(trial.params, study.trial_score(trial)) for trial in each.finished()] for each in studies]


@pytest.fixture
def made_up(monkeypatch):
    """Runs that cost nothing: the cost is a smooth function of the settings and the run."""

    def cost(trial, run):
        numbers = [value for value in flatten(trial.config).values() if isinstance(value, float)]
        return float(np.tanh(np.sum(np.square(np.array(numbers[:2]) - 0.1))) + 1e-3 * (run.seed % 7))

    def costs(trials, runs, _workers):
        for r, run in enumerate(runs):
            for t, trial in enumerate(trials):
                yield t, r, cost(trial, run)

    monkeypatch.setattr(study, "evaluate", costs)


def test_every_controller_of_this_package_but_one_bound_has_a_space():
    never = {"nmpc_calibrated"}  # a bound that does not look at the camera
    assert set(SPACES) | never == set(controller_names())


@pytest.mark.parametrize("name", SPACES)
def test_a_space_has_three_to_six_parameters_and_the_default_lies_inside(name):
    space, default = SPACES[name], default_values(find_tunable(name))
    assert 3 <= len(space) <= 6
    for key, distribution in space.items():
        assert distribution._contains(distribution.to_internal_repr(default[key])), key
    entry = find_controller(name)
    assert apply_settings(entry, nested_settings(default)) == entry.config()


@pytest.mark.parametrize("name", SPACES)
def test_every_corner_of_a_space_can_be_built_and_keeps_to_the_preview(name):
    space = SPACES[name]
    corners = list(itertools.product(*(ends(distribution) for distribution in space.values())))
    for corner in corners[:: max(1, len(corners) // CORNERS)]:
        settings = nested_settings(dict(zip(space, corner, strict=True)))
        flat = flatten(apply_settings(find_tunable(name), settings))
        reach = [value for key, value in flat.items() if key.endswith(("law.horizon_time", "law.delay"))]
        assert sum(reach) <= 0.5 + 1e-9
        assert all(value >= 1 for key, value in flat.items() if key.endswith("horizon"))


def test_predictive_reach_is_split_into_delay_and_horizon():
    assert nested_settings({"law.reach": 0.45, "law.delay": 0.1, "law.decay": 0.123456}) == {
        "law": {"horizon_time": 0.35, "delay": 0.1, "decay": 0.123}
    }
    assert nested_settings({"reach": 0.3, "delay": 0.0}) == {"horizon_time": 0.3, "delay": 0.0}
    assert "law.reach" in SPACES["ukf_mpc"]


def test_tuned_files_do_not_matter_to_a_trial():
    trial = Trial("rbf_pid", apply_settings(find_tunable("rbf_pid"), {"law": {"integral_gain": 0.5}}))
    assert [run.controller for run in trial.resolved(SMALL.runs()[:1])] == [trial.config]
    assert default_config(find_tunable("rbf_pid")) != find_tunable("rbf_pid").config()


def test_the_set_has_both_delays_equally_often_and_every_run_a_robot_of_its_own():
    runs = TuningSet(seeds=8, offset=100).runs()
    for task, count in ((MOVE, 8), (CURVE, 4)):
        delays = [run.latency for run in runs if run.task == task]
        assert sorted(delays) == [0.0] * (count // 2) + [0.05] * (count // 2)
    seeds = [run.seed for run in runs]
    assert seeds == list(range(TUNING.start + 100, TUNING.start + 112))
    twice = TuningSet(("kinematic", "bullet"), 8).runs()
    assert [run.plant for run in twice] == ["kinematic"] * 12 + ["bullet"] * 12
    assert twice[0].seed == twice[12].seed


def test_the_checked_subset_has_both_tasks_with_both_delays():
    whole = TuningSet(("kinematic", "bullet"), 8)
    checked = [whole.runs()[index] for index in whole.checked()]
    assert [(run.task, run.latency) for run in checked] == [(MOVE, 0.0), (MOVE, 0.05), (CURVE, 0.0), (CURVE, 0.05)]
    assert {run.plant for run in checked} == {"kinematic"}


@pytest.mark.parametrize(
    ("task", "row", "cost"),
    [
        (MOVE, {"settling_time_s": 2.5}, 0.25),
        (MOVE, {"settling_time_s": np.nan}, 1.0),
        (MOVE, {"settling_time_s": 2.5, "status": "feature_lost"}, 2.0),
        (CURVE, {"rms_error_evaluated": 0.01}, 0.2),
        (CURVE, {"rms_error_evaluated": 0.3}, 1.0),
        (CURVE, {"rms_error_evaluated": np.nan, "status": "solver_failed"}, 2.0),
    ],
)
def test_the_cost_of_a_run_computed_by_hand(task, row, cost):
    assert run_cost(task, {"status": "completed"} | row) == pytest.approx(cost)


def test_the_score_is_the_sum_of_the_means_of_both_tasks():
    assert score(SMALL.runs(), [0.1, 0.2, 0.3, 0.4, 0.5, 1.5]) == pytest.approx(0.25 + 1.0)


def test_a_better_tuned_controller_has_the_better_score():
    """Resolved-rate control by the true Jacobian: with feedforward it follows the circle, without it lags behind."""
    entry = find_tunable("calibrated")
    trials = [Trial("calibrated", apply_settings(entry, {"law": {"feedforward": switch}})) for switch in (True, False)]
    runs = [run for run in SMALL.runs() if run.task == CURVE]
    costs = np.zeros((2, len(runs)))
    for trial, run, cost in evaluate(trials, runs, Workers()):
        costs[trial, run] = cost
    assert (costs[0] < 0.5 * costs[1]).all()


def test_the_delay_of_the_set_reaches_the_plant():
    entry = find_tunable("calibrated")
    trial = Trial("calibrated", apply_settings(entry, {"law": {"proportional_gain": 6.0}}))
    prompt, late = (replace(SMALL.runs()[0], latency=latency) for latency in (0.0, 0.05))
    costs = {run: cost for _, run, cost in evaluate([trial], [prompt, late], Workers())}
    assert costs[0] < costs[1]


def test_the_first_trial_is_the_default_of_the_class_and_no_two_are_alike(made_up, tmp_path):
    plan = TuningPlan(("ukf_mfac", "ukf_mpc"), 6, SMALL)
    for name, trials in zip(plan.controllers, trials_of(tmp_path, plan), strict=True):
        assert trials[0][0] == default_values(find_tunable(name))
        assert len({str(params) for params, _ in trials}) == 6


def test_the_sampler_finds_better_values_than_the_default(made_up, tmp_path):
    (trials,) = trials_of(tmp_path, TuningPlan(("rls",), 25, SMALL))
    scores = [value for _, value in trials]
    assert min(scores[10:]) < scores[0]
    assert np.median(scores[10:]) < np.median(scores[:10])


def test_a_study_taken_up_again_is_that_which_was_never_interrupted(made_up, tmp_path):
    names = ("ukf_mfac", "broyden")
    whole = trials_of(tmp_path / "whole", TuningPlan(names, 14, SMALL))
    trials_of(tmp_path / "parts", TuningPlan(names[:1], 3, SMALL))
    stopped = TuningPlan(names, 12, SMALL)
    halfway = advance(open_studies(tmp_path / "parts", stopped), stopped, Workers())
    for _ in range(100):  # leaves in the middle of a round, as a kill does
        next(halfway)
    del halfway
    for name in names:
        with (tmp_path / "parts" / f"{name}.journal").open("ab") as journal:
            journal.write(b'{"op_code": 6, "worker_id": "cut')
    assert trials_of(tmp_path / "parts", TuningPlan(names, 14, SMALL)) == whole
    (one, _) = open_studies(tmp_path / "parts", TuningPlan(names, 14, SMALL))
    assert len(one._study.get_trials(states=(TrialState.FAIL,))) == 1


def test_another_seed_of_the_study_tries_other_values(made_up, tmp_path):
    first, second = (
        trials_of(tmp_path / str(seed), TuningPlan(("rls",), 4, SMALL, study_seed=seed))[0] for seed in (0, 1)
    )
    assert first[0] == second[0]
    assert all(mine != theirs for mine, theirs in zip(first[1:], second[1:], strict=True))


def test_a_smaller_budget_looks_at_its_own_trials_alone(made_up, tmp_path):
    long = trials_of(tmp_path, TuningPlan(("rls",), 8, SMALL))[0]
    assert trials_of(tmp_path, TuningPlan(("rls",), 3, SMALL))[0] == long[:3]
    outcome = open_studies(tmp_path, TuningPlan(("rls",), 3, SMALL))[0].outcome()
    assert (outcome.trials, outcome.score) == (3, min(value for _, value in long[:3]))


def test_any_number_of_workers_gives_the_same_studies_and_files_say_what_they_hold(tmp_path):
    plan = TuningPlan(("broyden",), 2, SMALL)
    assert trials_of(tmp_path / "one", plan) == trials_of(tmp_path / "two", plan, workers=2)
    written = write_outcomes(tmp_path / "one", open_studies(tmp_path / "one", plan))
    for name, tuned in written.items():
        found = read_tuned(tmp_path / "one" / f"{name}.toml")
        assert found == tuned
        assert found.tuning_set() == SMALL
        assert (found.trials, found.runs_a_trial, found.seeds) == (2, 6, (10_000, 10_005))
        assert_checked_score(found)
        assert checked_score(found, {}) == pytest.approx(found.checked_score_of_defaults, abs=ROUNDING)


def checked_score(tuned, settings):
    runs = [tuned.tuning_set().runs()[index] for index in tuned.tuning_set().checked()]
    trial = Trial(tuned.controller, apply_settings(find_tunable(tuned.controller), settings))
    costs = {run: cost for _, run, cost in evaluate([trial], runs, Workers())}
    return score(runs, [costs[run] for run in range(len(runs))])


def assert_checked_score(tuned):
    assert checked_score(tuned, tuned.settings) == pytest.approx(tuned.checked_score, abs=ROUNDING)
    assert tuned.checked_score <= tuned.checked_score_of_defaults
    assert tuned.score <= tuned.score_of_defaults


@pytest.mark.parametrize("path", TUNED, ids=[path.stem for path in TUNED])
def test_committed_values_reach_the_score_that_their_file_states_and_beat_the_defaults_of_the_class(path):
    tuned = read_tuned(path)
    assert tuned.controller == path.stem
    assert_checked_score(tuned)


def test_committed_values_of_all_methods_have_the_same_budget_on_the_same_runs():
    budgets = {(tuned.trials, tuned.study_seed, tuned.tuning_set()) for tuned in map(read_tuned, TUNED)}
    assert len(budgets) <= 1


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"runs": TuningSet(seeds=8)}, "seeds"),
        ({"runs": TuningSet(seeds=4, offset=50)}, "seeds"),
        ({"runs": TuningSet(("bullet",), 4)}, "plants"),
        ({"study_seed": 1}, "study seed"),
    ],
)
def test_a_study_of_something_else_is_refused_and_no_other_is_begun(made_up, tmp_path, change, part):
    plan = TuningPlan(("rls",), 1, SMALL)
    trials_of(tmp_path, plan)
    other = TuningPlan(**{"controllers": ("broyden", "rls"), "trials": 1, "runs": SMALL} | change)
    with pytest.raises(ConfigurationError, match=f"rls.journal was made with other {part}; name another folder"):
        open_studies(tmp_path, other)
    assert not (tmp_path / "broyden.journal").exists()


def test_a_study_of_another_objective_or_search_space_is_refused(made_up, tmp_path, monkeypatch):
    plan = TuningPlan(("rls",), 1, SMALL)
    trials_of(tmp_path, plan)
    monkeypatch.setattr(objective, "RMS_SATURATION", 0.1)
    monkeypatch.setattr(study, "SPACES", {"rls": SPACES["broyden"]})
    with pytest.raises(ConfigurationError, match="was made with other search space, objective; name another folder"):
        open_studies(tmp_path, plan)


def test_a_study_in_use_by_another_call_is_refused(made_up, tmp_path):
    plan = TuningPlan(("rls",), 2, SMALL)
    (first,) = open_studies(tmp_path, plan)
    first.ask()
    open_studies(tmp_path, plan)  # takes the trial for one that was killed
    with pytest.raises(ConfigurationError, match="rls.journal is in use by another call of tune"):
        first.tell([0.0] * 6)


def test_a_file_that_is_no_study_is_refused(tmp_path):
    (tmp_path / "rls.journal").write_text("hello\nworld")
    with pytest.raises(ConfigurationError, match="rls.journal cannot be opened"):
        open_studies(tmp_path, TuningPlan(("rls",), 1, SMALL))
    assert (tmp_path / "rls.journal").read_text().startswith("hello\nworld")


def test_costs_without_a_trial_are_refused(tmp_path):
    (made,) = open_studies(tmp_path, TuningPlan(("rls",), 1, SMALL))
    with pytest.raises(ValueError, match="a trial must be asked for"):
        made.tell([0.0] * 6)


@pytest.mark.parametrize("text", ["score = \n", "score = 1.0\n", "plants = []\nseeds = []\n"])
def test_a_malformed_file_of_tuned_values_is_refused(tmp_path, text):
    path = tmp_path / "rls.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match="rls.toml cannot be read"):
        read_tuned(path)


def test_words_with_quotes_survive_the_file(made_up, tmp_path):
    plan = TuningPlan(("rls",), 1, SMALL)
    trials_of(tmp_path, plan)
    (made,) = open_studies(tmp_path, plan)
    odd = replace(made.outcome(), version='1.0+"a"\\b', settings={"law": {"kind": 'x"y', "inner": {"on": True}}})
    write_tuned(tmp_path / "odd.toml", odd)
    assert read_tuned(tmp_path / "odd.toml") == odd
