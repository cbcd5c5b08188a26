"""The scripts in docs/examples run as they stand and print what they promise."""

import re
import runpy

import numpy as np
import pytest

import servobench
from kit.documents import ROOT
from kit.nightly import some
from servobench.harness.gym.environment import ServoEnv, ServoVectorEnv

FOLDER = ROOT / "docs" / "examples"
EXAMPLES = {
    "own_controller": r"ResolvedRate +\d.*\n.*constant.*\n.*ukf_mfac",
    "fmu_in_fmpy": r"nominal: ball at \[.*\n.*off by 3°: ball at",
    "what_if": r" 2\.0 +0 +\d\.\d +\d\.\d\n(.*\n)* +10\.0 +90 +4\d\d\.\d",
    "sweep_in_pandas": r"completed +18\n(.*\n)*.*constant +ukf_mfac\n",
}


LOOKING = {"look_then_move"}  # tested below
LEARNING = {"train_policy"}  # tested below
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


@pytest.fixture
def training():
    """Return the names of the training, with few robots and steps."""
    names = runpy.run_path(str(FOLDER / "train_policy.py"))
    names["train"].__globals__.update(LANES=16, STEPS=80, BATCH=128)
    return names


@pytest.mark.slow
def test_a_policy_learns_and_acts_from_its_file_as_in_its_training(training, tmp_path):
    """The written file, in a run of the harness, gives the actions of the network in numpy; its memory is in use."""
    network = training["train"](3, 0)
    path = tmp_path / "policy.onnx"
    training["write"](network, path)
    settings = {"random": {"duration": 1.5}}
    made = servobench.run(str(path), task="random", plant="kinematic", seed=4, settings=settings)
    commands = made.steps.filter(regex="^joint_velocity_command_").to_numpy()
    env = ServoEnv(settings=settings)
    seen, _ = env.reset(seed=4)
    memory = np.zeros((1, network.layout.memory), np.float32)
    for command in commands:
        x, memory = network.remember(seen[None], memory)
        action = np.clip(network.act(x)[0], -1.0, 1.0)
        np.testing.assert_allclose(action, command, atol=1e-5)
        seen, *_ = env.step(command)
    env.close()
    assert len(commands) == 30
    inputs, answers = training["episode"](ServoVectorEnv(16), network, 77, 1.0)
    untrained = training["Network"](network.layout, 0)
    losses = [each.learn(inputs, answers, 0.0) for each in (network, untrained)]
    assert losses[0] < 0.6 * losses[1]


def test_a_step_of_the_training_goes_down_the_slope_of_the_loss(training):
    """Against differences of the loss: the first step of Adam is the rate against the sign of each slope."""
    rng = np.random.default_rng(0)
    network = training["Network"](training["Layout"](6, 3, 51), 0)
    network.parameters = [each.astype(float) for each in network.parameters]
    inputs = rng.normal(size=(8, len(network.mean)))
    answers = rng.normal(size=(8, 6))
    before = [each.copy() for each in network.parameters]
    network.learn(inputs, answers, 1e-3)
    for k, parameter in enumerate(before):
        place = (0,) * parameter.ndim
        found = []
        for change in (1e-6, -1e-6):
            other = training["Network"](network.layout, 0)
            other.parameters = [each.copy() for each in before]
            other.parameters[k][place] += change
            found.append(other.learn(inputs, answers, 0.0))
        went = network.parameters[k][place] - parameter[place]
        assert np.sign(went) == -np.sign(found[0] - found[1])
        assert abs(went) == pytest.approx(1e-3, rel=1e-3)


def test_the_teacher_of_the_training_brings_every_robot_to_its_target(training):
    envs = ServoVectorEnv(16, settings={"random": {"duration": 4.0}})
    seen, _ = envs.reset(seed=6)
    teacher = training["Teacher"](16, 6)
    target = envs.observation.feature + seen[:, 9:12]
    for _ in range(79):
        action = np.clip(teacher.wanted(envs.truth, target), -1.0, 1.0)
        teacher.follow(action)
        *_, info = envs.step(action)
    envs.close()
    assert (info["error"] < 1e-4).all()
