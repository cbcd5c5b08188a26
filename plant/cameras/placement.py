"""Poses of the cameras and the target of a set-up: planned around a robot's workspace, and as drawn for a run.

Fixed cameras are directed at the middle of the workspace from the same distance: the first one from above, as planned
for `position`, a second one from in front, `SIDE` from the vertical. The target is on the flange, in place of the ball,
and a plate faces the first camera at the arm's home.

Cameras on the hand are in place of the ball and directed along the flange's axis; two of them are `BASELINE` apart and
turned towards a common point. The target is in the world, at that point for the arm at home.

The cameras of a run are drawn by name and seed, as the arm is. Focal lengths are scaled, principal points shifted and
radial distortions set, each drawn uniformly from plus or minus the magnitude. A camera on the hand is turned about its
own centre as well, by an angle drawn below `mount` about a random axis. Every further camera of a set-up turns as the
first one does (`camera_rotation`), by draws of its own. Every axis has a random stream of its own; a camera has the
same draws in every set-up.

A camera of the user's is where its file says, and its deviations are drawn on top of the file. Its target, where the
file does not place it, is on its optical axis with the arm at home, if it is on the hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from math import atan2, cos, radians, sin

import numpy as np

from servobench.plant.cameras.optics import COLUMNS, NEAR, Optics, ideal_optics
from servobench.plant.cameras.setups import SensingSetup, SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.settings import remark
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera_file import OwnCamera, turning_point
from servobench.plant.robot.hand_eye import Mount, rotation_matrix, turn_about
from servobench.plant.robot.mismatch import MAX_TILT, Mismatch, draw_camera_axis
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.workspace import camera_pose

SIDE = radians(60.0)  # angle of the second fixed camera's optical axis from the vertical
HAND_DISTANCE = 0.5  # [m] from a camera on the hand to the target at home; for a UR5
MAX_BALL_SHARE = 0.6  # [1] usual largest share of the image's height that a ball takes
BASELINE = 0.2  # [m] between two cameras on the hand; for a UR5
OPTICAL = ("focal", "centre", "distortion")  # axes of a mismatch that a camera in pixels has
ON_HAND = "mount"  # the axis that a camera on the hand has


@dataclass(frozen=True, eq=False)
class CameraDraws:
    """The values drawn for c cameras."""

    focal: FloatArray  # (c,), factors on the focal lengths
    centre: FloatArray  # (c, 2), shifts of the principal points [px]
    distortion: FloatArray  # (c,), k of the radial distortion [1]
    turn: FloatArray  # (c, 3), rotation vectors [rad] of the cameras after the first, whose own is the robot's
    mount: FloatArray  # (c, 3), rotation vectors [rad] about the cameras' own centres

    def as_record(self) -> dict[str, object]:
        """Return the values as plain lists, for JSON."""
        return {
            f"camera_{field.name}": getattr(self, field.name).tolist() for field in fields(self)
        }


def draw_cameras(mismatch: Mismatch, count: int, seed: int) -> CameraDraws:
    """Draw the deviations of `count` cameras from the planned ones; `seed` is that of the robot's mismatch."""
    size = mismatch.size

    def draw(name: str, *shape: int) -> FloatArray:
        """Return numbers from −1 to 1, (count, ...), the first ones alike for any count."""
        return named_generator(seed, f"mismatch.{name}").uniform(-1.0, 1.0, (count, *shape))

    axis = named_generator(seed, "mismatch.mount_axis").standard_normal((count, 3))
    length = np.linalg.norm(axis, axis=-1, keepdims=True)
    mount = axis * (size(ON_HAND) * draw(ON_HAND, 1) / length)
    further_turns = [_draw_turn(mismatch, camera, seed) for camera in range(1, count)]
    return CameraDraws(
        focal=1.0 + size("focal") * draw("focal"),
        centre=size("centre") * draw("centre", 2),
        distortion=size("distortion") * draw("distortion"),
        turn=np.array([np.zeros(3), *further_turns]),
        mount=mount,
    )


