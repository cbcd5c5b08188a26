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
from typing import Final

import numpy as np

from servobench.plant.cameras.optics import COLUMNS, NEAR, Optics, ideal_optics
from servobench.plant.cameras.setups import Mount, SensingSetup, SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.settings import remark
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera_file import OwnCamera, turning_point
from servobench.plant.robot.hand_eye import rotation_matrix, turn_about
from servobench.plant.robot.mismatch import MAX_TILT, Mismatch, draw_camera_axis
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.workspace import camera_pose

SIDE: Final = radians(60.0)  # angle of the second fixed camera's optical axis from the vertical
HAND_DISTANCE: Final = 0.5  # [m] from a camera on the hand to the target at home; for a UR5
MAX_SIZE: Final = 0.6  # usual share of the image's height that a ball takes
BASELINE: Final = 0.2  # [m] between two cameras on the hand; for a UR5
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
        """Return numbers of ±1, (count, ...), the first ones alike for any count."""
        return named_generator(seed, f"mismatch.{name}").uniform(-1.0, 1.0, (count, *shape))

    mount = named_generator(seed, "mismatch.mount_axis").standard_normal((count, 3))
    mount *= size(ON_HAND) * draw(ON_HAND, 1) / np.linalg.norm(mount, axis=-1, keepdims=True)
    return CameraDraws(
        focal=1.0 + size("focal") * draw("focal"),
        centre=size("centre") * draw("centre", 2),
        distortion=size("distortion") * draw("distortion"),
        turn=np.array([np.zeros(3), *(_draw_turn(mismatch, i, seed) for i in range(1, count))]),
        mount=mount,
    )


def _draw_turn(mismatch: Mismatch, camera: int, seed: int) -> FloatArray:
    """Return the rotation vector, (3,) rad, of a further camera, drawn as for the first one."""
    angle = mismatch.size("camera_rotation")
    axis = draw_camera_axis(
        angle, MAX_TILT, named_generator(seed, f"mismatch.camera_axis_{camera}")
    )
    share = (
        1.0
        if mismatch.camera_exact
        else named_generator(seed, f"mismatch.camera_angle_{camera}").uniform(-1, 1)
    )
    return np.asarray(share * angle * axis)


@lru_cache(maxsize=64)
def nominal_model(setup: SensingSetup, mount: Mount, robot: Robot) -> SetupModel:
    """Return the nominal arm with cameras and target as planned, which controllers may know.

    Raises:
        ValueError: the arm has too few joints for the set-up.
    """
    if robot.n < setup.least_joints:
        wanted = f"an arm of {setup.least_joints} joints or more"
        raise ValueError(f"sensing {setup.name} needs {wanted}, and {robot.title} has {robot.n}")
    if robot.camera is not None:
        _check_fit(robot.camera, setup, mount)
    c = setup.cameras
    draws = CameraDraws(
        np.ones(c), np.zeros((c, 2)), np.zeros(c), np.zeros((c, 3)), np.zeros((c, 3))
    )
    model = _model(setup, mount, robot, robot.arm, planned_cameras(setup, mount, robot), draws)
    home = robot.workspace.home
    if robot.camera is not None and not (
        model.distance > NEAR and model.valid_at(model.points(home)).all()
    ):
        where = [
            [round(value, 3) for value in point]
            for point in model.point_motions(home)[0][0].tolist()
        ]
        raise ValueError(
            f"camera {robot.camera.name} does not see the target with the arm at home: the target is at "
            f"{where} m in the camera's frame (x right, y down, z ahead); wanted another pose, mount or target"
        )
    if robot.camera is not None and (radius := robot.camera.keys.target.radius) is not None:
        size, height = 2.0 * robot.pinhole.focal * radius / model.distance, robot.pinhole.height
        if size > MAX_SIZE * height:
            remark(
                f"{robot.camera.name}: the ball takes {size:.0f} px of an image {height} px high; is it its radius?"
            )
    return model


