"""A run made ready: from names, a mismatch and a seed to the true robot, the task on it, plant and controller.

Settings that are valid one by one and make no run together are refused, such as a time longer than the run.
A target that a task gives as a feature is compared with the reach of the nominal arm, plus a margin for the mismatch: a
run is refused only where no true robot of that mismatch could do it.
"""

import contextlib
import copy
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np

from servobench.controllers.controller import Controller, Delays, RobotKnowledge
from servobench.controllers.methods import TrainedMethodConfig
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.fit import Progress
from servobench.harness.config.registry import find_controller, find_plant
from servobench.harness.config.settings import Settings
from servobench.harness.config.source import same_folder
from servobench.harness.run.knowledge import network_source, nominal_knowledge
from servobench.harness.run.loop import CameraMove, LoopSettings
from servobench.harness.run.request import (
    RunRequest,
    RunSettings,
    find_robot,
    find_sensing,
    sensing_file,
)
from servobench.harness.run.resolution import ResolvedRun, resolve
from servobench.harness.run.result import ends_batch
from servobench.harness.run.scenario import Scenario, TaskSetting, Vector
from servobench.harness.run.tasks import TASKS, find_task, task_names
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import Plant, PlantSetup, TrueModel
from servobench.plant.cameras.placement import CameraDraws
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, RunFault, configuration_errors
from servobench.plant.contract.lanes import stack
from servobench.plant.contract.seeds import named_seed
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import likely_meant, remark
from servobench.plant.contract.signals import PlantSpec
from servobench.plant.robot.hand_eye import HandEyeModel, RobotModel, TrueJacobian
from servobench.plant.robot.inverse import closest_distance
from servobench.plant.robot.mismatch import Mismatch, MismatchSample, sample_mismatch
from servobench.plant.robot.robot import Robot

REACH_MARGIN: Final = (
    0.1  # [m] by which a target may be out of the nominal reach under any mismatch
)
MAX_PLACE: Final = 20.0  # [m] farthest target that is not remarked on
# Usual norms of a Jacobian by unit of the feature, in this unit per rad.
RATES: Final = {"m": (0.01, 100.0), "mm": (10.0, 1e5)}
POINTS: Final = 12  # points of a curve that are checked
# Noise, steps and outliers are remarked on beyond this share of an image, or of a metre.
MAX_EXTENT: Final = 0.1  # [1]


@dataclass(frozen=True, eq=False)
class Drawn:
    """The values drawn for one run."""

    scenario: Scenario
    # The true robot and its cameras; None for a plant that brings its own.
    true: RobotModel | None = None
    sample: MismatchSample | None = None  # how it differs from the nominal one
    moved: RobotModel | None = None  # the true robot after its camera was moved; None if it is not
    # How cameras differ from those planned; None where they are part of `sample`.
    cameras: CameraDraws | None = None

    @property
    def final(self) -> RobotModel | None:
        """The true robot with the camera as it is at the end of the run."""
        return self.moved or self.true

    def as_record(self) -> dict[str, object]:
        """Return all values drawn for robot and cameras, for JSON."""
        record: dict[str, object] = {}
        for part in (self.sample, self.cameras):
            if part is not None:
                record |= part.as_record()
        return record


def draw(resolved: ResolvedRun) -> Drawn:
    """Draw the true robot and the task of a run.

    Raises:
        ConfigurationError: a mismatch or a task that cannot be used.
    """
    request = resolved.request
    robot = find_robot(request.robot)
    true, sample, cameras = draw_robot(request)
    moved = sample.moved(true, robot)
    setting = TaskSetting(
        true,
        true.arm.n,
        true.channel,
        named_seed(request.seed, "task"),
        moved,
        robot,
        nominal=find_sensing(request.sensing).nominal(robot),
    )
    return Drawn(build_scenario(resolved, setting), true, sample, moved, cameras)