def _no_draws(count: int) -> CameraDraws:
    """Return the values of `count` cameras that are as planned."""
    no_turn = np.zeros((count, 3))
    return CameraDraws(np.ones(count), np.zeros((count, 2)), np.zeros(count), no_turn, no_turn)


def _draw_turn(mismatch: Mismatch, camera: int, seed: int) -> FloatArray:
    """Return the rotation vector, (3,) rad, of a further camera, drawn as for the first one."""
    angle = mismatch.size("camera_rotation")
    axis_generator = named_generator(seed, f"mismatch.camera_axis_{camera}")
    axis = draw_camera_axis(angle, MAX_TILT, axis_generator)
    share = 1.0
    if not mismatch.camera_exact:
        share = named_generator(seed, f"mismatch.camera_angle_{camera}").uniform(-1, 1)
    return share * angle * axis


@lru_cache(maxsize=64)
def nominal_model(setup: SensingSetup, mount: Mount, robot: Robot) -> SetupModel:
    """Return the nominal arm with cameras and target as planned, which controllers may know.

    Raises:
        ValueError: the arm has too few joints for the set-up.
    """
    if robot.n < setup.least_joints:
        raise ValueError(
            f"sensing {setup.name} needs an arm of {setup.least_joints} joints or more, and {robot.title} has "
            f"{robot.n}"
        )
    if robot.camera is not None:
        _check_fit(robot.camera, setup, mount)
    cameras = planned_cameras(setup, mount, robot)
    model = _model(setup, mount, robot, robot.arm, cameras, _no_draws(setup.cameras))
    if robot.camera is not None:
        _check_target(robot.camera, model, robot.workspace.home)
    return model


def _check_fit(camera: OwnCamera, setup: SensingSetup, mount: Mount) -> None:
    """Refuse a user's camera that cannot be that of a set-up."""
    name = camera.name
    on, off = "base", "flange"
    other = f"{setup.name}:hand"
    if mount == "hand":
        on, off = "flange", "base"
        other = setup.name
    if camera.keys.pose.frame == off:
        raise ValueError(f"camera {name} is on the {off}; use the sensing {other}")
    if camera.keys.target.frame == on:
        raise ValueError(
            f"camera {name}: the target must be on the {off} where the camera is on the {on}"
        )
    described = len(camera.pair)
    if (described == 1) != (setup.cameras == 1):
        raise ValueError(
            f"sensing {setup.name} has {setup.cameras} cameras, and {name} describes {described}; "
            'name the file of the other one, second = "FILE", where there are two'
        )


def _check_target(camera: OwnCamera, model: SetupModel, home: FloatArray) -> None:
    """Refuse a user's camera that does not see the target with the arm at home; remark on a ball that fills the image.

    Raises:
        ValueError: the target is behind the camera or beside its image.
    """
    ahead = model.distance > NEAR
    if not (ahead and model.valid_at(model.points(home)).all()):
        points, _ = model.point_motions(home)
        where = [[round(value, 3) for value in point] for point in points[0].tolist()]
        raise ValueError(
            f"camera {camera.name} does not see the target with the arm at home: the target is at "
            f"{where} m in the camera's frame (x right, y down, z ahead); wanted another pose, mount or target"
        )
    radius = camera.keys.target.radius
    if radius is None:
        return
    height = camera.pinhole.height
    size = 2.0 * camera.pinhole.focal * radius / model.distance
    if size > MAX_BALL_SHARE * height:
        remark(
            f"{camera.name}: the ball takes {size:.0f} px of an image {height} px high; is it its radius?"
        )


