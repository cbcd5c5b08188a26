"""Runs as environments of Gymnasium, alone or side by side: the policy is the controller, all else is the harness's."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, TypeAlias, cast, final

import cv2
import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from servobench.harness.config.registry import rendered_plant
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import Experiment, build, build_together
from servobench.harness.run.feasibility import check_possible
from servobench.harness.run.lanes import side_by_side_key
from servobench.harness.run.loop import Rollout
from servobench.harness.run.request import RunRequest, read_seed
from servobench.harness.run.resolution import (
    ResolvedRun,
    check_settings,
    resolve_sections,
    select,
)
from servobench.harness.run.sampling import Drawn
from servobench.plant.bench.bench import Bench
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.checks import AnyArray, FloatArray, Floats32, as_array
from servobench.plant.contract.faults import ConfigurationError, RunFault
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.seeds import named_seed
from servobench.plant.contract.settings import Section
from servobench.plant.contract.signals import BoolArray, Command, Observation, PlantSpec, Truth
from servobench.plant.rendered.detection import ByteArray
from servobench.plant.rendered.plants import load_engine
from servobench.plant.rendered.room import Overview, Room
from servobench.plant.robot.catalogue import DEFAULT_ROBOT, find_robot
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.mismatch import Mismatch

Info: TypeAlias = dict[str, Any]  # facts beside an observation, by name
FEATURE_BOUND = 10.0  # natural sizes, beyond which features and errors are clipped
LATENESS_BOUND = 2.0  # [s] beyond which the lateness of a frame is clipped


@final
class Spaces:
    """The observation of a policy: that of every controller, and its own last action, as one vector.

    | part | size | unit |
    |---|---|---|
    | reported joint positions | n | rad |
    | features | m | natural size of a feature |
    | reference minus feature, now and for each row of the preview | (1 + preview) m | the same |
    | whether each feature was measured | m | 0 or 1 |
    | last action | n | share of the joints' speed limits |
    | with stamps: how much older the frame is than the first one was | 1 | s |
    | with stamps: whether that is known | 1 | 0 or 1 |

    Positions are clipped to the joints' limits and features to ten natural sizes, so that the space is bounded.
    """

    def __init__(self, spec: PlantSpec, preview: int, *, stamps: bool = False) -> None:
        """Take the plant's spec, the number of future rows of the reference, and whether frames are stamped."""
        self.spec = spec
        self._stamps = stamps
        self._first_age: float | FloatArray = np.nan
        feature = np.full(spec.m, FEATURE_BOUND)
        error = np.full((1 + preview) * spec.m, 2 * FEATURE_BOUND)
        ones = np.ones(spec.n)
        lower = np.concatenate([spec.joint_lower, -feature, -error, np.zeros(spec.m), -ones])
        upper = np.concatenate([spec.joint_upper, feature, error, np.ones(spec.m), ones])
        if stamps:
            lower = np.append(lower, [-LATENESS_BOUND, 0.0])
            upper = np.append(upper, [LATENESS_BOUND, 1.0])
        self.observations = Box(lower.astype(np.float32), upper.astype(np.float32))
        self.actions = Box(-1.0, 1.0, (spec.n,))

    def command(self, action: FloatArray) -> FloatArray:
        """Return joint velocities, (..., n) rad/s, for an action, (..., n) shares of the limits; clipped to them."""
        return action.clip(-1.0, 1.0) * self.spec.joint_velocity_limit

    def action(self, given: npt.ArrayLike, *lanes: int) -> FloatArray:
        """Return an action as an array, (*lanes, n).

        Raises:
            ValueError: no numbers, another shape, or an entry that is not finite.
        """
        try:
            numbers = np.asarray(given)
        except ValueError:  # rows of unequal lengths
            numbers = np.asarray(None)
        if numbers.dtype.kind not in "fiu":
            raise ValueError(f"action must be an array of numbers, got {given!r}")
        return as_array("action", numbers, (*lanes, self.spec.n))

    def begin(self, observation: Observation) -> None:
        """Take the first observation of a run, (...), to whose unknown age those of other frames are relative."""
        self._first_age = observation.time - observation.capture_time

    def observe(
        self, observation: Observation, reference: FloatArray, action: FloatArray
    ) -> Floats32:
        """Return the policy's observation.

        Args:
            observation: of the plant, (...).
            reference: (..., 1 + preview, m), from now on, in the unit of the feature.
            action: (..., n), the last one.

        Returns:
            (..., k).
        """
        scale, feature = self.spec.feature.scale, observation.feature
        errors = (reference - feature[..., None, :]) / scale
        parts = (
            observation.joint_position,
            feature / scale,
            errors.reshape(*observation.lead, -1),
            observation.valid,
            action.clip(-1.0, 1.0),
        )
        whole = np.concatenate(parts, axis=-1)
        if self._stamps:
            lateness = observation.time - observation.capture_time - self._first_age
            known = np.isfinite(lateness)
            stamp = np.stack([np.where(known, lateness, 0.0), known], axis=-1)
            whole = np.concatenate([whole, stamp], axis=-1)
        return np.clip(whole.astype(np.float32), self.observations.low, self.observations.high)

    def error(self, truth: Truth, desired: FloatArray) -> FloatArray:
        """Return the norm of the true feature's error, (...), in natural sizes of a feature."""
        return norm(desired - truth.feature) / self.spec.feature.scale