@configuration_errors()
def draw_robot(request: RunRequest) -> tuple[RobotModel, MismatchSample, CameraDraws | None]:
    """Draw the true robot of a run with its cameras, and return the drawn values, too.

    Raises:
        ConfigurationError: a robot, sensing or mismatch that cannot be used.
    """
    robot = find_robot(request.robot)
    seed = named_seed(request.seed, "mismatch")
    arm, sample = sample_mismatch(request.mismatch, robot, seed)
    sensing = find_sensing(request.sensing)
    true, cameras = sensing.true(robot, arm, sample, request.mismatch, seed)
    if robot.twin is not None:
        exact = not request.mismatch.moves_robot
        true = robot.twin.model(sensing.nominal(robot), request.sensing, request.seed, exact=exact)
    return true, sample, cameras


def build_scenario(resolved: ResolvedRun, setting: TaskSetting) -> Scenario:
    """Return the task of a run as it is in a setting.

    Raises:
        ConfigurationError: a task that cannot be used there, or times that do not fit.
    """
    name = resolved.request.task
    task = resolved.task
    if setting.model is None and not task.any_robot:
        others = ", ".join(name for name, entry in TASKS.items() if entry.default.any_robot)
        why = f"it is taught on a known robot, and this plant brings a robot of its own; use one of {others}"
        raise ConfigurationError(f"task {name}: {why}")
    with configuration_errors(f"task {name}: "):
        with same_folder():
            scenario: object = task.scenario(setting)  # That of a user's task may be anything.
        if not isinstance(scenario, Scenario):
            raise ConfigurationError(
                f"its method scenario must return a servobench.Scenario, got {scenario!r}"
            )
        points = _points_of(scenario, len(setting.feature.names))
        last = (resolved.run.periods(scenario.duration) - 1) * resolved.run.period
        # A move is judged by its settling, whenever its judged part begins.
        if scenario.kind == "curve" and scenario.evaluate_from > last + 1e-9:
            begins = f"begins at {scenario.evaluate_from:g} s"
            part = f"{begins}, after the last control instant at {last:g} s"
            raise ConfigurationError(f"its judged part {part}; let evaluate_from be earlier")
        if name not in TASKS:
            with configuration_errors(
                "its scenario differs from one call to the next: ", Exception
            ):
                _check_repeated(scenario, points, task.scenario(setting))
    _check_times(resolved, scenario.duration)
    _check_extents(resolved, setting.nominal)
    return scenario


def _points_of(scenario: Scenario, m: int) -> FloatArray:
    """Return the reference of a scenario at a few instants, (p, m), and refuse one of another shape."""
    points = np.asarray(scenario.reference.at(_instants(scenario)))
    if points.shape != (POINTS, m) or not np.isfinite(points).all():
        got = f"shape {points.shape} and {points[:1].tolist()}"
        raise ConfigurationError(
            f"its reference must be {m} finite features at {POINTS} instants, got {got}"
        )
    return points


def _instants(scenario: Scenario) -> FloatArray:
    return np.linspace(0.0, scenario.duration, POINTS)


def _check_repeated(scenario: Scenario, points: FloatArray, again: Scenario) -> None:
    """Refuse a task whose second scenario is another one, given points of the first."""
    repeated = np.array_equal(points, again.reference.at(_instants(scenario)))
    starts: list[Any] = [scenario.start, again.start]
    if not repeated or not np.array_equal(*starts):
        raise ConfigurationError("draw from setting.seed alone")


