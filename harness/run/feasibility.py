"""Whether an arm can do the task of a run: joint limits, reach, speed of the reference, features that move.

A target that a task gives as a feature is compared with the reach of the nominal arm, plus a margin for the mismatch: a
run is refused only where no true robot of that mismatch could do it.
"""

import math
from functools import lru_cache

import numpy as np

from servobench.harness.config.sensing import sensing_file
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.sampling import Drawn, checked_instants
from servobench.harness.run.scenario import Scenario, Vector
from servobench.harness.run.tasks import TASKS, find_task
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import PlantSpec
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.inverse import closest_distance
from servobench.plant.robot.mismatch import Mismatch
from servobench.plant.robot.robot import Robot

REACH_MARGIN = 0.1  # [m] by which a target may be out of the nominal reach under any mismatch
MAX_PLACE = 20.0  # [m] farthest target that is not remarked on
# Usual norms of a Jacobian by unit of the feature, in this unit per rad.
RATES = {"m": (0.01, 100.0), "mm": (10.0, 1e5)}


def check_possible(run: ResolvedRun, drawn: Drawn, spec: PlantSpec) -> None:
    """Refuse a start, or a target taught at joint positions, outside the joints' limits, and a target out of reach.

    Args:
        run: the run.
        drawn: its true robot and its task; without a true robot nothing is refused.
        spec: of its plant.

    Raises:
        ConfigurationError: names it and the joint, or how far it is out of reach of any true robot.
    """
    if drawn.true is None:
        return
    scenario = drawn.scenario
    for what, values in (("start", scenario.start), ("target", run.task.taught_at)):
        if values is None:
            continue
        limited = zip(spec.joint_names, values, spec.joint_lower, spec.joint_upper, strict=True)
        for joint, value, lower, upper in limited:
            if not lower <= value <= upper:
                raise ConfigurationError(
                    f"task {run.request.task}: {what} must be within the joints' limits, {lower:.4g} to "
                    f"{upper:.4g} rad for {joint}, got {value:g}"
                )
    _check_reach(run, scenario, spec)


def check_features(run: ResolvedRun, drawn: Drawn, spec: PlantSpec, desired: FloatArray) -> None:
    """Remark on a reference that is likely in mm or too fast for the arm, and on a user's features that hardly move.

    Args:
        run: the run.
        drawn: its true robot and its task.
        spec: of its plant.
        desired: (k, m) [unit of the feature], the desired features at the control instants.
    """
    request = run.request
    unit = spec.feature_unit
    true = drawn.true
    start = drawn.scenario.start
    task = f"the reference of the task {request.task}"
    if true is None or start is None:
        size = np.abs(desired).max()
        if unit == "m" and size > MAX_PLACE:
            remark(f"{task} reaches {size:g} m; if places are meant in mm, write the unit, too")
        return
    jumps = np.array(drawn.scenario.jump_periods(spec.period), dtype=np.intp)
    distances = np.delete(np.linalg.norm(np.diff(desired, axis=0), axis=1), jumps - 1)
    speed = distances.max(initial=0.0) / spec.period
    J = true.jacobian(start)
    fastest = float(np.linalg.norm(J, axis=0) @ spec.joint_velocity_limit)
    if speed > fastest:
        remark(
            f"{task} moves at {speed:.3g} {unit}/s, and the arm at {fastest:.3g} {unit}/s at most from its start"
        )
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


def _check_reach(resolved: ResolvedRun, scenario: Scenario, spec: PlantSpec) -> None:
    """Refuse a target or a curve that no true robot of the run's mismatch can reach, by its farthest point."""
    task = resolved.request.task
    taught_on_true_robot = not resolved.task.any_robot
    only_positions = resolved.request.sensing == DEFAULT_SENSING
    if find_task(task).out_of_reach or taught_on_true_robot or not only_positions:
        return
    robot = find_robot(resolved.request.robot)
    nominal = robot.nominal
    points = np.unique(scenario.reference.at(checked_instants(scenario)), axis=0)
    in_base = nominal.to_base(points)
    limits = tuple(spec.joint_lower), tuple(spec.joint_upper)
    distances = np.array(_distances(nominal, tuple(map(tuple, points)), *limits))
    beyond = distances - _room(resolved.request.mismatch, robot, in_base)
    from_shoulder = np.linalg.norm(in_base - robot.workspace.shoulder, axis=-1)
    nearest = float(from_shoulder.min())
    if nearest < 0.5 * robot.workspace.reach[0]:
        remark(
            f"task {task}: a target {1e3 * nearest:.0f} mm from the arm's shoulder is within the arm itself"
        )
    worst = int(beyond.argmax())
    if beyond[worst] > 0.0:
        where = ", ".join(f"{value:g}" for value in points[worst].round(3))
        on_purpose = [entry.name for entry in TASKS.values() if entry.out_of_reach]
        what = "its target" if len(points) == 1 else "a point of its curve,"
        raise ConfigurationError(
            f"task {task}: {what} ({where}) m in the camera frame, is {distances[worst]:.2g} m out of the arm's "
            f"reach; for a target out of reach on purpose there is the task {', '.join(on_purpose)}"
        )


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
    return longer + chord * radius
