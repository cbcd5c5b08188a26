"""Policies in ONNX files as controllers: they see what the environment shows, keep their memory, or are refused."""

import json

import numpy as np
import onnxruntime
import pytest
from onnx import TensorProto

import servobench
from kit.policies import write_linear, write_policy, write_sum
from servobench.controllers.controller import RobotKnowledge
from servobench.harness.config.entries import NoSettings
from servobench.harness.config.registry import find_controller
from servobench.harness.gym.environment import ServoEnv, ServoVectorEnv
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import Observation, PlantSpec

SHORT = {"random": {"duration": 1.0}}
STAMPED = {"kinematic": {"sensing": {"stamps": True}}}


def two_joints(preview=0) -> RobotKnowledge:
    """Return an arm of two joints with one feature: an observation has 2 + 1 + 1 + 1 + 2 numbers without a preview."""
    spec = PlantSpec.of_joints(("a", "b"), ("x",), [2.0, 4.0], [-3.0] * 2, [3.0] * 2, 0.1)
    return RobotKnowledge(spec, preview)


def built(path, preview=0):
    return find_controller(f"onnx:{path}").build(NoSettings(), two_joints(preview))


def seen(time=0.0, joints=(0.0, 0.0), feature=0.0):
    return Observation(time, np.array(joints), np.array([feature]), feature_valid=True)


@pytest.mark.parametrize(("settings", "more"), [({}, 0), (STAMPED, 2)])
def test_a_policy_acts_as_it_does_in_the_environment(settings, more, tmp_path):
    env = ServoEnv(settings=settings | SHORT)
    observed, _ = env.reset(seed=3)
    assert len(observed) == 51 + more
    rng = np.random.default_rng(0)
    path = write_linear(tmp_path / "linear.onnx", rng.normal(0.0, 0.1, (51 + more, 6)), "batch")
    session = onnxruntime.InferenceSession(path)
    made = servobench.run(
        f"onnx:{path}", task="random", plant="kinematic", seed=3, settings=settings | SHORT
    )
    features = made.steps.filter(regex=r"^feature_.*_m$").to_numpy()
    assert len(features) == 20
    for feature in features:
        np.testing.assert_array_equal(env.observation.feature, feature)
        (action,) = session.run(None, {"observation": observed[None]})
        observed, *_ = env.step(action[0])
    env.close()


def test_memory_is_kept_through_a_run_and_forgotten_at_its_begin(tmp_path):
    """By hand: the error 2 is seen at first, and then 1; the action is a tenth and a fifth of their sum."""
    weights = np.zeros((7, 2))
    weights[3] = 0.1, 0.2  # after two joints and a feature
    policy = built(write_sum(tmp_path / "sum.onnx", weights))
    wanted = [[2.0 * 0.2, 4.0 * 0.4], [2.0 * 0.3, 4.0 * 0.6]]  # shares times the limits
    for _ in range(2):
        policy.reset(seen(), 0)
        for k, error in enumerate((2.0, 1.0)):
            command = policy.step(seen(0.1 * k), np.array([[error]]))
            np.testing.assert_allclose(command.joint_velocity, wanted[k], rtol=1e-6)


def test_the_last_action_is_seen_and_a_command_keeps_the_limits(tmp_path):
    """By hand: the first joint adds a half to its last action, and the second one asks for ten times its limit."""
    policy = built(
        write_policy(
            tmp_path / "add.onnx",
            ["last = MatMul(observation, weights)", "action = Add(last, half)"],
            {"observation": [1, 7]},
            {"action": [1, 2]},
            {
                "weights": np.eye(7, 2, -5, dtype=np.float32),
                "half": np.array([[0.5, 10.0]], np.float32),
            },
        )
    )
    policy.reset(seen(), 0)
    commands = [policy.step(seen(0.1 * k), np.zeros((1, 1))).joint_velocity for k in range(3)]
    np.testing.assert_allclose(commands, [[1.0, 4.0], [2.0, 4.0], [2.0, 4.0]], rtol=1e-6)


def test_a_saved_memory_goes_on_where_it_was(tmp_path):
    policy = built(write_sum(tmp_path / "sum.onnx", np.full((7, 2), 0.1)))
    policy.reset(seen(), 0)
    policy.step(seen(), np.ones((1, 1)))
    state = policy.save()
    first = policy.step(seen(0.1), np.ones((1, 1))).joint_velocity
    policy.step(seen(0.2), np.ones((1, 1)))
    policy.restore(state)
    np.testing.assert_array_equal(policy.step(seen(0.1), np.ones((1, 1))).joint_velocity, first)


