"""The environment of Gymnasium: what its checker says, and that episodes are runs of the bench, to the bit."""

import pickle
import re
from multiprocessing import get_context

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeAwareObservation
from gymnasium.wrappers.vector import DictInfoToList

from kit.plants import plant_parameters
from kit.robots import DRIVEN_TWIN
from servobench.harness.batch.api import run
from servobench.harness.config.registry import RENDERED, default_plant
from servobench.harness.gym import ENVIRONMENT
from servobench.harness.gym.environment import MARK, ServoEnv, ServoVectorEnv
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.rendered.room import Overview

RENDERS = default_plant()[0] in RENDERED


@pytest.mark.parametrize("sensing", ["position", "pixel:hand"])
def test_an_episode_under_the_commands_of_a_run_is_that_run(sensing):
    ran = run(
        "ukf_mfac", task="random", mismatch="moderate+camera_move=5deg", sensing=sensing, seed=3
    )
    steps = ran.steps
    env = ServoEnv(task="random", mismatch="moderate+camera_move=5deg", sensing=sensing)
    _, info = env.reset(seed=3)
    assert info["seed"] == 3
    limit = 1.0  # [rad/s] of every joint of the UR5
    commands = steps.filter(regex="^joint_velocity_command_").to_numpy()
    features = steps.filter(regex="^feature_.*_(m|px)$").to_numpy()
    scale, period = env.unwrapped.natural_size, 0.05
    for k, command in enumerate(commands):
        np.testing.assert_array_equal(env.observation.feature, features[k])
        seen, reward, terminated, truncated, info = env.step(command / limit)
        assert seen in env.observation_space
        assert (terminated, truncated) == (False, k == len(commands) - 1)
        if k + 1 < len(commands):
            assert reward == pytest.approx(-steps["error_norm"][k + 1] / scale * period, rel=1e-12)
    env.close()


def test_an_episode_on_a_twin_has_the_drive_of_its_seed(tmp_path):
    twin = tmp_path / "twin.toml"
    twin.write_text(DRIVEN_TWIN, encoding="utf-8")
    asked = {"task": "random", "mismatch": "none", "robot": str(twin)}
    steps = run("ukf_mfac", seed=3, **asked).steps
    commands = steps.filter(regex="^joint_velocity_command_").to_numpy()
    features = steps.filter(regex="^feature_.*_m$").to_numpy()
    env = ServoEnv(**asked)
    env.reset(seed=3)
    for k, command in enumerate(commands[:60]):
        np.testing.assert_allclose(env.observation.feature, features[k], atol=1e-6)
        env.step(command)  # [rad/s] of limits of 1 rad/s
    env.close()
    with pytest.raises(ConfigurationError, match=r"one run at a time with .*twin\.toml"):
        ServoVectorEnv(2, **asked)


def test_an_environment_can_be_sent_to_another_process_before_and_during_an_episode():
    env = ServoEnv(task="exp1")
    fresh = pickle.loads(pickle.dumps(env))
    seen = env.reset(seed=3)[0]
    np.testing.assert_array_equal(fresh.reset(seed=3)[0], seen)
    copied, action = pickle.loads(pickle.dumps(env)), np.full(6, 0.5)
    np.testing.assert_array_equal(copied.step(action)[0], env.step(action)[0])
    for each in (env, fresh, copied):
        each.close()