def _check_fit(camera: OwnCamera, setup: SensingSetup, mount: Mount) -> None:
    """Refuse a user's camera that cannot be that of a set-up."""
    name = camera.name
    on, off = ("flange", "base") if mount == "hand" else ("base", "flange")
    if camera.keys.pose.frame == off:
        other = setup.name if mount == "hand" else f"{setup.name}:hand"
        raise ValueError(f"camera {name} is on the {off}; use the sensing {other}")
    if camera.keys.target.frame == on:
        raise ValueError(
            f"camera {name}: the target must be on the {off} where the camera is on the {on}"
        )
    if (camera.second is None) != (setup.cameras == 1):
        raise ValueError(
            f"sensing {setup.name} has {setup.cameras} cameras, and {name} describes {2 - (camera.second is None)}; "
            'name the file of the other one, second = "FILE", where there are two'
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
        mount: of its cameras.
        robot: the nominal one.
        arm: the true one.
        turn: (3,), rotation vector of the first camera [rad].
        draws: of all cameras.

    Raises:
        ValueError: see `nominal_model`.
    """
    nominal = nominal_model(setup, mount, robot)
    turns = [turn, *draws.turn[1:]]
    pivot = nominal.pivot(robot.workspace.centre)
    cameras = np.stack(
        [turn_about(pose, each, pivot) for pose, each in zip(nominal.cameras, turns, strict=True)]
    )
    if mount == "hand":
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
    work, own = robot.workspace, robot.camera
    if own is not None and own.keys.pose.frame:
        return np.stack(
            [
                each.keys.pose.matrix
                for each in (own, own.second)[: setup.cameras]
                if each is not None
            ]
        )
    if mount == "fixed":
        above, distance = work.camera_pose()[:3, :3], setup.closeness * work.camera_distance
        front = rotation_matrix([0.0, SIDE, 0.0]) @ above
        return np.stack(
            [camera_pose(R, work.centre, distance) for R in (above, front)[: setup.cameras]]
        )
    poses = np.stack([np.eye(4)] * setup.cameras)
    poses[:, :3, 3] = robot.arm.tool
    if setup.cameras == 2:
        half, distance = 0.5 * BASELINE * work.scale, HAND_DISTANCE * work.scale
        for pose, side in zip(poses, (-1.0, 1.0), strict=True):
            angle = -side * atan2(half, distance)
            pose[:3, 0], pose[:3, 2] = (cos(angle), 0.0, -sin(angle)), (sin(angle), 0.0, cos(angle))
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
    work, own = robot.workspace, robot.camera
    home, far = robot.arm.frames(work.home)[-1], work.camera_distance
    points = np.array(setup.target)
    side = None if own is None else own.keys.target.side
    # About its middle
    shape = work.scale * points if side is None else points * (side / max(np.ptp(points), 1e-9))
    if mount == "fixed":
        distance = setup.closeness * far
        if own is not None:
            distance = float((work.centre - robot.camera_pose[:3, 3]) @ robot.camera_pose[:3, 2])
        target = arm.tool + shape @ (home[:3, :3].T @ robot.camera_pose[:3, :3]).T
    else:
        distance = HAND_DISTANCE * work.scale
        ahead = robot.arm.tool + np.array([0.0, 0.0, distance])
        if own is not None:
            pose = planned_cameras(setup, mount, robot)[0]
            shape, ahead = shape @ pose[:3, :3].T, pose[:3, 3] + distance * pose[:3, 2]
            if own.keys.target.frame:
                ahead = (np.array(own.keys.target.position) - home[:3, 3]) @ home[:3, :3]
                distance = float((ahead - pose[:3, 3]) @ pose[:3, 2])
        target = (shape + ahead) @ home[:3, :3].T + home[:3, 3]
    return SetupModel(
        arm,
        setup,
        mount,
        cameras,
        _optics(setup, robot, draws),
        target,
        distance,
        robot.pinhole,
        far,
    )


def _optics(setup: SensingSetup, robot: Robot, draws: CameraDraws) -> Optics:
    """Return the intrinsics of the cameras as drawn; those of depth are rectified."""
    optics = ideal_optics(robot.pinhole, setup.cameras)
    focal, centre, distortion, further = optics.focal, optics.centre, draws.distortion, None
    if robot.camera is not None and setup.unit == "px":
        own = [each for each in (robot.camera, robot.camera.second) if each is not None]
        K = np.array([each.matrix for each in own])
        focal, centre = K[:, 0, 0], K[:, :2, 2]
        distortion = np.array([each.distortion[0] for each in own]) + draws.distortion
        further = _further(own, distortion)
        if (
            further.shape[1] == COLUMNS["plumb_bob"]
            and (further[:, :5] == (1.0, 0.0, 0.0, 0.0, 0.0)).all()
        ):
            further = None
    return Optics(focal * draws.focal, centre + draws.centre, distortion, optics.size, further)


def _further(own: Sequence[OwnCamera], distortion: FloatArray) -> FloatArray:
    """Return the further numbers of calibrated cameras, see `Optics.further`, with k₁ as drawn, (c,)."""
    width = max(COLUMNS[each.lens] for each in own)
    further = np.zeros((len(own), width))
    for row, camera, k1 in zip(further, own, distortion.tolist(), strict=True):
        _, *others = camera.distortion
        if camera.lens == "equidistant":
            k2, k3, k4 = others
            row[:5] = 1.0, k2, 0.0, 0.0, k3
            row[6] = k4
        else:
            row[1:5] = others[:4]
            row[6 : 2 + len(others)] = others[4:]
        row[0] = camera.matrix[1, 1] / camera.matrix[0, 0]
        row[5] = turning_point((k1, *others))
    return further
