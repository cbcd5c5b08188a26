"""A run as an environment of Gymnasium: the policy is the controller, everything else is the harness's."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, final

import cv2
import gymnasium
import numpy as np
import numpy.typing as npt

from servobench.harness.config.registry import rendered_plant, scene_of
from servobench.harness.config.robots import DEFAULT_ROBOT, find_robot
from servobench.harness.config.settings import Settings
from servobench.harness.gym.spaces import Floats32, Spaces
from servobench.harness.run.experiment import Drawn, Experiment, build, check_possible
from servobench.harness.run.loop import Rollout
from servobench.harness.run.request import RunRequest, read_mismatch
from servobench.harness.run.resolution import ResolvedRun, check_settings, resolve
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, RunFault
from servobench.plant.contract.seeds import named_seed
from servobench.plant.contract.signals import Command, Observation
from servobench.plant.rendered.detection import ByteArray
from servobench.plant.rendered.room import Overview, Room
from servobench.plant.robot.hand_eye import HandEyeModel

SEEDS: Final = 2**31  # that an environment draws from where it is given none
PLACEHOLDER: Final = "constant"  # the harness builds every run with a controller; this one costs least
MARK: Final = (40, 40, 40)  # red, green, blue


def check_options(options: object) -> None:
    """Raise a `ConfigurationError` if `reset` is given options: there are none."""
    if options not in (None, {}):
        raise ConfigurationError(f"reset has no options, got {options!r}; make another environment for another choice")


def with_seed(resolved: ResolvedRun, seed: int) -> ResolvedRun:
    """Return the same run with another seed, and so another robot, target and noise."""
    return replace(resolved, request=replace(resolved.request, seed=seed))


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
        settings: Mapping[str, Mapping[str, Any]] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Look everything up; names and settings are those of `servobench.run`.

        With the `render_mode` "rgb_array", `render` returns pictures.

        Raises:
            ConfigurationError: a name, setting, mismatch or mode that cannot be used.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigurationError(f"render_mode must be rgb_array or None, got {render_mode!r}")
        self.render_mode = render_mode
        request = RunRequest(plant, PLACEHOLDER, task, read_mismatch(mismatch), 0, robot=robot, sensing=sensing)
        given = Settings({} if settings is None else settings)
        check_settings(given, [plant, task])
        self.resolved: Final = resolve(request, given)
        experiment = build(self.resolved)
        try:
            check_possible(self.resolved, experiment)
        except ConfigurationError:
            experiment.plant.close()
            raise
        self._experiment: Experiment | None = experiment
        self._rollout: Rollout | None = None
        self._over = True
        self._spaces = Spaces(experiment.plant.spec, self.resolved.run.preview_rows)
        self.metadata = self.metadata | {"render_fps": 1.0 / self._spaces.spec.period}
        self._outside: OutsideScene | None = None
        self.natural_size = self._spaces.spec.feature.scale
        self.observation_space, self.action_space = self._spaces.observations, self._spaces.actions

    @property
    def observation(self) -> Observation | None:
        """The present observation of the plant, as controllers get it; None before the first `reset`."""
        return None if self._rollout is None else self._rollout.observation

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats32, dict[str, Any]]:
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
        self._experiment = experiment = build(with_seed(self.resolved, run_seed))
        desired = experiment.desired(experiment.periods + 1)  # also after the last period
        self._action = np.zeros(self._spaces.spec.n)
        self._over = False
        info = {"seed": run_seed, "robot": experiment.drawn.as_record()}
        self._fault: RunFault | None = None
        try:
            observation = experiment.plant.reset(named_seed(run_seed, "plant"))
        except RunFault as fault:
            spec, start = self._spaces.spec, experiment.scenario.start
            start = np.zeros(spec.n) if start is None else start
            observation, self._fault = Observation(0.0, start, np.zeros(spec.m), feature_valid=False), fault
            info["reason"] = str(fault)
        self._rollout = Rollout(experiment.plant, observation, desired, experiment.loop)
        return self._observe(self._rollout), info

    def step(self, action: npt.ArrayLike) -> tuple[Floats32, float, bool, bool, dict[str, Any]]:
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
            raise gymnasium.error.ResetNeeded("call reset before step: no episode has begun, or it is over")
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
        return self._outside.picture(rollout.observation.joint_position, rollout.reference[0], moved=moved)

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
            raise ConfigurationError(f"plant {request.plant} brings a robot of its own, which cannot be rendered")
        robot = find_robot(request.robot)
        self._arm, self._drawn, self._overview = drawn.true.arm, drawn, Overview.of(robot.workspace.scale)
        self._scene = scene_of(rendered_plant())(Room(self._arm, scenery=True, robot=robot))

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
