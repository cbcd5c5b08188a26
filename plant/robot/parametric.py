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

All motions are computed in the frames of the cameras: the chain of joints begins at the base as a camera sees it. For a
camera on the hand that follows from the pose of the flange.

Arrays have leading axes: an ensemble of robots, or runs side by side, is one model. In here the coordinates x, y and z
are the first axis of each array and the k joint positions are the last one, so that every operation runs along many
contiguous numbers; stacks of small matrices cost several times as much.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, final

import numpy as np

from servobench.plant.contract.checks import FloatArray, IntArray
from servobench.plant.contract.features import Derivatives
from servobench.plant.contract.lanes import nearest_rotation
from servobench.plant.robot.arm import rotation_from_rpy
from servobench.plant.robot.hand_eye import RobotModel, rotation_matrix
from servobench.plant.robot.twin import TOOL, links_of

TARGET = ("target_x", "target_y", "target_z")
"""[m] added to the target's place in the base frame, for cameras on the hand."""
ALIGNMENT = 0.002  # [m²] weight of the planned rotation in `placed`
POSE = ("turn_x", "turn_y", "turn_z", "x", "y", "z")


class Frame(NamedTuple):
    """The axes and the origin of a frame, with their coordinates as the first axis, (3, *)."""

    x: FloatArray
    y: FloatArray
    z: FloatArray
    origin: FloatArray  # [m]

    def moved(self, translation: Iterable[FloatArray | float]) -> "Frame":
        """Return the frame moved along its own axes [m]."""
        return self._replace(origin=self.origin + _sum_of(self[:3], translation))

    def rotated(self, rotation: FloatArray) -> "Frame":
        """Return the frame rotated by a matrix, (3, 3), of its own axes."""
        x, y, z = (_sum_of(self[:3], column) for column in rotation.T)
        return Frame(x, y, z, self.origin)

    def about_z(self, cosine: FloatArray, sine: FloatArray) -> "Frame":
        """Return the frame rotated about its z axis."""
        x, y = _turned(self.x, self.y, cosine, sine)
        return Frame(x, y, self.z, self.origin)


class Seen(NamedTuple):
    """A robot as its cameras see it."""

    mount: Frame  # the frame that they are mounted on
    frames: list[Frame]  # the base, the frames after each joint, and the flange
    points: FloatArray  # the target's, (3, p, c, ..., k)


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

    def feature(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        turn: FloatArray | None = None,
    ) -> FloatArray:
        """Return y, (..., k, m), for joint positions (..., k, n) [rad]; `turn` as in `derivatives`."""
        seen = self._seen(theta, cameras, joints, turn)
        return self.planned.measure(_reversed_last(seen.points, 3))

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
        seen = self._seen(theta, cameras, joints, turn)
        motions = self._motions(theta, joints, turn, seen)
        places = _reversed_last(seen.points, 3)
        y = self.planned.measure(places)
        rates = self.planned.change(places, _reversed_last(motions, 4))
        n = self.planned.arm.n
        return Derivatives(y, by_joint=rates[..., :n], by_parameter=rates[..., n:])

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
        frames = self._frames(theta, joints, _identity(joints.ndim))
        ball = _reversed_last(self._points(theta, frames), 3)[..., 0, 0, :]
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
    def _lengths(self) -> tuple[IntArray, IntArray]:
        """Row and axis of each length among the translations."""
        places = [(row, axis) for _, row, axis in links_of(self.planned.arm)]
        table: IntArray = np.array(places, dtype=np.int_).reshape(-1, 2)
        return table[:, 0], table[:, 1]

    @cached_property
    def _rotations(self) -> FloatArray:
        """The fixed rotations before each joint and the flange, (n+1, 3, 3)."""
        return rotation_from_rpy(self.planned.arm.rpy)

    def _seen(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        turn: FloatArray | None,
    ) -> Seen:
        """Return the robot as each camera sees it."""
        mount = _mount_in(cameras, turn)
        base = mount
        if self.planned.mount == "hand":
            flange = self._frames(theta, joints, _identity(joints.ndim))[-1]
            # The camera sees the axes of the flange, in which those of the base are known.
            coordinates = zip(flange.x, flange.y, flange.z, strict=True)
            x, y, z = (_sum_of(mount[:3], each) for each in coordinates)
            base = Frame(x, y, z, mount.origin - _sum_of((x, y, z), flange.origin))
        frames = self._frames(theta, joints, base)
        return Seen(mount, frames, self._points(theta, frames))

    def _frames(self, theta: FloatArray, joints: FloatArray, base: Frame) -> list[Frame]:
        """Return the base, the frames after each joint and the flange."""
        arm = self.planned.arm
        gear = arm.gear_ratio * (1.0 + theta[..., self._gears])
        offset = arm.joint_offset + theta[..., self._zeros]
        angles = gear[..., None, :] * joints + offset[..., None, :]
        angles = np.ascontiguousarray(np.moveaxis(angles, -1, 0))
        cosines = np.cos(angles)
        sines = np.sin(angles)
        frames = [base]
        for row in range(arm.n + 1):
            frame = frames[-1].moved(self._translation(theta, row)).rotated(self._rotations[row])
            if row < arm.n:
                frame = frame.about_z(cosines[row], sines[row])
            frames.append(frame)
        return frames

    def _translation(self, theta: FloatArray, row: int) -> list[FloatArray | float]:
        """Return the translation before a joint, in which lengths deviate."""
        translation: list[FloatArray | float] = list(self.planned.arm.translation[row])
        rows, axes = self._lengths
        for index in np.flatnonzero(rows == row):
            stretch = 1.0 + theta[..., self._links][..., index, None]
            translation[axes[index]] = translation[axes[index]] * stretch
        return translation

    def _target(self, frames: list[Frame]) -> Frame:
        """Return the frame that the target is fixed to."""
        if self.planned.mount == "fixed":
            return frames[-1]
        return frames[0]

    def _points(self, theta: FloatArray, frames: list[Frame]) -> FloatArray:
        """Return the points of the target, (3, p, c, ..., k)."""
        frame = self._target(frames)
        shift = np.moveaxis(theta[..., :3], -1, 0)[..., None]
        points = []
        for mark in self.planned.marks:
            place = [own + more for own, more in zip(mark, shift, strict=True)]
            points.append(frame.moved(place).origin)
        return np.stack(points, axis=1)

    def _motions(
        self, theta: FloatArray, joints: FloatArray, turn: FloatArray | None, seen: Seen
    ) -> FloatArray:
        """Return the motions of points by joints and parameters, (n + P, 3, p, c, ..., k)."""
        arm = self.planned.arm
        n = arm.n
        points = seen.points
        frames = seen.frames
        motions = np.zeros((n + len(self.names), *points.shape))
        by_joint = motions[:n]
        by_parameter = motions[n:]
        sign = 1.0
        if self.planned.mount == "hand":
            # Seen from the hand, the target moves the opposite way.
            sign = -1.0
        gear = arm.gear_ratio * (1.0 + theta[..., self._gears])
        by_gear = by_parameter[self._gears]
        by_zero = by_parameter[self._zeros]
        for joint, frame in enumerate(frames[1:-1]):
            lever = points - frame.origin[:, None]
            motion = _cross(sign * frame.z[:, None], lever)
            by_zero[joint] = motion
            by_joint[joint] = gear[..., joint, None] * motion
            by_gear[joint] = arm.gear_ratio[joint] * joints[..., joint] * motion
        for motion, row, axis in zip(by_parameter[self._links], *self._lengths, strict=True):
            # The i-th translation is along the axes of the frame before it.
            motion[...] = sign * arm.translation[row, axis] * frames[row][axis][:, None]
        target = self._target(frames)
        for motion, direction in zip(by_parameter[:3], target[:3], strict=True):
            motion[...] = direction[:, None]
        self._write_poses(by_parameter[self.pose_columns], turn, seen)
        return motions

    def _write_poses(self, motions: FloatArray, turn: FloatArray | None, seen: Seen) -> None:
        """Write the motions of points with the poses of the cameras, (6 c, 3, p, c, ..., k)."""
        for camera in range(seen.points.shape[2]):
            points = seen.points[:, :, camera]
            x, y, z = (_cross(points, axis) for axis in _identity(points.ndim - 1)[:3])
            if turn is not None and camera == 0:
                # δ turns the camera before its own turn: its axes are those of the camera turned back.
                x, y = _turned(x, y, np.cos(turn), -np.sin(turn))
            first = len(POSE) * camera
            own = motions[first : first + len(POSE), :, :, camera]
            own[:3] = (x, y, z)
            for motion, axis in zip(own[3:], seen.mount[:3], strict=True):
                motion[...] = -axis[:, None, camera]