def true_model(
    setup: SensingSetup,
    mount: Mount,
    robot: Robot,
    arm: SerialArm,
    turn: FloatArray,
    draws: CameraDraws,
) -> SetupModel:
    """Return a true arm with cameras as drawn.

    Args:
        setup: the set-up.
        mount: where its cameras are mounted.
        robot: the nominal one.
        arm: the true one.
        turn: (3,), rotation vector of the first camera [rad].
        draws: the values drawn for all cameras.

    Raises:
        ValueError: see `nominal_model`.
    """
    nominal = nominal_model(setup, mount, robot)
    turns = [turn, *draws.turn[1:]]
    pivot = nominal.pivot(robot.workspace.centre)
    turned = [
        turn_about(pose, rotation, pivot)
        for pose, rotation in zip(nominal.cameras, turns, strict=True)
    ]
    cameras = np.stack(turned)
    if mount == "hand":
        # R_FC ← R_FC R(mount): the camera turns about its own centre, which moves with the tool.
        cameras[:, :3, :3] @= rotation_matrix(draws.mount)
        cameras[:, :3, 3] += arm.tool - robot.arm.tool
    return _model(setup, mount, robot, arm, cameras, draws)


def planned_cameras(setup: SensingSetup, mount: Mount, robot: Robot) -> FloatArray:
    """Return the poses of the cameras as planned, (c, 4, 4), in the frame that they are mounted on.

    Raises:
        ValueError: more cameras than there are places for.
    """
    if setup.cameras not in (1, 2):
        raise ValueError(
            f"{setup.name} needs {setup.cameras} cameras, and there are places for one or two"
        )
    own = robot.camera
    if own is not None and own.keys.pose.frame:
        described = own.pair[: setup.cameras]
        return np.stack([camera.keys.pose.matrix for camera in described])
    if mount == "hand":
        return _planned_hand_cameras(setup, robot)
    work = robot.workspace
    distance = setup.closeness * work.camera_distance
    above = work.camera_pose()[:3, :3]
    front = rotation_matrix([0.0, SIDE, 0.0]) @ above
    rotations = (above, front)[: setup.cameras]
    return np.stack([camera_pose(R, work.centre, distance) for R in rotations])


def _planned_hand_cameras(setup: SensingSetup, robot: Robot) -> FloatArray:
    """Return the poses of one or two cameras on the hand, (c, 4, 4), in the flange frame."""
    poses = np.stack([np.eye(4)] * setup.cameras)
    poses[:, :3, 3] = robot.arm.tool
    if setup.cameras == 2:
        half = 0.5 * BASELINE * robot.workspace.scale
        distance = HAND_DISTANCE * robot.workspace.scale
        for pose, side in zip(poses, (-1.0, 1.0), strict=True):
            # A turn about y directs each camera at the common point ahead.
            angle = -side * atan2(half, distance)
            pose[:3, 0] = (cos(angle), 0.0, -sin(angle))
            pose[:3, 2] = (sin(angle), 0.0, cos(angle))
            pose[:3, 3] += (side * half, 0.0, 0.0)
    return poses


def _model(
    setup: SensingSetup,
    mount: Mount,
    robot: Robot,
    arm: SerialArm,
    cameras: FloatArray,
    draws: CameraDraws,
) -> SetupModel:
    """Return an arm with cameras at given poses, (c, 4, 4), and the target in front of them."""
    if mount == "fixed":
        target, distance = _target_on_flange(setup, robot, arm)
    else:
        target, distance = _target_in_world(setup, robot)
    return SetupModel(
        arm,
        setup,
        mount,
        cameras,
        _optics(setup, robot, draws),
        target,
        distance,
        planned=robot.pinhole,
        far=robot.workspace.camera_distance,
    )


def _target_shape(setup: SensingSetup, robot: Robot) -> FloatArray:
    """Return the points of the target about its middle, (p, 3) m, in a frame that faces the first camera."""
    points = np.array(setup.target)
    own = robot.camera
    if own is None or own.keys.target.side is None:
        return robot.workspace.scale * points
    return points * (own.keys.target.side / max(np.ptp(points), 1e-9))


