"""The scripts in docs/examples run as they stand and print what they promise."""

import re
import runpy
import shutil
import sys
from itertools import pairwise

import numpy as np
import pytest

import servobench
from kit.documents import ROOT
from kit.nightly import some
from servobench.harness.gym.environment import ServoEnv

FOLDER = ROOT / "docs" / "examples"
EXAMPLES = {
    "own_controller": r"ResolvedRate +\d.*\n.*constant.*\n.*ukf_mfac",
    "fmu_in_fmpy": r"nominal: ball at \[.*\n.*off by 3°: ball at",
    "what_if": r" 2\.0 +0 +\d\.\d +\d\.\d\n(.*\n)* +10\.0 +90 +4\d\d\.\d",
    "sweep_in_pandas": r"completed +18\n(.*\n)*.*constant +ukf_mfac\n",
}


LOOKING = {"look_then_move"}  # tested below
LEARNING = {"train_policy", "learned_policy"}  # tested below
ROBOTS = {"on_a_ur", "on_ros2"}  # tests/apps/serve
MOTIONS = {"excite"}  # tests/harness/test_identification.py moves an arm by it
LAWS = {
    "damped_inverse": "DampedInverse",
    "kalman_inverse": "KalmanInverse",
    "trained_inverse": "TrainedInverse",
}


def test_every_example_is_listed_here():
    assert {path.stem for path in FOLDER.glob("*.py")} == {
        *EXAMPLES,
        *LOOKING,
        *LEARNING,
        *LAWS,
        *MOTIONS,
        *ROBOTS,
    }


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs_and_prints(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(EXAMPLES[name], printed), printed


def test_a_robot_that_looks_and_then_moves_errs_by_its_calibration():
    look = f"{FOLDER / 'look_then_move.py'}:LookThenMove"

    def error(mismatch):
        made = servobench.run(look, task="random", mismatch=mismatch, seed=88700)
        assert made.row["status"] == "completed"
        return made.row["steady_state_error"]

    assert error("none") < 1e-9
    # About an axis through the middle of the workspace, from which targets are up to 0.3 m away
    assert 0.003 < error("camera_rotation=3deg") < 0.3 * np.radians(3.0)
    assert error("camera_rotation=3deg") == pytest.approx(
        3.0 * error("camera_rotation=1deg"), rel=0.02
    )


@pytest.mark.parametrize("law", LAWS)
def test_a_law_of_ones_own_keeps_the_contract_of_controllers(law):
    assert servobench.check_controller(f"{FOLDER / law}.py:{LAWS[law]}").ok


@pytest.mark.parametrize("law", some(LAWS, "damped_inverse"))
def test_a_law_of_ones_own_keeps_up_with_a_method_of_the_bench_only_with_the_aids(law):
    place = f"{FOLDER / law}.py:{LAWS[law]}"
    names = [LAWS[law], f"{LAWS[law]}Alone", "ukf_mfac"]
    short = {"random": {"duration": 3.0}, "circle": {"lap_time": 4.0, "radius": 0.15}}
    runs = servobench.compare(
        [place, f"{place}Alone", names[2]], tasks=list(short), seeds=2, settings=short
    )
    middle = runs.groupby(["task", "controller"])[
        ["settling_time_s", "rms_error_evaluated"]
    ].median()
    own, alone, method = (middle.loc["random", "settling_time_s"][name] for name in names)
    assert own < 1.5 * method
    assert own < alone
    own, alone, method = (middle.loc["circle", "rms_error_evaluated"][name] for name in names)
    assert own < 1.5 * method
    assert alone > 10.0 * own


def test_a_learned_policy_is_the_network_that_was_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(FOLDER / "learned_policy.py", tmp_path)
    env, rng = ServoEnv(task="exp2"), np.random.default_rng(0)
    seen, _ = env.reset(seed=2)
    sizes = (len(seen), 5, 4, 6)
    layers = [(rng.normal(0.0, 0.3, (m, n)), rng.normal(0.0, 0.1, m)) for n, m in pairwise(sizes)]
    np.savez("policy.npz", *(part.astype(np.float32) for layer in layers for part in layer))
    steps = servobench.run("./learned_policy.py", task="exp2", seed=2).steps
    (w1, b1), (w2, b2), (w3, b3) = [
        tuple(part.astype(np.float32).astype(float) for part in each) for each in layers
    ]
    for feature in steps.filter(regex="^feature_.*_m$").to_numpy()[:40]:
        np.testing.assert_allclose(env.observation.feature, feature, rtol=1e-12)
        seen, *_ = env.step(w3 @ np.tanh(w2 @ np.tanh(w1 @ seen + b1) + b2) + b3)
    env.close()


def test_a_policy_is_trained_and_written(tmp_path, monkeypatch, capsys):
    pytest.importorskip(
        "stable_baselines3", reason="Stable-Baselines3 is not installed, and no requirement"
    )
    monkeypatch.setattr(
        sys, "argv", ["train_policy.py", "--steps", "1", "--out", str(tmp_path / "policy.npz")]
    )
    runpy.run_path(str(FOLDER / "train_policy.py"), run_name="__main__")
    assert "policy.npz: trained for 1 steps" in capsys.readouterr().out
    with np.load(tmp_path / "policy.npz") as kept:
        shapes = [kept[name].shape for name in kept.files]
    assert [shape[0] for shape in shapes] == [64, 64, 64, 64, 6, 6]