def test_lanes_are_single_episodes_to_the_bit_and_are_reset_together():
    many = gymnasium.make_vec(
        ENVIRONMENT, num_envs=3, vectorization_mode="vector_entry_point", task="exp1"
    )
    singles = [ServoEnv(task="exp1") for _ in range(3)]
    seen, info = many.reset(seed=5)
    assert info["seed"].tolist() == [5, 6, 7]
    listed = DictInfoToList(ServoVectorEnv(np.int64(2), task="exp1"))
    assert listed.unwrapped.observation is None
    assert [each["seed"] for each in listed.reset(seed=5)[1]] == [5, 6]
    assert [each["time"] for each in listed.step(np.zeros((2, 6)))[4]] == [0.05, 0.05]
    alone = [env.reset(seed=5 + i)[0] for i, env in enumerate(singles)]
    np.testing.assert_array_equal(seen, alone)
    generator = np.random.default_rng(0)
    over = False
    while not over:
        actions = generator.uniform(-1.0, 1.0, (3, 6))
        seen, rewards, terminated, truncated, _ = many.step(actions)
        steps = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        np.testing.assert_array_equal(seen, [step[0] for step in steps])
        np.testing.assert_array_equal(rewards, [step[1] for step in steps])
        assert not terminated.any()
        assert truncated.tolist() == [step[3] for step in steps]
        over = truncated.all()
    again, rewards, terminated, truncated, info = many.step(actions)
    assert not np.any([rewards, terminated, truncated])
    assert len(set(info["seed"].tolist()) | {5, 6, 7}) == 6
    assert again.shape == seen.shape
    seen, info = many.reset(seed=[11, 5, None])
    assert info["seed"].tolist()[:2] == [11, 5]
    pairs = zip(singles, info["seed"], strict=True)
    np.testing.assert_array_equal(seen, [env.reset(seed=int(each))[0] for env, each in pairs])
    later = many.reset()[1]["seed"]
    assert many.reset(seed=np.array([11, 5, 3]))[1]["seed"].tolist() == [11, 5, 3]
    # The third is drawn likewise
    assert many.reset(seed=(11, 5, None))[1]["seed"].tolist() == info["seed"].tolist()
    assert many.reset()[1]["seed"].tolist() == later.tolist()
    with pytest.raises(
        ConfigurationError, match="seed must be a number or a list of 3, got 2 seeds"
    ):
        many.reset(seed=[1, 2])
    many.close()


def test_a_run_that_fails_terminates_and_is_charged_for_the_rest():
    sections = {"kinematic": {"sensing": {"drop_probability": 0.999}}, "run": {"lost_after": 0.2}}
    env = ServoEnv(task="exp1", settings=sections)
    env.reset(seed=0)
    terminated, k = False, 0
    while not terminated:
        _, reward, terminated, truncated, info = env.step(np.zeros(6))
        k += 1
    assert not truncated
    assert "no valid feature for 4 periods" in info["reason"]
    periods = round(-reward / (info["error"] * 0.05))
    assert reward == pytest.approx(-info["error"] * 0.05 * periods)
    assert periods > 50
    many = ServoVectorEnv(2, task="exp1", settings=sections)
    many.reset(seed=0)
    ended = np.zeros(2, dtype=bool)
    while not ended.any():
        _, _, terminated, truncated, _ = many.step(np.zeros((2, 6)))
        ended = terminated | truncated
    assert ended.all()
    assert terminated.any()
    env.close(), many.close()


@pytest.mark.skipif(not RENDERS, reason="nothing that renders is installed")
def test_a_plant_without_a_camera_is_shown_from_outside_with_its_ball_and_the_target():
    env = ServoEnv(task="exp2", mismatch="moderate+camera_move=20deg", render_mode="rgb_array")
    env.reset(seed=1)
    drawn, view = env._experiment.drawn, Overview.of(1.0)
    for k in (0, 120):  # before and after the camera is moved
        for _ in range(k):
            env.step(np.array([0.1, -0.05, 0.05, 0.0, 0.0, 0.0]))
        picture = env.render()
        assert (picture.shape, picture.dtype) == ((480, 640, 3), np.uint8)
        red = np.argwhere((picture[..., 0] > 120) & (picture[..., 1:] < 60).all(axis=-1))
        (ball,), _ = view.pixels(drawn.true.arm.ball_position(env.observation.joint_position)[None])
        np.testing.assert_allclose(red.mean(axis=0)[::-1], ball, atol=3.0)
        model = drawn.final if k else drawn.true
        (target,), _ = view.pixels(model.to_base(env._rollout.reference[0])[None])
        x, y = np.round(target).astype(int)
        np.testing.assert_array_equal(picture[y, x], MARK)
    env.close()


@pytest.mark.parametrize("plant", plant_parameters(RENDERED))
def test_a_plant_with_a_camera_shows_what_that_sees(plant):
    env = ServoEnv(plant, task="exp2", render_mode="rgb_array")
    env.reset(seed=1)
    np.testing.assert_array_equal(env.render(), env._experiment.plant.picture())
    assert env.render().shape == (240, 320, 3)
    env.close()


