from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from kit.lanes import alone as one_by_one
from kit.lanes import assert_rows_of_single_runs, rows
from kit.nightly import some
from kit.plants import NEEDS_BULLET
from servobench.controllers.laws.mfac import MfacLaw
from servobench.controllers.methods import METHODS
from servobench.harness.config.settings import Settings
from servobench.harness.run import sampling
from servobench.harness.run.episode import carry_out_together
from servobench.harness.run.lanes import side_by_side_key
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.faults import FilterDiverged

CALIBRATION = Path(__file__).parents[2] / "plant/data/ur5_factory_calibration.yaml"
ROUGH = {
    "kinematic": {"sensing": {"drop_probability": 0.1, "latency": 0.05}},
    "random": {"duration": 2.5},
}


def lossy(probability, periods):
    sensing = {"kinematic": {"sensing": {"drop_probability": probability}}}
    return {**sensing, "run": {"lost_after": 0.05 * periods}, "random": {"duration": 2.5}}


SEEDS = (40001, 40002, 40003, 40004, 40005)


def runs(controller, settings, plant="kinematic", mismatch="severe", task="random"):
    return [
        resolve(RunRequest(plant, controller, task, mismatch, seed), Settings(settings))
        for seed in SEEDS
    ]


SIDE_BY_SIDE = [name for name in METHODS if METHODS[name].side_by_side]


@pytest.mark.slow
@pytest.mark.parametrize(
    "controller", some(SIDE_BY_SIDE, "regression_mfac", "ukf_mpc", "rbf_pid:published", "rls")
)
def test_rows_of_runs_side_by_side_are_those_of_each_run_alone(controller):
    together = runs(controller, ROUGH, mismatch="severe+camera_move=60deg")
    assert side_by_side_key(together[0]) is not None
    alone = one_by_one(together)
    found = carry_out_together(together)
    np.testing.assert_equal(rows(found), alone)
    times = [found[0].row[name] for name in found[0].row.keys() - rows(found)[0].keys()]
    assert np.isnan(times).all()  # of a run among others they are unknown
    assert times
    np.testing.assert_equal(
        rows(carry_out_together([together[4], together[1]])), [alone[4], alone[1]]
    )


def test_methods_share_the_robots_they_meet_but_those_of_files_are_drawn_anew(monkeypatch):
    drawn = []
    draw = sampling.draw

    def counted(resolved):
        drawn.append(resolved.request.seed)
        return draw(resolved)

    monkeypatch.setattr(sampling, "draw", counted)
    monkeypatch.setattr(sampling, "_kept", lru_cache(8)(counted))
    short = {"random": {"duration": 0.1}}
    first = rows(carry_out_together(runs("rls", short)))
    assert drawn == list(SEEDS)
    carry_out_together(runs("constant", short))
    assert drawn == list(SEEDS)
    np.testing.assert_equal(rows(carry_out_together(runs("rls", short))), first)
    carry_out_together(runs("rls", {**short, "run": {"period": 0.02}}))
    assert drawn == [*SEEDS, *SEEDS]
    sampling.draw_once(runs("rls", short, mismatch=f"factory={CALIBRATION}")[0])
    sampling.draw_once(runs("rls", short, mismatch=f"factory={CALIBRATION}")[0])
    assert drawn == [*SEEDS, *SEEDS, SEEDS[0], SEEDS[0]]


def test_runs_with_a_disturbed_sensor_go_side_by_side_but_not_with_others():
    words = "moderate+stable=1.3+outliers=20%+occlusions=10%+jitter=80ms"
    together = runs("ukf_mfac:published", {"random": {"duration": 2.5}}, mismatch=words)
    assert together[0].plant.sensing.outliers == 0.2
    assert side_by_side_key(together[0]) != side_by_side_key(
        runs("ukf_mfac:published", {}, mismatch="moderate")[0]
    )
    alone = assert_rows_of_single_runs(together)
    assert len(
        {row["valid_share"] if "valid_share" in row else row["rms_error"] for row in alone}
    ) == len(SEEDS)


@pytest.mark.parametrize(
    ("settings", "ends"),
    [(lossy(0.7, 9), {"completed", "feature_lost"}), (lossy(0.99, 3), {"feature_lost"})],
)
def test_runs_that_lose_the_feature_leave_the_others_alone_and_have_their_rows(settings, ends):
    assert {row["status"] for row in assert_rows_of_single_runs(runs("ukf_mfac", settings))} == ends


@pytest.mark.parametrize(
    "kind", [FilterDiverged, FloatingPointError, np.linalg.LinAlgError, KeyError]
)
def test_whatever_a_part_raises_ends_only_the_runs_that_it_concerns(kind, monkeypatch):
    command = MfacLaw.command

    def fragile(self, state, estimate, observation, reference):
        bad = (observation.time > 0.3) & (observation.feature[..., 0] > 0.05)
        if np.any(bad):
            raise kind(f"the feature is at {observation.feature[..., 0].tolist()}")
        return command(self, state, estimate, observation, reference)

    together = runs("ukf_mfac:published", ROUGH)
    monkeypatch.setattr(MfacLaw, "command", fragile)
    assert {"completed"} < {row["status"] for row in assert_rows_of_single_runs(together)}


@NEEDS_BULLET
def test_plug_ins_and_rendered_plants_go_alone():
    assert side_by_side_key(runs("nmpc_calibrated", {})[0]) is None
    assert side_by_side_key(runs("ukf_mfac", {}, plant="bullet")[0]) is None