@dataclass(frozen=True, eq=False)
class Experiment:
    """A run made ready, or runs that advance together: true robots drawn, plant and controller built."""

    plant: Plant  # for runs that advance together a bench with a lane for each
    controller: Controller  # likewise
    runs: tuple[Drawn, ...]  # the true robot and the task of each run
    run: RunSettings  # the settings that all of them share
    networks: Sequence[TrainedNetworks] = ()  # networks that the controller started from, if any
    together: bool = False  # whether there are lanes, also for a single run

    @property
    def drawn(self) -> Drawn:
        """The true robot and the task of the run, or of the first run."""
        return self.runs[0]

    @property
    def scenario(self) -> Scenario:
        """Start, reference and length of the run, or of the first run."""
        return self.drawn.scenario

    @property
    def periods(self) -> int:
        """Number of control periods."""
        return self.run.periods(self.scenario.duration)

    @property
    def loop(self) -> LoopSettings:
        """The settings of the loop, with the camera's pose (..., 4, 4) after a move."""
        run = self.run
        moved = [each.moved.camera for each in self.runs if each.moved is not None]
        move = None
        if moved:
            instant = int(run.camera_moves_at * self.periods)
            move = CameraMove(instant, self._in_lanes(moved))
        return LoopSettings(self.periods, run.preview_rows, run.periods(run.lost_after), move)

    def desired(self, periods: int | None = None) -> FloatArray:
        """Return the desired features of the run, or of this number of periods, and of the previewed rows beyond.

        Returns:
            (..., periods + preview, m) [unit of the feature].
        """
        count = self.periods if periods is None else periods
        rows = count + self.run.preview_rows
        period = self.plant.spec.period
        return self._in_lanes([each.scenario.reference.sampled(period, rows) for each in self.runs])

    def _in_lanes(self, arrays: list[FloatArray]) -> FloatArray:
        if self.together:
            return np.stack(arrays)
        return arrays[0]


@same_folder()
def build(resolved: ResolvedRun, *, progress: Progress | None = None) -> Experiment:
    """Make a run ready.

    Args:
        resolved: the run.
        progress: called with the share of a training of networks that is done.

    Raises:
        ConfigurationError: a name, setting, mismatch or seed that cannot be used.
    """
    request = resolved.request
    if not find_plant(request.plant).own_robot:
        drawn = draw(resolved)
        start = drawn.scenario.start
        plant, controller, networks = _assemble(resolved, drawn.true, start, progress)
        return Experiment(plant, controller, (drawn,), resolved.run, networks)
    brings = f"plant {request.plant} brings a"
    if request.mismatch != Mismatch():
        raise ConfigurationError(
            f"{brings} robot of its own, to which mismatches do not apply; use the mismatch none"
        )
    if request.sensing != DEFAULT_SENSING:
        raise ConfigurationError(
            f"{brings} sensor of its own, so the sensing {request.sensing} does not apply"
        )
    plant, controller, networks = _assemble(resolved, None, None, progress)
    try:
        seed = named_seed(request.seed, "task")
        setting = TaskSetting(None, plant.spec.n, plant.spec.feature, seed)
        drawn = Drawn(build_scenario(resolved, setting))
    except BaseException:
        plant.close()
        raise
    return Experiment(plant, controller, (drawn,), resolved.run, networks)


@same_folder()
def build_together(runs: Sequence[ResolvedRun]) -> Experiment:
    """Make runs of one `lanes.side_by_side_key` ready, with a lane for each.

    Raises:
        Exception: any error of a run alone, or runs that cannot advance together.
    """
    first = runs[0]
    drawn = tuple(map(draw, runs))
    robots = stack([each.true for each in drawn])
    starts = np.array([each.scenario.start for each in drawn])
    plant, controller, networks = _assemble(first, robots, starts)
    return Experiment(plant, controller, drawn, first.run, networks, together=True)