def test_nothing_is_rendered_unless_it_is_asked_for():
    env = ServoEnv()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset(seed=1)
    assert env.render() is None
    env.close()
    with pytest.raises(
        ConfigurationError, match="render_mode must be rgb_array or None, got 'human'"
    ):
        ServoEnv(render_mode="human")


@pytest.mark.parametrize("kind", [ServoEnv, ServoVectorEnv])
@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ({"plant": 3}, "plant must be a name, got 3"),
        ({"task": "retreat"}, "task retreat: it needs a target with a pose"),
        ({"task": "target", "settings": {"target": {"target": [9, 9, 9]}}}, "m out of the arm's reach"),
        ({"render_mode": "human"}, "render"),
    ],
    ids=str,
)  # fmt: skip
def test_a_choice_that_cannot_be_used_is_refused_in_a_line(kind, choice, words):
    with pytest.raises(ConfigurationError, match=re.escape(words)) as refused:
        kind(**choice)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("count", [0, -1, 1.5, "2", True])
def test_lanes_are_counted_and_never_rendered(count):
    with pytest.raises(ConfigurationError, match="num_envs must be a whole number from 1 on, got"):
        ServoVectorEnv(count)
    with pytest.raises(ConfigurationError, match="runs side by side are not rendered"):
        ServoVectorEnv(2, render_mode="rgb_array")


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (0.0, "action must have shape {shape}, got ()"),
        (np.zeros((3, 2)), "action must have shape {shape}, got (3, 2)"),
        (np.full(6, np.nan), "action must be finite, got"),
        (np.full(6, np.inf), "action must be finite, got"),
        (np.zeros(6, dtype=complex), "action must be an array of numbers, got"),
        ([[0, 0], [0]], "action must be an array of numbers, got [[0, 0], [0]]"),
        ("go", "action must be an array of numbers, got 'go'"),
        (None, "action must be an array of numbers, got None"),
    ],
    ids=str,
)
@pytest.mark.parametrize("lanes", [(), (2,)])
def test_an_action_that_is_none_is_refused_and_changes_nothing(lanes, action, words):
    env = ServoVectorEnv(*lanes, task="exp2") if lanes else ServoEnv(task="exp2")
    if lanes and isinstance(action, np.ndarray) and action.shape == (6,):
        action = np.stack([action] * 2)
    env.reset(seed=1)
    with pytest.raises(ValueError, match=re.escape(words.format(shape=(*lanes, 6)))):
        env.step(action)
    first = env.step(np.full((*lanes, 6), 0.1))[0]
    env.reset(seed=1)
    np.testing.assert_array_equal(env.step(np.full((*lanes, 6), 0.1))[0], first)
    env.close()


@pytest.mark.parametrize(
    "make", [lambda: ServoEnv(task="exp2"), lambda: ServoVectorEnv(2, task="exp2")]
)
def test_options_and_seeds_that_cannot_be_used_are_refused(make):
    env = make()
    env.reset(seed=1, options={})
    with pytest.raises(ConfigurationError, match="reset has no options, got {'target': 3}"):
        env.reset(seed=1, options={"target": 3})
    for seed in (-1, 1.5, "x"):
        with pytest.raises(gymnasium.error.Error, match="Seed must be"):
            env.reset(seed=seed)
    if isinstance(env, ServoVectorEnv):
        with pytest.raises(
            ConfigurationError, match=re.escape("seed must be at most 2**63 - 2, got")
        ):
            env.reset(seed=2**64)
        with pytest.raises(
            ConfigurationError, match="seed must be a non-negative integer, got True"
        ):
            env.reset(seed=True)
        env.reset(seed=[2**63 - 1, 0])  # each lane has its own; none is counted on
    env.close()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((2, 6)))


def test_an_episode_begins_with_reset_and_takes_no_step_after_its_end():
    env = ServoEnv(task="exp2", settings={"exp2": {"duration": 0.1}})
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
        env.step(np.zeros(6))
    env.reset(seed=1)
    env.step(np.zeros(6))
    assert env.step(np.zeros(6))[3]
    with pytest.raises(gymnasium.error.ResetNeeded, match="or it is over"):
        env.step(np.zeros(6))
    env.reset(seed=1)
    assert not env.step(np.zeros(6))[3]
    env.close()


