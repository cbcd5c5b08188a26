"""Controllers in C: rows of numpy up to rounding, the same bits alone and beside others, and what goes on in numpy."""

from pathlib import Path

import numpy as np
import pytest

import servobench
from kit.lanes import assert_rows_of_single_runs, rows
from kit.nightly import some
from servobench.controllers.laws.mfac import MfacLaw
from servobench.controllers.methods import METHODS
from servobench.fmus.controllers.record import Recorded
from servobench.harness.config.settings import Settings
from servobench.harness.run import compiled
from servobench.harness.run.episode import carry_out, carry_out_together
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract import cache

EXAMPLE = Path(__file__).parents[2] / "docs/examples/nominal-rate/nominal_rate.py"
SEEDS = (40011, 40012, 40013, 40014)
# Camera latency and lost frames, on moves that are short
ROUGH = {
    "kinematic": {"sensing": {"drop_probability": 0.1, "latency": 0.05}},
    "random": {"duration": 2.5},
}
# An optimiser and a fitted arm have no form in C
WITHOUT = ("calibrating_mfac", "ukf_mpc", "ukf_mpc:published")
TRACED = [
    name
    for name, entry in METHODS.items()
    if entry.side_by_side and not entry.needs_truth and name not in WITHOUT
]


def runs(controller, in_c, settings=ROUGH, mismatch="severe", sensing="position"):
    own = {**settings, "run": {**settings.get("run", {}), "compiled": in_c}}
    return [
        resolve(
            RunRequest("kinematic", controller, "random", mismatch, seed, sensing=sensing),
            Settings(own),
        )
        for seed in SEEDS
    ]


def assert_near(found, wanted):
    """Compare rows of runs in C with those in numpy."""
    for one, other in zip(found, wanted, strict=True):
        assert one.keys() == other.keys()
        for name, value in other.items():
            if isinstance(value, float):
                assert one[name] == pytest.approx(value, rel=1e-9, abs=1e-9, nan_ok=True), name
            else:
                assert one[name] == value, name


@pytest.mark.slow
@pytest.mark.parametrize("controller", some(TRACED, "regression_mfac", "ukf_mfac:published"))
def test_rows_are_those_of_numpy_and_of_each_run_alone(controller, monkeypatch):
    monkeypatch.setattr(compiled, "_FOUND", {})
    together = runs(controller, in_c=True)
    in_c = assert_rows_of_single_runs(together)
    assert [type(each) for each in compiled._FOUND.values()] == [Recorded]
    assert_near(in_c, rows(carry_out_together(runs(controller, in_c=False))))


@pytest.mark.slow
@pytest.mark.parametrize("period", some((0.008, 0.02, 0.028), 0.02))
def test_rows_at_short_periods_are_those_of_numpy(period):
    settings = {"run": {"period": period}, "random": {"duration": 1.0}}
    in_c = rows(carry_out_together(runs("ukf_mfac", True, settings)))
    assert_near(in_c, rows(carry_out_together(runs("ukf_mfac", False, settings))))


@pytest.mark.slow
def test_pixels_and_lost_features_are_those_of_numpy():
    settings = {
        "kinematic": {"sensing": {"drop_probability": 0.65}},
        "run": {"lost_after": 0.45},
        "random": {"duration": 2.5},
    }
    in_c = assert_rows_of_single_runs(
        runs("ukf_mfac", in_c=True, settings=settings, sensing="pixel")
    )
    assert {row["status"] for row in in_c} == {"completed", "feature_lost"}
    assert_near(in_c, rows(carry_out_together(runs("ukf_mfac", False, settings, sensing="pixel"))))