def _assemble(
    resolved: ResolvedRun,
    true: RobotModel | None,
    start: FloatArray | None,
    progress: Progress | None = None,
) -> tuple[Plant, Controller, Sequence[TrainedNetworks]]:
    """Return plant, controller and its networks for a true robot and a start (..., n) [rad].

    For None the plant brings its own. Of runs side by side the arrays of the robot have a leading axis, and `resolved`
    is one of them.
    """
    request = resolved.request
    run = resolved.run
    entry = find_plant(request.plant)
    if request.sensing != DEFAULT_SENSING and not entry.any_sensing:
        raise ConfigurationError(
            f"plant {entry.name} has the sensing position only, got {request.sensing}"
        )
    robot = None if entry.own_robot else find_robot(request.robot)
    setup = PlantSetup(true, start, run.period, robot)
    with same_folder(), configuration_errors(f"plant {request.plant}: ", RunFault):
        plant = entry.build(resolved.plant, setup)
    if not math.isclose(plant.spec.period, run.period):
        plant.close()
        wanted = f"spec.period must be that of its setup, {run.period:g} s"
        raise ConfigurationError(f"plant {request.plant}: {wanted}")
    try:
        if true is not None and request.mismatch.size("camera_move") > 0.0:
            # Refused where it cannot be moved; a user's camera may lack something before its reset.
            with (
                contextlib.suppress(AttributeError, TypeError),
                configuration_errors(f"plant {request.plant}: "),
            ):
                plant.move_camera(true.camera)
        if robot is None:
            jacobian = plant.nominal_jacobian()
            knowledge = RobotKnowledge(plant.spec, run.preview_rows, jacobian)
            trained = knowledge
        else:
            nominal = find_sensing(request.sensing).nominal(robot)
            knowledge, trained = nominal_knowledge(robot, nominal, plant.spec, run)
        source = network_source(trained, progress)
        true_model = partial(_true_model, plant, true)
        with naming_the_lack(plant, own_robot=robot is None):
            controller = _build_controller(resolved, replace(knowledge, train=source), true_model)
    except BaseException:
        plant.close()
        raise
    return plant, controller, () if source is None else source.given


@contextlib.contextmanager
def naming_the_lack(plant: Plant, *, own_robot: bool) -> Iterator[None]:
    """Add to an error of a controller that calls the nominal model where there is none that this is so."""
    try:
        yield
    except (AttributeError, ConfigurationError, TypeError) as error:
        calls_none = re.search("NoneType|callable", str(error))
        if own_robot and plant.nominal_jacobian() is None and calls_none:
            lack = "knowledge.nominal_jacobian is None here: this plant has no model"
            if isinstance(error, ConfigurationError):
                raise ConfigurationError(f"{error}; {lack}") from error
            error.add_note(lack)
        raise


def build_once(run: ResolvedRun, progress: Progress | None = None) -> None:
    """Build a run and discard it, which refuses a wrong configuration and trains networks.

    Other errors are left to the run, whose row names them. Arguments and errors are those of `build`.
    """
    try:
        experiment = build(run, progress=progress)
        with contextlib.closing(experiment.plant) as plant:
            _check_features(run, experiment)
            if isinstance(plant, Bench):
                plant.world.rehearse()
    except BaseException as error:
        if isinstance(error, ConfigurationError) or ends_batch(error):
            raise
        return  # The error is one of a plug-in; its run will fail in the same way.
    check_possible(run, experiment)


def check_possible(run: ResolvedRun, experiment: Experiment) -> None:
    """Refuse a start, or a target taught at joint positions, outside the joints' limits, and a target out of reach.

    Raises:
        ConfigurationError: names it and the joint, or how far it is out of reach of any true robot.
    """
    if experiment.drawn.true is None:
        return
    scenario = experiment.scenario
    spec = experiment.plant.spec
    for what, values in (("start", scenario.start), ("target", run.task.taught_at)):
        if values is None:
            continue
        limited = zip(spec.joint_names, values, spec.joint_lower, spec.joint_upper, strict=True)
        for joint, value, lower, upper in limited:
            if not lower <= value <= upper:
                wanted = f"within the joints' limits, {lower:.4g} to {upper:.4g} rad for {joint}"
                raise ConfigurationError(
                    f"task {run.request.task}: {what} must be {wanted}, got {value:g}"
                )
    _check_reach(run, scenario, spec)