def test_version_0_still_gives_what_it_gave():
    """A change of these figures is another environment: raise its version, so that results stay comparable."""
    env = ServoEnv()
    env.reset(seed=0)
    rewards = [env.step(np.full(6, 0.1))[1] for _ in range(20)]
    assert ENVIRONMENT.endswith("-v0")
    np.testing.assert_allclose(
        [rewards[0], sum(rewards)], [-0.028570258752639313, -0.5935999997431326], rtol=1e-9
    )
    env.close()


@pytest.mark.parametrize("method", ["fork", "forkserver", "spawn"])
def test_processes_find_the_environment_however_they_are_started(method):
    child = get_context(method).Process(target=gymnasium.spec, args=(ENVIRONMENT,))
    child.start()
    child.join(120)
    assert child.exitcode == 0


def test_the_specification_tells_the_length_of_an_episode():
    env = TimeAwareObservation(
        gymnasium.make(ENVIRONMENT, task="exp2", settings={"exp2": {"duration": 0.2}})
    )
    assert env.spec.max_episode_steps == 4
    env.reset(seed=1)
    ends = [env.step(np.zeros(6))[2:4] for _ in range(4)]
    assert ends == [(False, False)] * 3 + [(False, True)]
    again = gymnasium.make(env.unwrapped.spec)
    assert again.spec.max_episode_steps == 4
    many = gymnasium.make_vec(again.spec, num_envs=2, vectorization_mode="vector_entry_point")
    assert many.unwrapped.single_observation_space == again.observation_space
    with pytest.raises(
        ConfigurationError,
        match="max_episode_steps must be 4, as the task has so many periods, got 5",
    ):
        ServoVectorEnv(2, task="exp2", settings={"exp2": {"duration": 0.2}}, max_episode_steps=5)


def test_an_argument_that_is_a_setting_is_refused_with_the_place_of_settings():
    with pytest.raises(
        ConfigurationError, match=r"no argument 'latency'; settings=\{'kinematic': \{\.\.\.\}\} has"
    ):
        gymnasium.make(ENVIRONMENT, latency=0.1)
    env = ServoEnv(settings={"kinematic": {"sensing.latency": 0.1, "lag": 0.02}})
    assert env.resolved.plant.sensing.latency == 0.1


STAMPED = {"kinematic": {"sensing": {"latency": 0.1, "jitter": 0.2, "stamps": True}}}
SHIFTED = {"kinematic": {"sensing": {**STAMPED["kinematic"]["sensing"], "clock_offset": 1e9}}}


def test_stamps_of_frames_are_ages_relative_to_that_of_the_first_one():
    """The checker of Gymnasium finds nothing, and the unknown offset of the clock changes nothing."""
    plain = ServoEnv(task="exp1", settings={"kinematic": {"sensing": {"latency": 0.1}}})
    size = plain.observation_space.shape[0]
    env, other = (ServoEnv(task="exp1", settings=each) for each in (STAMPED, SHIFTED))
    assert env.observation_space.shape == (size + 2,)
    check_env(env, skip_render_check=True)
    found = [each.reset(seed=3)[0] for each in (env, other)]
    ages = []
    for _ in range(40):
        np.testing.assert_allclose(found[0], found[1], atol=1e-6)
        look = env.observation
        age, known = found[0][-2:]
        assert known == 1.0
        # The first frame is one latency old.
        assert age == pytest.approx(look.time - look.capture_time - 0.1, abs=1e-6)
        ages.append(age)
        found = [each.step(np.full(6, 0.1))[0] for each in (env, other)]
    assert np.ptp(ages) > 0.1
    for each in (plain, env, other):
        each.close()


def test_lanes_with_stamps_are_single_episodes():
    many = ServoVectorEnv(num_envs=2, task="exp1", settings=STAMPED)
    seen, _ = many.reset(seed=[3, 4])
    alone = [ServoEnv(task="exp1", settings=STAMPED) for _ in range(2)]
    for lane, env in enumerate(alone):
        np.testing.assert_array_equal(seen[lane], env.reset(seed=3 + lane)[0])
    for _ in range(5):
        seen, *_ = many.step(np.full((2, 6), 0.1))
        for lane, env in enumerate(alone):
            np.testing.assert_array_equal(seen[lane], env.step(np.full(6, 0.1))[0])
    for each in (many, *alone):
        each.close()