SEEDS = 2**31  # that an environment draws from where it is given none
TRIED_SEEDS = 8  # with which runs have to be alike to go side by side
PLACEHOLDER = "constant"  # the harness builds every run with a controller; this one costs least
MARK = (40, 40, 40)  # red, green, blue


def check_options(options: object) -> None:
    """Raise a `ConfigurationError` if `reset` is given options: there are none."""
    if options not in (None, {}):
        raise ConfigurationError(
            f"reset has no options, got {options!r}; make another environment for another choice"
        )


@final
class ServoEnv(gymnasium.Env[Floats32, Floats32]):
    """One run of a task, of which each episode draws a new robot, target and noise.

    An action is a joint velocity as a share of the joints' limits, held for a control period; `Spaces` makes the
    observation. The reward of a period is

        r = −‖y* − y‖ T

    with the true feature y at its end in natural sizes and the period T [s], so that a return is the error's integral.
    The episode is truncated at the end of the task. A run that fails (a feature that is lost, a contact) terminates
    it, and its last error is charged for the rest of the task. A run may fail before anything is measured, as with an
    arm that touches the table at its start: then no feature is valid, and the first step terminates the episode.

    Attributes:
        natural_size: of a feature, in its unit.
        periods: of an episode.
        resolved: the settings that all runs share.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        plant: str = "kinematic",
        task: str = "random",
        mismatch: str = "moderate",
        robot: str = DEFAULT_ROBOT,
        sensing: str = DEFAULT_SENSING,
        settings: Mapping[str, Section] | None = None,
        render_mode: str | None = None,
        **others: object,
    ) -> None:
        """Look everything up; names and settings are those of `servobench.run`.

        With the `render_mode` "rgb_array", `render` returns pictures.

        Raises:
            ConfigurationError: a name, setting, mismatch or mode that cannot be used, or another argument.
        """
        for name in others:
            remedy = f"settings={{{plant!r}: {{...}}}} has the settings of the plant, such as 'sensing.latency': 0.1"
            raise ConfigurationError(f"an environment has no argument {name!r}; {remedy}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigurationError(f"render_mode must be rgb_array or None, got {render_mode!r}")
        self.render_mode = render_mode
        request = RunRequest(
            plant, PLACEHOLDER, task, Mismatch.parse(mismatch), 0, robot=robot, sensing=sensing
        )
        given = Settings({} if settings is None else settings)
        check_settings(given, [plant, task])
        self._sections = resolve_sections([request], given)
        self.resolved: Final = select(request, self._sections)
        experiment = build(self.resolved)
        experiment.plant.close()  # `reset` builds one for each episode
        check_possible(self.resolved, experiment.drawn, experiment.plant.spec)
        self._experiment: Experiment | None = None
        self._rollout: Rollout | None = None
        self._over = True
        self._spaces = Spaces(
            experiment.plant.spec, self.resolved.run.preview_rows, stamps=experiment.plant.stamps
        )
        self.metadata = self.metadata | {"render_fps": 1.0 / self._spaces.spec.period}
        self._outside: OutsideScene | None = None
        self.natural_size = self._spaces.spec.feature.scale
        self.periods: Final = experiment.periods
        self._spec: EnvSpec | None = None
        self.observation_space, self.action_space = self._spaces.observations, self._spaces.actions

    @property
    def spec(self) -> EnvSpec | None:
        """How Gymnasium made the environment, with the length of an episode; None if it was not made by it."""
        return self._spec

    @spec.setter
    def spec(self, made: EnvSpec | None) -> None:
        self._spec = made
        if made is not None:
            self._spec = replace(made, max_episode_steps=self.periods)

    @property
    def observation(self) -> Observation | None:
        """The present observation of the plant, as controllers get it; None before the first `reset`."""
        if self._rollout is None:
            return None
        return self._rollout.observation

    def with_seed(self, seed: int) -> ResolvedRun:
        """Return the run with another seed, and so with another robot, target and noise."""
        return select(self.resolved.request.with_seed(seed), self._sections)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats32, Info]:
        """Begin a run.

        Args:
            seed: of the run, with the same robot, target and noise as `servobench run --seed`; None draws one.
            options: there are none.

        Returns:
            The observation of the policy; `seed`, `robot` (the drawn values) and, if the run failed already, `reason`.

        Raises:
            ConfigurationError: options are given.
        """
        check_options(options)
        super().reset(seed=seed)
        run_seed = int(self.np_random.integers(SEEDS)) if seed is None else seed
        self.close()
        self._experiment = experiment = build(self.with_seed(run_seed))
        desired = experiment.desired(experiment.periods + 1)  # also after the last period
        self._action = np.zeros(self._spaces.spec.n)
        self._over = False
        info = {"seed": run_seed, "robot": experiment.drawn.as_record()}
        self._fault: RunFault | None = None
        try:
            observation = experiment.plant.reset(named_seed(run_seed, "plant"))
        except RunFault as fault:
            spec = self._spaces.spec
            start = experiment.scenario.start
            if start is None:
                start = np.zeros(spec.n)
            observation = Observation(0.0, start, np.zeros(spec.m), feature_valid=False)
            self._fault = fault
            info["reason"] = str(fault)
        self._rollout = Rollout(experiment.plant, observation, desired, experiment.loop)
        self._spaces.begin(observation)
        return self._observe(self._rollout), info

    def step(self, action: npt.ArrayLike) -> tuple[Floats32, float, bool, bool, Info]:
        """Hold an action for a period.

        Args:
            action: (n,), share of the joints' speed limits; clipped to it.

        Returns:
            The observation of the policy, the reward, whether the run failed, whether the task is over, and `time` [s],
            `error` (true, in natural sizes) and, of a run that failed, `reason`.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called, or the episode is over.
            ValueError: an action that is not (n,) finite numbers.
        """
        experiment, rollout, reason = self._experiment, self._rollout, None
        if experiment is None or rollout is None or self._over:
            raise gymnasium.error.ResetNeeded(
                "call reset before step: no episode has begun, or it is over"
            )
        self._action = self._spaces.action(action)
        try:
            if self._fault is not None:
                rollout.k += 1
                raise self._fault
            rollout.advance(Command(self._spaces.command(self._action)))
            if rollout.lost() is not None:
                reason = str(rollout.loss())
        except RunFault as fault:
            reason = str(fault)
        period = self._spaces.spec.period
        error = float(self._spaces.error(experiment.plant.truth(), rollout.reference[0]))
        periods = 1 if reason is None else experiment.periods - rollout.k + 1
        info = {"time": rollout.k * period, "error": error} | ({"reason": reason} if reason else {})
        ended = reason is None and not rollout.running
        self._over = ended or reason is not None
        return self._observe(rollout), -error * periods * period, reason is not None, ended, info

    def _observe(self, rollout: Rollout) -> Floats32:
        return self._spaces.observe(rollout.observation, rollout.reference, self._action)

    def render(self) -> ByteArray | None:
        """Return the present picture, (h, w, 3): that of the plant's camera, or the arm from outside.

        The camera's picture has the detected ball or discs marked, that from outside the target of the ball.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
            ConfigurationError: the plant has no camera, and its arm is not known or nothing can render it.
        """
        experiment, rollout = self._experiment, self._rollout
        if experiment is None or rollout is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        if self.render_mode is None:
            return None
        picture = experiment.plant.picture()
        if picture is not None:
            return picture
        if self._outside is None:
            self._outside = OutsideScene(experiment.drawn, self.resolved.request)
        move = experiment.loop.camera_move
        moved = move is not None and rollout.k > move.period
        return self._outside.picture(
            rollout.observation.joint_position, rollout.reference[0], moved=moved
        )

    def close(self) -> None:
        """Free the plant; calling it twice is allowed."""
        if self._outside is not None:
            self._outside.close()
            self._outside = None
        if self._experiment is not None:
            self._experiment.plant.close()
            self._experiment = None


class OutsideScene:
    """A scene with the true arm of a run."""

    def __init__(self, drawn: Drawn, request: RunRequest) -> None:
        """Open the scene.

        Raises:
            ConfigurationError: the plant brings a robot of its own, or no engine that renders is installed.
        """
        if drawn.true is None:
            raise ConfigurationError(
                f"plant {request.plant} brings a robot of its own, which cannot be rendered"
            )
        robot = find_robot(request.robot)
        self._arm, self._drawn, self._overview = (
            drawn.true.arm,
            drawn,
            Overview.of(robot.workspace.scale),
        )
        self._scene = load_engine(rendered_plant()).scene(
            Room(self._arm, scenery=True, robot=robot)
        )

    def picture(self, joint_position: FloatArray, target: FloatArray, *, moved: bool) -> ByteArray:
        """Return the arm, (480, 640, 3), with a cross where features are places and the ball is to be.

        Args:
            joint_position: (n,) [rad].
            target: (m,), the reference.
            moved: whether the camera was moved before, in whose frame the target is given.
        """
        self._scene.place(self._arm.joint_angle(joint_position))
        colours, _ = self._scene.render(self._overview.camera, self._overview.X_BC)
        picture = np.ascontiguousarray(colours[..., :3])
        model = self._drawn.final if moved else self._drawn.true
        if isinstance(model, HandEyeModel):
            (pixel,), (far,) = self._overview.pixels(model.to_base(target)[None])
            if far > self._overview.camera.near:
                x, y = np.round(pixel).astype(int).tolist()
                cv2.drawMarker(picture, (x, y), MARK, cv2.MARKER_TILTED_CROSS, 14, 2, cv2.LINE_AA)
        return picture

    def close(self) -> None:
        """Leave the scene."""
        self._scene.close()


@final
class ServoVectorEnv(VectorEnv[Floats32, Floats32, AnyArray]):
    """Many runs of a task that advance together, each with a robot, a target and noise of its own.

    A lane is the same run, to the bit, as a `ServoEnv` with its seed. All episodes have the same length and are reset
    together: if a run fails, it is terminated and the others are truncated. The step after the end resets all lanes and
    ignores the actions, as Gymnasium's own vector environments do.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - declared so by Gymnasium
    _many: Experiment | None = None  # the runs; an object whose choice is refused is closed, too

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        **choice: Any,  # noqa: ANN401 - typed by `ServoEnv`
    ) -> None:
        """Look everything up.

        Args:
            num_envs: number of lanes.
            max_episode_steps: length of an episode, for Gymnasium, which passes that of `ServoEnv.spec`.
            choice: arguments of `ServoEnv`, which all runs share.

        Raises:
            ConfigurationError: a number, name, setting or mismatch that cannot be used, or a plant that carries out
                one run at a time.
        """
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise ConfigurationError(f"num_envs must be a whole number from 1 on, got {num_envs!r}")
        if choice.get("render_mode") is not None:
            raise ConfigurationError(
                "runs side by side are not rendered; leave render_mode out, or use gymnasium.make"
            )
        single = ServoEnv(**choice)
        self._resolved = single.resolved
        self._with_seed = single.with_seed
        if max_episode_steps not in (None, single.periods):
            raise ConfigurationError(
                f"max_episode_steps must be {single.periods}, as the task has so many periods, got "
                f"{max_episode_steps}; settings= may change its duration"
            )
        # A twin may draw delays that differ from run to run.
        kinds = {side_by_side_key(self._with_seed(seed)) for seed in range(TRIED_SEEDS)}
        if None in kinds or len(kinds) > 1:
            request = self._resolved.request
            raise ConfigurationError(
                f"plant {request.plant} carries out one run at a time with {request.robot}: gymnasium.make_vec(..., "
                "vectorization_mode='async')"
            )
        self.num_envs = int(num_envs)
        self.single_observation_space, self.single_action_space = (
            single.observation_space,
            single.action_space,
        )
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Floats32, Info]:
        """Begin a run in every lane.

        Args:
            seed: of the first lane, from which the others count on, or one of each lane; None draws one.
            options: there are none.

        Returns:
            The observations of the policies, (num_envs, k), and `seed`, (num_envs,).

        Raises:
            ConfigurationError: options are given, a seed above 2⁶³ − num_envs, or a list of seeds of another length.
        """
        check_options(options)
        count = self.num_envs
        first: Any = seed
        given: list[int | None] = [None] * count
        if isinstance(seed, list | tuple | np.ndarray):
            given = [None if each is None else read_seed(each) for each in seed]
            if len(given) != count:
                raise ConfigurationError(
                    f"seed must be a number or a list of {count}, got {len(given)} seeds"
                )
            first = given[0]
        super().reset(seed=first)
        if isinstance(seed, int):
            if read_seed(seed) > 2**63 - count:
                raise ConfigurationError(f"seed must be at most 2**63 - {count}, got {seed}")
            seeds = seed + np.arange(count)
        else:
            pairs = zip(given, self.np_random.integers(SEEDS, size=count).tolist(), strict=True)
            seeds = np.array([drawn if each is None else each for each, drawn in pairs])
        self.close_extras()
        self._many = many = build_together([self._with_seed(each) for each in seeds.tolist()])
        bench = self._bench = cast(Bench, many.plant)
        self._spaces = Spaces(bench.spec, many.loop.preview, stamps=bench.stamps)
        self._ended = False
        self._action: FloatArray = np.zeros((self.num_envs, bench.spec.n))
        observation = bench.reset([named_seed(each, "plant") for each in seeds.tolist()])
        self._spaces.begin(observation)
        # Also after the last
        self._rollout = Rollout(bench, observation, many.desired(many.periods + 1), many.loop)
        return self._observe(), {"seed": seeds}

    def step(
        self, actions: npt.ArrayLike
    ) -> tuple[Floats32, FloatArray, BoolArray, BoolArray, Info]:
        """Hold an action in every lane for a period; see `ServoEnv.step`, but without `reason`.

        Args:
            actions: (num_envs, n).

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
            ValueError: actions that are not (num_envs, n) finite numbers.
        """
        many = self._many
        if many is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        if self._ended:
            none = np.zeros(self.num_envs, dtype=np.bool_)
            observed, info = self.reset()
            return observed, np.zeros(self.num_envs), none, none.copy(), info
        self._action = self._spaces.action(actions, self.num_envs)
        rollout = self._rollout
        rollout.advance(Command(self._spaces.command(self._action)))
        lost = rollout.lost()
        failed = np.zeros(self.num_envs, dtype=np.bool_) if lost is None else lost
        failed[list(self._bench.faults)] = True
        error = self._spaces.error(self._bench.truth(), rollout.reference[:, 0])
        self._ended = not rollout.running or bool(failed.any())
        period = self._spaces.spec.period
        periods = np.where(failed, many.periods - rollout.k + 1, 1)
        info = {"time": np.full(self.num_envs, rollout.k * period), "error": error}
        return self._observe(), -error * periods * period, failed, ~failed & self._ended, info

    @property
    def observation(self) -> Observation | None:
        """The present observation of the plant, as controllers get it, with a leading axis; None before `reset`."""
        if self._many is None:
            return None
        return self._rollout.observation

    @property
    def truth(self) -> Truth:
        """The true features, (num_envs, m), and their Jacobian, for teachers and critics; there after `reset`."""
        return self._bench.truth()

    def _observe(self) -> Floats32:
        return self._spaces.observe(
            self._rollout.observation, self._rollout.reference, self._action
        )

    def close_extras(self, **_options: Any) -> None:  # noqa: ANN401 - Gymnasium's
        """Free the plant."""
        if self._many is not None:
            self._many.plant.close()
            self._many = None