def test_two_policies_of_one_file_have_memories_of_their_own(tmp_path):
    path = write_sum(tmp_path / "sum.onnx", np.full((7, 2), 0.1))
    alone, other = built(path), built(path)
    for each in (alone, other):
        each.reset(seen(), 0)
    commands = [alone.step(seen(), np.ones((1, 1))).joint_velocity for _ in range(2)]
    np.testing.assert_array_equal(other.step(seen(), np.ones((1, 1))).joint_velocity, commands[0])
    assert (commands[0] != commands[1]).all()


def not_a_model(path):
    path.write_text("no model")


def without_an_output_of_its_memory(path):
    write_policy(
        path,
        ["sum = Add(state, observation)", "action = MatMul(sum, weights)"],
        {"observation": [1, 7], "state": [1, 7]},
        {"action": [1, 2]},
        {"weights": np.zeros((7, 2), np.float32)},
    )


def of_double_precision(path):
    write_policy(
        path,
        ["action = MatMul(observation, weights)"],
        {"observation": [1, 7]},
        {"action": [1, 2]},
        {"weights": np.zeros((7, 2))},
        TensorProto.DOUBLE,
    )


@pytest.mark.parametrize(
    ("write", "line"),
    [
        (lambda path: None, "NO_SUCHFILE"),
        (not_a_model, "Protobuf parsing failed"),
        (
            lambda path: write_linear(path, np.zeros((8, 2))),
            "takes 8 numbers, an observation has 7",
        ),
        (lambda path: write_linear(path, np.zeros((7, 3))), r"must have shape \(2,\), got \(3,\)"),
        (without_an_output_of_its_memory, "state_next"),
        (lambda path: write_sum(path, np.zeros((7, 2)), [1, 1]), "state"),
        (of_double_precision, "expected: .tensor.double"),
    ],
)
def test_a_file_that_is_no_policy_for_the_robot_is_refused_in_a_line(write, line, tmp_path):
    path = tmp_path / "policy.onnx"
    write(path)
    with pytest.raises(ConfigurationError, match=line) as refused:
        built(path)
    assert "\n" not in str(refused.value)


def test_a_preview_that_a_policy_was_not_trained_with_is_named(tmp_path):
    path = write_linear(tmp_path / "policy.onnx", np.zeros((7, 2)))
    with pytest.raises(ConfigurationError, match=r"an observation has 8; run\.preview_time"):
        built(path, preview=1)


def test_an_answer_that_is_no_number_ends_the_run_and_is_its_reason(tmp_path):
    """The root of the error: negative at a target below the camera's axis."""
    path = write_policy(
        tmp_path / "root.onnx",
        ["root = Sqrt(observation)", "action = MatMul(root, weights)"],
        {"observation": [1, 51]},
        {"action": [1, 6]},
        {"weights": np.ones((51, 6), np.float32)},
    )
    row = servobench.run(f"onnx:{path}", task="random", plant="kinematic", seed=3).row
    assert row["status"] == "crashed"
    assert "action must be finite" in row["reason"]


@pytest.mark.slow
def test_a_sweep_takes_a_policy_under_a_name_and_its_folder_only_that_file(own_folder, tmp_path):
    path = write_linear(tmp_path / "mine.onnx", np.zeros((51, 6)))
    asked = {"tasks": ["random"], "plants": ["kinematic"], "settings": SHORT, "seeds": 2}
    names = ["constant", "rest=mine.onnx"]
    runs = servobench.compare(controllers=names, workers=2, out="many", **asked)
    alone = servobench.run(
        "onnx:mine.onnx", task="random", plant="kinematic", seed=1, settings=SHORT
    )
    assert runs["status"].tolist() == ["completed"] * 4
    (swept,) = runs[(runs["controller"] == "rest") & (runs["seed"] == 1)]["rms_error_evaluated"]
    assert swept == alone.row["rms_error_evaluated"]
    manifest = json.loads((tmp_path / "many" / "manifest.json").read_text())
    assert manifest["own_controllers"]["rest"]["place"] == "onnx:mine.onnx"
    write_linear(path, np.ones((51, 6)))
    with pytest.raises(ConfigurationError, match=r"mine\.onnx"):
        servobench.compare(controllers=names, out="many", resume=True, **asked)


def test_the_truth_of_all_lanes_is_there_for_a_teacher():
    envs = ServoVectorEnv(3, settings=SHORT)
    observed, _ = envs.reset(seed=5)
    target = envs.observation.feature + observed[:, 9:12]
    before = envs.truth
    _, _, _, _, info = envs.step(np.full((3, 6), 0.2))
    error = np.linalg.norm(target - envs.truth.feature, axis=1)
    np.testing.assert_allclose(error, info["error"], atol=1e-6)
    for _ in range(3):
        envs.step(np.full((3, 6), 0.2))
    motion = envs.truth.feature - before.feature
    joints = envs.observation.joint_position - observed[:, :6]
    between = 0.5 * (before.jacobian + envs.truth.jacobian)
    np.testing.assert_allclose(np.matvec(between, joints), motion, atol=2e-4)
    envs.close()