def _target_on_flange(
    setup: SensingSetup, robot: Robot, arm: SerialArm
) -> tuple[FloatArray, float]:
    """Return a target in place of the ball, (p, 3) m in the flange frame, and its distance from fixed cameras [m]."""
    work = robot.workspace
    distance = setup.closeness * work.camera_distance
    X_BC = robot.camera_pose
    if robot.camera is not None:
        distance = float((work.centre - X_BC[:3, 3]) @ X_BC[:3, 2])
    # R_FC with the arm at home, at which a plate faces the first camera
    R_BF = robot.arm.frames(work.home)[-1, :3, :3]
    R_FC = R_BF.T @ X_BC[:3, :3]
    target = arm.tool + _target_shape(setup, robot) @ R_FC.T
    return target, distance


def _target_in_world(setup: SensingSetup, robot: Robot) -> tuple[FloatArray, float]:
    """Return a target ahead of the hand at home, (p, 3) m in the base frame, and its distance from the camera [m]."""
    own = robot.camera
    X_BF = robot.arm.frames(robot.workspace.home)[-1]
    distance = HAND_DISTANCE * robot.workspace.scale
    shape = _target_shape(setup, robot)
    middle = robot.arm.tool + np.array([0.0, 0.0, distance])  # in the flange frame
    if own is not None:
        X_FC = planned_cameras(setup, "hand", robot)[0]
        shape = shape @ X_FC[:3, :3].T
        middle = X_FC[:3, 3] + distance * X_FC[:3, 2]
        if own.keys.target.frame:
            middle = (np.array(own.keys.target.position) - X_BF[:3, 3]) @ X_BF[:3, :3]
            distance = float((middle - X_FC[:3, 3]) @ X_FC[:3, 2])
    target = (shape + middle) @ X_BF[:3, :3].T + X_BF[:3, 3]
    return target, distance


def _optics(setup: SensingSetup, robot: Robot, draws: CameraDraws) -> Optics:
    """Return the intrinsics of the cameras as drawn; those of depth are rectified."""
    planned = ideal_optics(robot.pinhole, setup.cameras)
    focal = planned.focal
    centre = planned.centre
    distortion = draws.distortion
    further = None
    if robot.camera is not None and setup.unit == "px":
        own = robot.camera.pair
        K = np.array([each.matrix for each in own])
        focal = K[:, 0, 0]
        centre = K[:, :2, 2]
        distortion = np.array([each.distortion[0] for each in own]) + draws.distortion
        further = _further(own, distortion)
        # Square pixels and k₁ alone need no further numbers.
        is_usual = further.shape[1] == COLUMNS["plumb_bob"]
        if is_usual and (further[:, :5] == (1.0, 0.0, 0.0, 0.0, 0.0)).all():
            further = None
    focal = focal * draws.focal
    centre = centre + draws.centre
    return Optics(focal, centre, distortion, planned.size, further)


def _further(own: Sequence[OwnCamera], distortion: FloatArray) -> FloatArray:
    """Return the further numbers of calibrated cameras, see `Optics.further`, with k₁ as drawn, (c,)."""
    width = max(COLUMNS[each.lens] for each in own)
    further = np.zeros((len(own), width))
    for row, camera, k1 in zip(further, own, distortion.tolist(), strict=True):
        _, *others = camera.distortion
        if camera.lens == "equidistant":
            k2, k3, k4 = others
            row[1] = k2
            row[4] = k3
            row[6] = k4
        else:
            # k₂, p₁, p₂, k₃, and behind the largest r² the rational model's k₄, k₅, k₆
            row[1:5] = others[:4]
            row[6 : 2 + len(others)] = others[4:]
        row[0] = camera.matrix[1, 1] / camera.matrix[0, 0]
        row[5] = turning_point((k1, *others))
    return further
