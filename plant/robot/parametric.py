"""A robot's features as a function of its joints and of the parameters by which it deviates from the planned one.

The parameters θ are those of a twin (`servobench.plant.robot.twin`): tool, gears g, zeros o and lengths l of the
links; and the pose of each camera. With the joints' axes z_i and origins p_i, a point t of the target moves in the base
frame by

    ∂t/∂q_i = g_i z_i × (t − p_i)        ∂t/∂o_i = z_i × (t − p_i)        ∂t/∂g_i = q_i ∂t/∂o_i
    ∂t/∂l = l₀ a                         ∂t/∂tool = R_F

with the axis a of the planned length l₀, g_i = ḡ_i (1 + gear_i), and the flange's rotation R_F. Cameras on the hand see
the opposite: p = R_Fᵀ (t − p_F) moves by −R_Fᵀ times this, and by R_Fᵀ with the target's place in the base frame, which
stands in for the tool. In camera c, x = R_cᵀ (p − p_c) moves by R_cᵀ ∂p, and with the camera itself, turned by a
rotation vector δ in its own frame or moved by d in that of its mount, by

    ∂x/∂δ = [x]×                         ∂x/∂d = −R_cᵀ

All arrays have leading axes: an ensemble of robots, or runs side by side, is one model.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, TypeAlias, final

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.features import Derivatives
from servobench.plant.contract.lanes import nearest_rotation
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.hand_eye import RobotModel, rotation_matrix
from servobench.plant.robot.twin import TOOL, links_of

TARGET: Final = ("target_x", "target_y", "target_z")
"""[m] added to the target's place in the base frame, for cameras on the hand."""
ALIGNMENT: Final = 0.002  # [m²] weight of the planned rotation in `placed`
Indices: TypeAlias = npt.NDArray[np.int_]
POSE: Final = ("turn_x", "turn_y", "turn_z", "x", "y", "z")