def _check_features(run: ResolvedRun, experiment: Experiment) -> None:
    """Remark on a reference that is likely in mm or too fast for the arm, and on a user's features that hardly move."""
    request = run.request
    spec = experiment.plant.spec
    unit = spec.feature_unit
    true = experiment.drawn.true
    start = experiment.scenario.start
    task = f"the reference of the task {request.task}"
    with configuration_errors(f"task {request.task}: "):
        desired = experiment.desired()
    if true is None or start is None:
        size = np.abs(desired).max()
        if unit == "m" and size > MAX_PLACE:
            remark(f"{task} reaches {size:g} m; if places are meant in mm, write the unit, too")
        return
    distances = np.linalg.norm(np.diff(desired, axis=0), axis=1)
    speed = distances.max(initial=0.0) / spec.period
    J = true.jacobian(start)
    fastest = float(np.linalg.norm(J, axis=0) @ spec.joint_velocity_limit)
    if speed > fastest:
        arm = f"the arm at {fastest:.3g} {unit}/s at most from its start"
        remark(f"{task} moves at {speed:.3g} {unit}/s, and {arm}")
    if sensing_file(request.sensing) is None:
        return
    sensing = f"sensing {request.sensing}"
    # Rows of J that are equal, or zeros, are counted once.
    different = np.unique([*J.round(9), np.zeros(spec.n)], axis=0)
    if len(different) <= spec.m:
        remark(f"{sensing}: a feature stands still, or moves as another one does, at the start")
    rate = float(np.linalg.norm(J))
    least, most = RATES.get(unit, (0.0, np.inf))
    if not least <= rate <= most:
        remark(f"{sensing}: features move by {rate:.2g} {unit}/rad; is {unit} their unit?")


def train_networks(
    controller: str,
    settings: Settings,
    progress: Progress,
    robot_name: str,
    sensing: str = DEFAULT_SENSING,
) -> TrainedNetworks:
    """Return the networks that a controller of this name starts from, trained where the cache has none.

    Raises:
        ConfigurationError: a name or setting that cannot be used or changes no network, or a controller without any.
    """
    robot = find_robot(robot_name)
    if not robot.known:
        raise ConfigurationError(
            f"networks are trained on a nominal model, and controllers know none of {robot.title}"
        )
    # Networks do not depend on plant and task.
    request = RunRequest(
        "kinematic", controller, "target", Mismatch(), 0, robot=robot_name, sensing=sensing
    )
    resolved = resolve(request, settings)
    if isinstance(resolved.controller, TrainedMethodConfig):
        for section, key, text in settings.assigned:
            topic, _, _ = key.partition(".")
            if (section, topic) != (controller, "training"):
                depends = f"networks depend on {controller}.training alone"
                raise ConfigurationError(f"--set {text} has no effect: {depends}")
    experiment = build(resolved, progress=progress)
    experiment.plant.close()
    if not experiment.networks:
        raise ConfigurationError(f"controller {controller} has no networks to train")
    return experiment.networks[-1]


def _true_model(plant: Plant, true: RobotModel | None) -> TrueModel:
    """Return the model of a true robot with the delays of its plant; for None that of the plant's own robot."""
    if true is None:
        return plant.true_model()
    return plant.with_delays(_equations(true))


def _equations(model: RobotModel) -> TrueModel:
    def symbolic(joint_position: Any) -> Any:  # noqa: ANN401 - expressions of CasADi
        from servobench.plant.cameras.symbolic import symbolic_feature  # noqa: PLC0415 - only the extra mpc brings CasADi

        return symbolic_feature(model)(joint_position)

    return TrueModel(TrueJacobian(model), symbolic)