@pytest.mark.slow
def test_a_command_that_is_not_finite_ends_only_its_run(monkeypatch, tmp_path):
    monkeypatch.setattr(compiled, "_FOUND", {})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # for a step that is not this package's
    command = MfacLaw.command

    def fragile(self, state, estimate, observation, reference):
        state, velocity = command(self, state, estimate, observation, reference)
        bad = (observation.time > 0.3) & (observation.feature[..., 0] > 0.05)
        return state, np.where(bad[..., None], np.inf, velocity)

    together = runs("ukf_mfac:published", in_c=True)
    monkeypatch.setattr(MfacLaw, "command", fragile)
    in_c = assert_rows_of_single_runs(together)
    assert {row["status"] for row in in_c} == {"completed", "controller_diverged"}
    wanted = rows(carry_out_together(runs("ukf_mfac:published", in_c=False)))
    for one, other in zip(in_c, wanted, strict=True):
        reasons = one.pop("reason"), other.pop("reason")
        assert bool(reasons[0]) == bool(reasons[1])
    assert_near(in_c, wanted)


@pytest.mark.parametrize(
    ("controller", "settings", "why"),
    [
        ("calibrating_mfac", {}, "it cannot be compiled while it fits the arm"),
        ("nmpc_calibrated", {}, "it cannot be compiled: it is given the true robot"),
        ("ukf_mpc", {}, "it holds something that is no formula, such as a solver"),
        ("rls", {"kinematic": {"sensing": {"stamps": True}}}, "frames are stamped"),
    ],
)
def test_what_has_no_form_in_c_goes_on_in_numpy_and_says_so(controller, settings, why, monkeypatch):
    said = []
    monkeypatch.setattr(compiled, "remark", said.append)
    run, *_ = runs(controller, in_c=True, settings={**settings, "random": {"duration": 0.1}})
    experiment = build(run)
    assert compiled.chosen(run, experiment) is experiment.controller
    assert said[0].startswith(f"controller {controller!r} goes on in numpy: {why}")


def test_a_step_is_recorded_once_for_all_processes(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    recorded = []

    def record_step(*given):
        recorded.append(given)
        return original(*given)

    original = compiled.record_step
    monkeypatch.setattr(compiled, "record_step", record_step)
    short = {"random": {"duration": 0.1}}
    slower = {**short, "kinematic": {"max_joint_speed": 1.0 - 1e-12}}

    def steps_recorded(settings, name="constant"):
        """Return how many steps a new process records."""
        monkeypatch.setattr(compiled, "_FOUND", {})
        recorded.clear()
        run, *_ = runs(name, in_c=True, settings=settings)
        assert carry_out(run).row["status"] == "completed"
        assert [type(each) for each in compiled._FOUND.values()] == [Recorded]
        return len(recorded)

    assert [steps_recorded(short), steps_recorded(short), steps_recorded(slower)] == [1, 0, 1]
    for path in tmp_path.rglob(compiled.RECORDED):
        path.write_text("{}")  # which its checksum does not fit
    cache._verified.clear()
    assert steps_recorded(short) == 1
    monkeypatch.setattr(compiled, "_package_digest", lambda: "other code")
    assert [steps_recorded(short), steps_recorded(short)] == [1, 0]


def test_without_a_compiler_numpy_goes_on(monkeypatch):
    said = []
    monkeypatch.setattr(compiled, "remark", said.append)
    monkeypatch.setattr(compiled, "_FOUND", {})
    monkeypatch.setenv("CC", "/nothing/cc")
    run, *_ = runs("constant", in_c=True, settings={"random": {"duration": 0.1}})
    assert carry_out(run).row["status"] == "completed"
    assert "'constant' goes on in numpy" in said[0]
    assert "CC names '/nothing/cc'" in said[0]
    assert compiled.describe_compilation() == ""


def test_an_estimator_of_a_users_is_compiled_with_the_rest(monkeypatch):
    monkeypatch.setattr(compiled, "_FOUND", {})
    place = f"{EXAMPLE}:BROYDEN_ENTRY"
    found = []
    for in_c in (False, True):
        settings = {"run": {"compiled": in_c}, "random": {"duration": 1.0}}
        found.append(servobench.compare([place], tasks=("random",), seeds=2, settings=settings))
    assert [type(each) for each in compiled._FOUND.values()] == [Recorded]
    assert_near(*(each[["rms_error", "outcome"]].to_dict("records") for each in found))