def _mount_in(cameras: FloatArray, turn: FloatArray | None) -> Frame:
    """Return the frame that cameras are mounted on as each of them sees it, (3, c, ..., k or 1).

    Args:
        cameras: (..., c, 4, 4), in the frame of the mount.
        turn: by which the first camera is turned about its optical axis, (..., k) [rad]; None for 0.
    """
    rows = np.moveaxis(cameras[..., :3, :], (-2, -1, -3), (0, 1, 2))[..., None]
    R = rows[:, :3]
    place = rows[:, 3]
    if turn is not None:
        angles = np.zeros((cameras.shape[-3], *turn.shape))
        angles[0] = turn
        first, second = _turned(R[:, 0], R[:, 1], np.cos(angles), np.sin(angles))
        R = np.stack([first, second, np.broadcast_to(R[:, 2], first.shape)], axis=1)
    x, y, z = R
    return Frame(x, y, z, -_sum_of((x, y, z), place))


def _turned(
    x: FloatArray, y: FloatArray, cosine: FloatArray, sine: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return two axes after a rotation about the third one."""
    first = cosine * x + sine * y
    second = cosine * y - sine * x
    return first, second


def _identity(axes: int) -> Frame:
    """Return a frame that is seen from itself, with so many axes of length 1 after the coordinates."""
    x, y, z = np.eye(3).reshape(3, 3, *(1,) * axes)
    return Frame(x, y, z, np.zeros_like(x))


def _reversed_last(array: FloatArray, count: int) -> FloatArray:
    """Return an array whose first axes are its last ones, in reverse order: (..., k, c, p, 3) for (3, p, c, ..., k)."""
    source = range(count)
    return np.moveaxis(array, source, [-1 - axis for axis in source])


def _sum_of(
    vectors: tuple[FloatArray, FloatArray, FloatArray], factors: Iterable[FloatArray | float]
) -> FloatArray:
    """Return Σ f v of vectors (3, *)."""
    total: FloatArray = np.zeros(())
    for vector, factor in zip(vectors, factors, strict=True):
        # Most rotations of an arm are about one axis: many factors are 0 or 1.
        if isinstance(factor, float) and factor == 0.0:
            continue
        term = vector
        if not (isinstance(factor, float) and factor == 1.0):
            term = factor * vector
        total = total + term
    return total


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a × b of vectors (3, *)."""
    a1, a2, a3 = a
    b1, b2, b3 = b
    x = a2 * b3 - a3 * b2
    y = a3 * b1 - a1 * b3
    z = a1 * b2 - a2 * b1
    return np.stack([x, y, z])