def _build_controller(
    run: ResolvedRun, knowledge: RobotKnowledge, true_model: Callable[[], TrueModel]
) -> Controller:
    """Build a controller; the truth goes only to one that asks for it, as the nominal model where there is none."""
    entry = find_controller(run.request.controller)
    with configuration_errors(f"controller {run.request.controller}: "):
        if entry.needs_truth:
            true = true_model()
            delays = Delays(true.latency, true.command_delay, true.lag or 0.0, true.latency_spread)
            knowledge = replace(
                knowledge,
                nominal_jacobian=knowledge.nominal_jacobian or true.jacobian,
                true_jacobian=true.jacobian,
                true_symbolic=true.symbolic,
                true_delays=delays,
                true_camera_turn=true.camera_turn,
                true_tool=true.tool,
            )
        # Runs share the settings, which a class of a user's may change.
        config = run.controller
        parameters = getattr(type(config), "__dataclass_params__", None)
        if parameters is None or not parameters.frozen:
            config = copy.deepcopy(config)
        return entry.build(config, knowledge)


def _check_times(resolved: ResolvedRun, duration: float) -> None:
    """Refuse times that are longer than the run of `duration` [s], so that they never end in it."""
    plant = resolved.request.plant
    whole = f"the run of {duration:g} s"
    times = {"run.period": resolved.run.period}
    for name in ("command_delay", "lag"):
        times[f"{plant}.{name}"] = getattr(resolved.plant, name, 0.0)
    sensing = getattr(resolved.plant, "sensing", None)
    if isinstance(sensing, SensingConfig):
        for name in ("latency", "jitter", "frame_period", "latency_swing"):
            times[f"{plant}.sensing.{name}"] = getattr(sensing, name)
        late = [begin for begin, _ in sensing.occlusion_windows if begin >= duration]
        if late:
            where = f"{plant}.sensing.occlusion_windows"
            raise ConfigurationError(f"{where} must begin within {whole}, got {late[0]:g} s")
    for name, time in times.items():
        if isinstance(time, float) and time > 0.0 and time >= duration:
            meant = likely_meant(time, "s", lambda other: other < duration)
            raise ConfigurationError(f"{name} must be shorter than {whole}, got {time:g} s{meant}")
    preview = resolved.run.preview_time
    if preview > max(duration, RunSettings().preview_time):
        raise ConfigurationError(
            f"run.preview_time must be no longer than {whole}, got {preview:g} s"
        )


def _check_extents(resolved: ResolvedRun, nominal: RobotModel | None) -> None:
    """Refuse noise, steps and outliers beyond an image, or a metre, and remark on those beyond a tenth of it.

    A plain number of a pixel's noise is one of metres and likely a mistake beyond a tenth.
    """
    sensing = getattr(resolved.plant, "sensing", None)
    if nominal is None or not isinstance(sensing, SensingConfig):
        return
    unit = nominal.channel.unit
    whole = 1.0
    if unit == "px" and isinstance(nominal, SetupModel):
        whole = nominal.optics.size[0]
    with configuration_errors(f"{resolved.request.plant}."):
        extents = sensing.extents(unit, nominal.noise_unit)
    if unit not in ("px", "m"):
        return
    for name, metres in extents._asdict().items():
        size = nominal.noise_unit * metres
        if size <= (whole if name == "outlier_size" else MAX_EXTENT * whole):
            continue
        place = f"{resolved.request.plant}.sensing.{name}"
        words = f"{place} is {size:.4g} {unit}, above a tenth of {whole:g} {unit}"
        given = getattr(sensing, name)
        plain = given == metres
        if plain and unit == "px":
            raise ConfigurationError(
                f"{words}: a plain number is in metres; for pixels write {given:g}px"
            )
        if size <= whole:
            remark(words)
            continue
        meant = ""
        if plain:
            meant = likely_meant(metres, "m", lambda other: other <= MAX_EXTENT * whole)
        raise ConfigurationError(words + meant)


