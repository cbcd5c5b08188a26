"""Starts and targets: drawn in a box of joint positions until they are fit, or found for a displaced pose.

A posture is fit if what hangs on the flange is above the table and the workspace knows of no contact there. Where the
camera is moved during the run, the arm reaches a target that was taught before it afterwards, too.

Where cameras see pixels, it must also be that the nominal cameras see all features away from the edges of their images
and the true ones see them at all, and that the target faces the first camera. The box of joint positions from which
postures are drawn keeps away from the limits.

The poses are those of the four canonical tasks of Gans, Hutchinson and Corke, "Performance Tests for Visual Servo
Control Systems, with Application to Partitioned Approaches to Visual Servo Control", International Journal of Robotics
Research 22 (2003). The arm's home is the goal, and its image is the reference. At the start the target stands
differently before the first camera:

    X_CT(start) = D X_CT(home)

| task | D |
|---|---|
| `axis_turn` | a turn about the optical axis |
| `retreat` | nearer along the optical axis, so that the camera has to retreat |
| `camera_turn` | a turn about the camera's y axis through its centre |
| `plane_turn` | a turn about an axis in the plane of the features, through their middle |

The start is found on the nominal arm. Where an arm cannot reach it with the target in view, D is made smaller.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from annotated_types import Gt, Le

from servobench.harness.run.scenario import Cameras, Scenario, Task, TaskSetting, Vector, numbers
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.checks import FloatArray, as_array
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.settings import Number, Positive, settings
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.camera import CAMERA
from servobench.plant.robot.hand_eye import HandEyeModel, rotation_matrix
from servobench.plant.robot.inverse import reach_pose
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.ur5 import TRAINING_LOWER, TRAINING_UPPER
from servobench.plant.robot.workspace import Workspace

PLACES = "start_and_target"  # name of the generator from which they are drawn
MAX_PAIRS = 1000  # pairs of start and target; one in two fits
PAIRS_AT_ONCE = 4
DRAWN_AT_ONCE = 256
MAX_DRAWS = 25_600
# Shares of the images' half sides within which the planned and the true cameras see the features.
PLANNED_SHARE = 0.8
TRUE_SHARE = 0.95
FACING = 0.7  # cosine of the angle between the target's front and the camera: 45°
REACHED = 1e-6  # largest error of `reach_pose` for a pose that is reached
SHARES = (1.0, 0.8, 0.6, 0.4, 0.2)  # shares of D that are tried
STEPS = 8  # in which the arm is led from home to the start
IN_VIEW = 0.9  # share of the image's half sides within which the target is at the start


# Joint positions of start and target, (n,) and (n,) [rad]
Move: TypeAlias = tuple[FloatArray, FloatArray]


class Box(NamedTuple):
    """Where to draw."""

    lower: FloatArray  # (n,) [rad]
    upper: FloatArray  # (n,) [rad]
    shortest: float  # motion from start to target that the ball of the planned fixed camera would need [m]
    lowest: float  # height of the ball, or of the camera on the hand, above the table [m]


@settings
class BoxTask(Task):
    """A task whose postures are drawn by the run's seed from a box of joint positions."""

    lower: Vector = TRAINING_LOWER
    """[rad] lower corner of the box"""
    upper: Vector = TRAINING_UPPER
    """[rad] upper corner of the box"""
    shortest: Number = 0.1
    """[m] least distance between start and target on the nominal model"""
    lowest: Number = 0.08
    """[m] least height of the ball above the table on the nominal model"""

    def box(self, setting: TaskSetting) -> Box:
        """Return where to draw the postures of the arm on which targets are taught.

        Raises:
            ValueError: corners of another size, or exchanged; or the plant brings a robot of its own.
        """
        robot, _ = setting.taught_on()
        lower, upper = (
            as_array(f"its setting {name}", getattr(self, name), (robot.n,))
            for name in ("lower", "upper")
        )
        if not (lower < upper).all():
            raise ValueError("lower must be below upper for every joint")
        return Box(lower, upper, self.shortest, self.lowest)

    def scaled(self, name: str, work: Workspace) -> Self:
        """See `Task.scaled`."""
        return replace(
            self,
            lower=numbers(work.lower),
            upper=numbers(work.upper),
            shortest=work.scale * self.shortest,
            lowest=work.scale * self.lowest,
        )