@final
@dataclass(frozen=True, eq=False)
class ParametricModel:
    """The features of a robot by its joints and parameters.

    A state is the pair of `theta`, (..., P), and `cameras`, (..., c, 4, 4). The parameters of a camera's pose are
    increments: `moved` puts them into `cameras` and leaves 0, so that no rotation vector comes near a turn.
    """

    planned: RobotModel  # the robot that θ = 0 stands for; without leading axes

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of the P parameters."""
        joints = self.planned.arm.joint_names
        place = TARGET if self.planned.mount == "hand" else TOOL
        links = [name for name, _, _ in links_of(self.planned.arm)]
        poses = []
        for camera in range(len(self.planned.poses)):
            prefix = "camera" if camera == 0 else f"camera{camera + 1}"
            poses += [f"{prefix}_{each}" for each in POSE]
        gears = [f"gear_{name}" for name in joints]
        zeros = [f"zero_{name}" for name in joints]
        return (*place, *gears, *zeros, *links, *poses)

    def columns(self, prefix: str) -> slice:
        """Return the place of the parameters whose names begin with a prefix, such as `gear_`, in θ."""
        found = [index for index, name in enumerate(self.names) if name.startswith(prefix)]
        if not found:
            return slice(0, 0)
        return slice(found[0], found[-1] + 1)

    @cached_property
    def pose_columns(self) -> slice:
        """The place of the cameras' increments in θ."""
        end = len(self.names)
        return slice(end - len(POSE) * len(self.planned.poses), end)

    def start(self, lead: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Return `theta` and `cameras` of the planned robot for leading axes."""
        cameras = self.planned.poses
        theta = np.zeros((*lead, len(self.names)))
        return theta, np.broadcast_to(cameras, (*lead, *cameras.shape))

    def moved(
        self, theta: FloatArray, cameras: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the state after a step, (..., P), of all parameters."""
        theta = theta + step
        increments = theta[..., self.pose_columns]
        pose = increments.reshape(*increments.shape[:-1], -1, len(POSE))
        new = cameras.copy()
        turns = rotation_matrix(pose[..., :3])
        new[..., :3, :3] = cameras[..., :3, :3] @ turns
        new[..., :3, 3] += pose[..., 3:]
        theta[..., self.pose_columns] = 0.0
        return theta, new

    def robot(self, theta: FloatArray, cameras: FloatArray) -> RobotModel:
        """Return the robot of a state for joint positions side by side: its leading axes end in one of length 1 or k.

        Args:
            theta: (..., P).
            cameras: (..., 1 or k, c, 4, 4).
        """
        planned = self.planned.arm
        n = planned.n
        lead = theta.shape[:-1]
        translation = np.broadcast_to(planned.translation, (*lead, n + 1, 3)).copy()
        row, axis = self._lengths
        translation[..., row, axis] *= 1.0 + theta[..., self._links]
        place = theta[..., :3]
        on_flange = self.planned.mount == "fixed"
        arm = SerialArm(
            joint_names=planned.joint_names,
            translation=translation[..., None, :, :],
            rpy=np.broadcast_to(planned.rpy, (*lead, 1, n + 1, 3)),
            joint_offset=(planned.joint_offset + theta[..., self._zeros])[..., None, :],
            gear_ratio=(planned.gear_ratio * (1.0 + theta[..., self._gears]))[..., None, :],
            tool=(planned.tool + place * on_flange)[..., None, :],
        )
        model = self.planned.rebuilt(arm, cameras)
        if on_flange:
            return model
        return model.with_target(self.planned.marks + place[..., None, None, :])

    def feature(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        turn: FloatArray | None = None,
    ) -> FloatArray:
        """Return y, (..., k, m), for joint positions (..., k, n) [rad]; `turn` as in `derivatives`."""
        model = self.robot(theta, turned(cameras, turn))
        return model.measure(model.in_cameras(model.points(joints)))

    def derivatives(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        turn: FloatArray | None = None,
    ) -> Derivatives:
        """Return features and derivatives.

        Args:
            theta: (..., P).
            cameras: (..., c, 4, 4).
            joints: (..., k, n) [rad].
            turn: by which the first camera is turned about its optical axis, (..., k) [rad]; None for 0.
        """
        model = self.robot(theta, turned(cameras, turn))
        frames = model.arm.frames(joints)
        flange = frames[..., -1, :, :]
        target = model.in_base(flange)
        motions = self._motions(model.arm, frames, target, joints)
        if model.mount == "hand":
            # Seen from the hand, the target moves the opposite way, but with its own place.
            motions = -np.vecmat(motions, flange[..., None, None, :3, :3])
        count = motions.shape[-2]
        by_place = np.swapaxes(flange[..., :3, :3], -1, -2)
        if model.mount == "hand":
            by_place = flange[..., :3, :3]
        by_place = np.broadcast_to(by_place[..., None, :, :], (*motions.shape[:-2], 3, 3))
        motions = np.concatenate([motions, by_place], axis=-2)

        points = model.in_cameras(model.mounted(flange, target))
        rotations = model.poses[..., None, None, :3, :3]
        in_camera = np.vecmat(motions[..., None, :, :, :], rotations)
        seen = np.swapaxes(in_camera, -1, -2)
        every = np.concatenate([seen, self._by_pose(model, points, turn)], axis=-1)
        y = model.measure(points)
        rates = model.change(points, every)
        n = model.arm.n
        by_joint = rates[..., :n]
        by_parameter = np.concatenate(
            [rates[..., count : count + 3], rates[..., n:count], rates[..., count + 3 :]], axis=-1
        )
        return Derivatives(y, by_joint, by_parameter)

    def placed(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        features: FloatArray,
        weight: FloatArray,
    ) -> FloatArray:
        """Return cameras (..., c, 4, 4) from which seen places fit arms best, by Kabsch; other features: those given.

        Args:
            theta: (..., P).
            cameras: (..., c, 4, 4).
            joints: (..., k, n) [rad].
            features: (..., k, m).
            weight: of each frame, (..., k).
        """
        if self.planned.channel.unit != "m" or self.planned.mount != "fixed":
            return cameras
        model = self.robot(theta, turned(cameras, None))
        ball = model.points(joints)[..., 0, :]
        total = np.add.reduce(weight, axis=-1)
        share = (weight / total[..., None])[..., None, :]
        middle = share @ ball
        mean = share @ features
        planned = self.planned.poses[0, :3, :3]
        from_mean = (features - mean) * np.swapaxes(weight[..., None, :], -1, -2)
        spread = np.swapaxes(ball - middle, -1, -2) @ from_mean
        R = nearest_rotation(spread + ALIGNMENT * planned)
        place = middle - np.matvec(R, mean[..., 0, :])[..., None, :]
        new = np.broadcast_to(cameras, (*R.shape[:-2], *cameras.shape[-3:])).copy()
        new[..., 0, :3, :3] = R
        new[..., 0, :3, 3] = place[..., 0, :]
        return new

    @cached_property
    def _gears(self) -> slice:
        return self.columns("gear_")

    @cached_property
    def _zeros(self) -> slice:
        return self.columns("zero_")

    @cached_property
    def _links(self) -> slice:
        return self.columns("link_")

    @cached_property
    def _lengths(self) -> tuple[Indices, Indices]:
        """Row and axis of each length among the translations."""
        places = [(row, axis) for _, row, axis in links_of(self.planned.arm)]
        table: Indices = np.array(places, dtype=np.int_).reshape(-1, 2)
        return table[:, 0], table[:, 1]

    def _motions(
        self, arm: SerialArm, frames: FloatArray, target: FloatArray, joints: FloatArray
    ) -> FloatArray:
        """Return the motions of the target, (..., k, p, ·, 3), by joints, gears, zeros and links, in this order."""
        by_joint = arm.motions(frames, target)
        by_zero = by_joint / arm.gear_ratio[..., None, :, None]
        planned = self.planned.arm
        by_gear = by_zero * (planned.gear_ratio * joints)[..., None, :, None]
        row, axis = self._lengths
        # The i-th translation is along the axes of the frame before it, those of the first along the base's.
        before = np.broadcast_to(np.eye(3), (*frames.shape[:-3], 1, 3, 3))
        axes = np.concatenate([before, frames[..., :3, :3]], axis=-3)
        along = np.swapaxes(axes, -1, -2)[..., row, axis, :]
        by_link = planned.translation[row, axis][:, None] * along
        by_link = np.broadcast_to(
            by_link[..., None, :, :], (*by_joint.shape[:-2], *by_link.shape[-2:])
        )
        return np.concatenate([by_joint, by_gear, by_zero, by_link], axis=-2)

    def _by_pose(
        self, model: RobotModel, points: FloatArray, turn: FloatArray | None
    ) -> FloatArray:
        """Return the motions of points (..., k, c, p, 3) in each camera with the poses of all, (..., c, p, 3, 6 c)."""
        count = points.shape[-3]
        turns = skew(points)
        if turn is not None:
            # δ turns the camera before its own turn: R exp([δ]×) R_z = R R_z exp([R_zᵀ δ]×).
            turns[..., 0, :, :, :] = turns[..., 0, :, :, :] @ about_z(-turn)[..., None, :, :]
        places = -np.swapaxes(model.poses[..., None, :3, :3], -1, -2)
        places = np.broadcast_to(places, turns.shape)
        own = np.concatenate([turns, places], axis=-1)
        every = np.zeros((*own.shape[:-1], count, len(POSE)))
        for camera in range(count):
            every[..., camera, :, :, camera, :] = own[..., camera, :, :, :]
        return every.reshape(*own.shape[:-1], count * len(POSE))


def about_z(angle: FloatArray) -> FloatArray:
    """Return the rotations about z, (..., 3, 3), by angles (...) [rad]."""
    c = np.cos(angle)
    s = np.sin(angle)
    zero = np.zeros_like(c)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def turned(cameras: FloatArray, turn: FloatArray | None) -> FloatArray:
    """Return poses (..., 1 or k, c, 4, 4) of which the first is turned about its optical axis by (..., k) [rad]."""
    side_by_side = cameras[..., None, :, :, :]
    if turn is None:
        return side_by_side
    new = np.broadcast_to(side_by_side, (*turn.shape, *cameras.shape[-3:])).copy()
    first = side_by_side[..., 0, :3, :3]
    new[..., 0, :3, :3] = first @ about_z(turn)
    return new


def skew(v: FloatArray) -> FloatArray:
    """Return [v]×, (..., 3, 3), of vectors (..., 3), so that [v]× w = v × w."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