def _check_reach(resolved: ResolvedRun, scenario: Scenario, spec: PlantSpec) -> None:
    """Refuse a target or a curve that no true robot of the run's mismatch can reach, by its farthest point."""
    task = resolved.request.task
    taught_on_true_robot = not resolved.task.any_robot
    only_positions = resolved.request.sensing == DEFAULT_SENSING
    if find_task(task).out_of_reach or taught_on_true_robot or not only_positions:
        return
    robot = find_robot(resolved.request.robot)
    nominal = robot.nominal
    points = np.unique(scenario.reference.at(_instants(scenario)), axis=0)
    in_base = nominal.to_base(points)
    limits = tuple(spec.joint_lower), tuple(spec.joint_upper)
    distances = np.array(_distances(nominal, tuple(map(tuple, points)), *limits))
    beyond = distances - _room(resolved.request.mismatch, robot, in_base)
    from_shoulder = np.linalg.norm(in_base - robot.workspace.shoulder, axis=-1)
    nearest = float(from_shoulder.min())
    if nearest < 0.5 * robot.workspace.reach[0]:
        place = f"{1e3 * nearest:.0f} mm from the arm's shoulder"
        remark(f"task {task}: a target {place} is within the arm itself")
    worst = int(beyond.argmax())
    if beyond[worst] > 0.0:
        where = ", ".join(f"{value:g}" for value in points[worst].round(3))
        on_purpose = [entry.name for entry in TASKS.values() if entry.out_of_reach]
        what = "its target" if len(points) == 1 else "a point of its curve,"
        found = f"{what} ({where}) m in the camera frame, is {distances[worst]:.2g} m out of the arm's reach"
        remedy = f"for a target out of reach on purpose there is the task {', '.join(on_purpose)}"
        raise ConfigurationError(f"task {task}: {found}; {remedy}")


@lru_cache(maxsize=64)
def _distances(
    nominal: HandEyeModel, points: tuple[Vector, ...], lower: Vector, upper: Vector
) -> Vector:
    """Return how near the nominal arm comes to each point [m]."""
    places = nominal.to_base(np.array(points))
    found = closest_distance(nominal.arm, places, np.array(lower), np.array(upper))
    return tuple(found.tolist())


def _room(mismatch: Mismatch, robot: Robot, points: FloatArray) -> FloatArray:
    """Return how much nearer than the nominal arm a true one may come to each point (p, 3) of the base frame, (p,) m.

    Longer links and tools reach farther; a turned camera turns the point about the middle of the workspace.
    """
    length = float(np.linalg.norm(robot.arm.translation, axis=-1).sum())
    longer_links = length * mismatch.size("links")
    longer_tool = math.sqrt(3.0) * mismatch.size("tool")
    longer = REACH_MARGIN + longer_links + longer_tool
    turn = min(math.pi, mismatch.size("camera_rotation") + mismatch.size("camera_move"))
    chord = 2.0 * math.sin(turn / 2.0)  # [1] for a radius of 1
    radius = np.linalg.norm(points - np.asarray(robot.workspace.centre), axis=-1)
    return np.asarray(longer + chord * radius)


def try_to_build(word: str, name: str, robot_name: str) -> None:
    """Build a controller or plant for a robot and throw it away.

    Raises:
        ConfigurationError: it cannot be built, or a task has its name; one line.
    """
    if name in task_names():
        raise ConfigurationError(f"a task is called {name!r}, too; give the {word} another name")
    robot = find_robot(robot_name)
    if word == "controller":
        request = RunRequest("kinematic", name, "exp1", Mismatch(), 0, robot=robot_name)
        with contextlib.suppress(RunFault, _Trains):  # the run's row will report a fault
            build(resolve(request, Settings()), progress=_stop).plant.close()
        return
    entry = find_plant(name)
    period = RunSettings().period
    if entry.own_robot:
        setup = PlantSetup(None, None, period)
    else:
        setup = PlantSetup(robot.nominal, robot.workspace.home, period, robot)
    with configuration_errors(f"plant {name}: "), contextlib.suppress(RunFault):
        config = entry.config() if entry.config_for is None else entry.config_for(robot)
        plant = entry.build(config, setup)
        with contextlib.suppress(Exception):  # `servobench check plant` reports it
            plant.close()


class _Trains(BaseException):
    """A controller begins to train its networks: it can be built. No `Exception`, which would count as its error."""


def _stop(_share: float, _what: str) -> None:
    raise _Trains