def drawn_moves(box: Box, setting: TaskSetting, generator: np.random.Generator) -> Iterator[Move]:
    """Yield joint positions of start and target, (n,) and (n,) rad, of moves that are fit.

    Raises:
        ValueError: too few postures are fit.
    """
    robot, _ = setting.taught_on()
    cameras = setting.cameras()
    if cameras is not None:
        while True:
            yield draw_in_view(box, setting, cameras.planned, generator)
    for _ in range(MAX_PAIRS // PAIRS_AT_ONCE):
        pairs = generator.uniform(box.lower, box.upper, (PAIRS_AT_ONCE, 2, robot.n))
        balls = robot.arm.ball_position(pairs)
        apart = norm(balls[:, 1] - balls[:, 0]) >= box.shortest
        fit = apart & _is_free(pairs, box, robot).all(axis=-1)
        for start, target in pairs[fit]:
            if stays_in_reach(target, box, setting):
                yield start, target
    raise ValueError(
        f"no start and target between lower and upper are apart by shortest = {box.shortest:g} m and above "
        f"the table by lowest = {box.lowest:g} m; lessen these, or widen the box"
    )


def are_fit(postures: FloatArray, box: Box, setting: TaskSetting) -> BoolArray:
    """Return which of the postures (k, n) rad are fit, (k,), wherever the camera is moved."""
    robot, _ = setting.taught_on()
    fit = _is_free(postures, box, robot)
    cameras = setting.cameras()
    if cameras is not None:
        fit[fit] = _in_view(postures[fit], cameras)
    return fit


def are_apart(postures: FloatArray, place: FloatArray, box: Box, setting: TaskSetting) -> BoolArray:
    """Return which of the postures (k, n) rad are as far from a place (n,) rad as a target from its start, (k,)."""
    robot = setting.taught_on()[0]
    if isinstance(setting.nominal, SetupModel):
        features = setting.nominal.feature(postures)
        least = box.shortest * setting.nominal.noise_unit
        return norm(features - setting.nominal.feature(place)) >= least
    balls = robot.arm.ball_position(postures)
    return norm(balls - robot.arm.ball_position(place)) >= box.shortest


def stays_in_reach(target: FloatArray, box: Box, setting: TaskSetting) -> bool:
    """Return whether a target that was taught at (n,) rad before the camera's move is in easy reach after it."""
    if not isinstance(setting.moved, HandEyeModel):
        return True
    robot, true = setting.taught_on()
    point = setting.moved.to_base(true.feature(target))
    nearest, farthest = robot.workspace.reach
    distance = np.linalg.norm(point - robot.workspace.shoulder)
    return bool(point[2] >= box.lowest and nearest <= distance <= farthest)


def draw_in_view(
    box: Box, setting: TaskSetting, planned: SetupModel, generator: np.random.Generator
) -> Move:
    """Return joint positions of start and target, (n,) and (n,) rad.

    Args:
        box: where to draw.
        setting: with the true arm and cameras.
        planned: the nominal robot with its cameras as planned.
        generator: of the draws.

    Raises:
        ValueError: too few postures are fit.
    """
    # The same distance in the image, however near the camera is.
    least = box.shortest * planned.noise_unit
    found = np.empty((MAX_DRAWS, setting.n))
    features = np.empty((MAX_DRAWS, len(planned.channel.names)))
    count = 0
    for _ in range(MAX_DRAWS // DRAWN_AT_ONCE):
        drawn = generator.uniform(box.lower, box.upper, (DRAWN_AT_ONCE, setting.n))
        for posture in drawn[are_fit(drawn, box, setting)]:
            found[count] = posture
            features[count] = planned.feature(posture)
            far = norm(features[count] - features[:count]) >= least
            if far.any():
                return found[far.argmax()], posture
            count += 1
    raise ValueError(
        f"{count} of {MAX_DRAWS} postures between lower and upper are in view and above lowest = {box.lowest:g} "
        f"m, and no two of these are shortest = {box.shortest:g} m apart"
    )


def drawn_together(start: FloatArray, target: FloatArray, robot: Robot, cameras: Cameras) -> Move:
    """Return start and target of a move, (n,) and (n,) rad, drawn together in tenths until both are in view.

    They are drawn towards the arm's home, where the target is in the middle of the images.

    Raises:
        ValueError: not even near the home both are in view.
    """
    home = robot.workspace.home
    for tenths in range(10, 0, -1):
        both = home + 0.1 * tenths * (np.stack([start, target]) - home)
        if _in_view(both, cameras).all():
            if tenths == 10:
                return (start, target)
            return (both[0], both[1])
    remedy = "use another mismatch"
    if robot.camera:
        remedy = f"look at [pose] in {robot.camera.name}, whose z axis is the optical axis"
    raise ValueError(
        f"start and target must be in view, and near the arm's home they are not; {remedy}"
    )


def _is_free(postures: FloatArray, box: Box, robot: Robot) -> BoolArray:
    """Return in which postures (..., n) rad nothing touches the table or the arm, (...)."""
    free = robot.arm.ball_position(postures)[..., 2] >= box.lowest
    if robot.workspace.clear is not None:
        free &= robot.workspace.clear(postures)
    return free


def _in_view(postures: FloatArray, cameras: Cameras) -> BoolArray:
    """Return in which postures (k, n) rad the cameras see all features as they should, (k,)."""
    planned, true = cameras
    points = planned.points(postures)
    foreseen = planned.valid_at(points, PLANNED_SHARE).all(axis=-1)
    facing = planned.incidence(points) >= FACING
    # Marks may be larger in a user's image.
    share = TRUE_SHARE if planned.planned == CAMERA else PLANNED_SHARE
    seen = true.valid_at(true.points(postures), share).all(axis=-1)
    return foreseen & facing & seen


@settings
class PoseTask(Task):
    """A move of a target with a pose, or of cameras before one, from a displaced start to home."""

    displacement: Literal["axis_turn", "retreat", "camera_turn", "plane_turn"] = "axis_turn"
    """which of the four canonical ones"""
    angle: Annotated[
        float, Gt(0.0), Le(180.0), Only(displacement=("axis_turn", "camera_turn", "plane_turn"))
    ] = 45.0
    """[deg] by which the start is turned"""
    nearer: Annotated[float, Gt(0.0), Le(0.8), Only(displacement="retreat")] = 0.25
    """[1] share of the distance by which the start is nearer"""
    duration: Positive = 10.0
    """[s] length of the run"""

    def scenario(self, setting: TaskSetting) -> Scenario:
        """See `Task.scenario`."""
        robot, _ = setting.taught_on()
        cameras = setting.cameras()
        if cameras is None or not cameras.true.setup.judges_pose:
            raise ValueError("it needs a target with a pose; use the sensing plate or plate:hand")
        start = pose_start(self, robot, cameras.planned)
        return setting.move(start, setting.taught(robot.workspace.home), self.duration)


def displaced(config: PoseTask, middle: FloatArray) -> FloatArray:
    """Return D, (4, 4), for a target whose middle is at (3,) m in the camera frame at home; see the module."""
    D = np.eye(4)
    angle = np.radians(config.angle)
    match config.displacement:
        case "axis_turn":
            D[:3, :3] = rotation_matrix([0.0, 0.0, angle])
        case "retreat":
            D[2, 3] = -config.nearer * middle[2]
        case "camera_turn":
            D[:3, :3] = rotation_matrix([0.0, angle, 0.0])
        case "plane_turn":
            D[:3, :3] = rotation_matrix([angle, 0.0, 0.0])
            D[:3, 3] = middle - D[:3, :3] @ middle
    return D


def pose_start(config: PoseTask, robot: Robot, nominal: SetupModel) -> FloatArray:
    """Return the start, (n,) rad, on the nominal arm with its cameras as planned.

    Raises:
        ValueError: no share of the displacement can be reached with the target in view.
    """
    home = robot.workspace.home
    inverse = np.linalg.inv(nominal.camera)
    middle = inverse[:3, :3] @ nominal.points(home).mean(axis=0) + inverse[:3, 3]
    for share in SHARES:
        start = _led(config, share, robot, nominal, middle)
        if start is not None and nominal.valid_at(nominal.points(start), IN_VIEW).all():
            return start
    raise ValueError(
        f"{robot.title} cannot reach the start of {config.displacement} with the target in view"
    )


def _led(
    config: PoseTask, share: float, robot: Robot, nominal: SetupModel, middle: FloatArray
) -> FloatArray | None:
    """Return the joint positions at a share of the displacement, led there from home in steps; None if out of reach."""
    limits = robot.limits
    camera = nominal.camera
    q = robot.workspace.home
    at_home = robot.arm.frames(q)[-1]
    for step in np.linspace(0.0, share, STEPS + 1)[1:].tolist():
        part = replace(config, angle=step * config.angle, nearer=step * config.nearer)
        D = displaced(part, middle)
        # The motion of the target in the frame that the camera is mounted on.
        moved = camera @ D @ np.linalg.inv(camera)
        pose = moved @ at_home if nominal.mount == "fixed" else at_home @ np.linalg.inv(moved)
        q, error = reach_pose(robot.arm, pose, q, limits.lower, limits.upper)
        if error > REACHED:
            return None
    return q
