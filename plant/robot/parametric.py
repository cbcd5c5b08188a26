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

With the axes X, Y, Z of a joint's own frame as a camera sees them, and the target's place (x, y, z) in that frame, a
motion z × p is x Y − y X. So the target's place is carried along the chain from the target to the cameras, and the axes
are carried the other way. For a camera on the hand that chain is the inverse one.

Arrays have leading axes: an ensemble of robots, or runs side by side, is one model. In here each coordinate is an array
and the k joint positions are the last axis, so that every operation runs along many contiguous numbers; stacks of small
matrices cost several times as much.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import NamedTuple, final

import numpy as np

from servobench.plant.contract.checks import FloatArray, Shape
from servobench.plant.contract.features import (
    Derivatives,
    FeatureModel,
    ModelState,
    parameters_of_joints,
)
from servobench.plant.contract.lanes import nearest_rotation
from servobench.plant.robot.arm import rotation_from_rpy
from servobench.plant.robot.hand_eye import RobotModel, rotation_matrix
from servobench.plant.robot.twin import POSE, TOOL, links_of

TARGET = ("target_x", "target_y", "target_z")
"""[m] added to the target's place in the base frame, for cameras on the hand."""
ALIGNMENT = 0.002  # [m²] weight of the planned rotation in `placed`
AXES = np.eye(3)
Rotations = list[list[list[float]] | None]  # the rows of each; None for no rotation


class Vectors(NamedTuple):
    """Three arrays that rotations mix: the coordinates of points, or the axes of a frame."""

    x: FloatArray
    y: FloatArray
    z: FloatArray

    def rotated(self, rotation: Iterable[Iterable[FloatArray | float]] | None) -> "Vectors":
        """Return the sums whose factors are the rows of a matrix; the same for None."""
        if rotation is None:
            return self
        return Vectors(*(_sum_of(self, row) for row in rotation))

    def about_z(self, cosine: FloatArray, sine: FloatArray) -> "Vectors":
        """Return the same after a rotation of points about z, for axes the opposite one."""
        x = cosine * self.x - sine * self.y
        y = sine * self.x + cosine * self.y
        return Vectors(x, y, self.z)


class Chain(NamedTuple):
    """The way from the target to the frame that cameras are mounted on."""

    cosines: FloatArray  # by joint angle, (n, ..., k)
    sines: FloatArray
    joints: list[Vectors]  # the target in the frame of each joint, (p, ..., k) each
    mount: Vectors  # the target in the frame of the mount


@final
@dataclass(frozen=True, eq=False)
class ParametricModel(FeatureModel):
    """The features of a robot by its joints and parameters.

    A state is the pair of `theta`, (..., P), and `cameras`, (..., c, 4, 4). The parameters of a camera's pose are
    increments: `moved` puts them into `cameras` and leaves 0, so that no rotation vector comes near a turn.
    """

    planned: RobotModel  # the robot that θ = 0 stands for; without leading axes

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of the P parameters."""
        place = TARGET if self.planned.mount == "hand" else TOOL
        links = [name for name, _, _ in links_of(self.planned.arm)]
        poses = []
        for camera in range(len(self.planned.poses)):
            prefix = "camera" if camera == 0 else f"camera{camera + 1}"
            poses += [f"{prefix}_{each}" for each in POSE]
        joints = parameters_of_joints(self.planned.arm.joint_names)
        return (*place, *joints, *links, *poses)

    def start(self, lead: Shape) -> ModelState:
        """Return `theta` and `cameras` of the planned robot for leading axes."""
        cameras = self.planned.poses
        theta = np.zeros((*lead, len(self.names)))
        return theta, np.broadcast_to(cameras, (*lead, *cameras.shape))

    def moved(self, theta: FloatArray, cameras: FloatArray, step: FloatArray) -> ModelState:
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
        target = self._chain(theta, joints).mount
        points = _in_cameras(target, cameras, _axes_of(cameras, turn))
        return self.planned.measure(_reversed_last(points, 3))

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
        arm = self.planned.arm
        n = arm.n
        chain = self._chain(theta, joints)
        axes = _axes_of(cameras, turn)
        points = _in_cameras(chain.mount, cameras, axes)
        motions = np.zeros((n + len(self.names), *points.shape))
        by_parameter = motions[n:]
        for camera, own in enumerate(axes):
            seen = by_parameter[:, :, :, camera]
            mount = Vectors(*np.swapaxes(own, 0, 1)[:, :, None])
            self._write_motions(seen, chain, mount)
            first = self.pose_columns.start + len(POSE) * camera
            pose = seen[first : first + len(POSE)]
            _write_pose(pose, points[:, :, camera], mount, turn)
            turn = None  # only the first camera turns
        by_zero = by_parameter[self._zeros]
        gear = arm.gear_ratio * (1.0 + theta[..., self._gears])
        by_angle = _last_first(gear)[:, None, None, None, ..., None]
        by_gear = _last_first(arm.gear_ratio * joints)[:, None, None, None]
        np.multiply(by_angle, by_zero, out=motions[:n])
        np.multiply(by_gear, by_zero, out=by_parameter[self._gears])
        places = _reversed_last(points, 3)
        rates = self.planned.change(places, _reversed_last(motions, 4))
        y = self.planned.measure(places)
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
        target = self._chain(theta, joints).mount
        ball = np.stack([coordinate[0] for coordinate in target], axis=-1)
        total = np.add.reduce(weight, axis=-1)
        share = (weight / total[..., None])[..., None, :]
        middle = share @ ball
        mean = share @ features
        planned = self.planned.poses[0, :3, :3]
        from_mean = (features - mean) * weight[..., None, :].mT
        spread = (ball - middle).mT @ from_mean
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
    def _lengths(self) -> list[list[tuple[int, float, int | None]]]:
        """The axes of each translation with their lengths [m] and the places of these in θ, None for none."""
        place = self.columns("link_").start
        links = links_of(self.planned.arm)
        places = {(row, axis): place + index for index, (_, row, axis) in enumerate(links)}
        lengths = []
        for row, translation in enumerate(self.planned.arm.translation.tolist()):
            own = enumerate(translation)
            lengths.append([(axis, each, places.get((row, axis))) for axis, each in own if each])
        return lengths

    @cached_property
    def _rotations(self) -> Rotations:
        """The fixed rotation before each joint and the flange."""
        # A quarter turn has entries of 6e-17, which would cost as much as others.
        rotations: Rotations = []
        for rotation in np.round(rotation_from_rpy(self.planned.arm.rpy), 15):
            rows = None
            if not np.array_equal(rotation, AXES):
                rows = rotation.tolist()
            rotations.append(rows)
        return rotations

    @cached_property
    def _opposite(self) -> Rotations:
        """The opposite rotations."""
        return [each and np.transpose(each).tolist() for each in self._rotations]

    def _chain(self, theta: FloatArray, joints: FloatArray) -> Chain:
        """Return the way from the target to the frame that cameras are mounted on."""
        arm = self.planned.arm
        gear = arm.gear_ratio * (1.0 + theta[..., self._gears])
        offset = arm.joint_offset + theta[..., self._zeros]
        angles = gear[..., None, :] * joints + offset[..., None, :]
        angles = np.ascontiguousarray(_last_first(angles))
        cosines = np.cos(angles)
        sines = np.sin(angles)
        marks = self.planned.marks.T.reshape(3, -1, *(1,) * (angles.ndim - 1))
        target = Vectors(*(own + theta[..., axis, None] for axis, own in enumerate(marks)))
        places = []
        if self.planned.mount == "fixed":
            for row in reversed(range(arm.n + 1)):
                if row < arm.n:
                    target = target.about_z(cosines[row], sines[row])
                    places.append(target)
                target = target.rotated(self._rotations[row])
                target = self._translated(target, theta, row, 1.0)
            return Chain(cosines, sines, places[::-1], target)
        # From the base to the flange, all is done the opposite way.
        for row in range(arm.n + 1):
            target = self._translated(target, theta, row, -1.0)
            target = target.rotated(self._opposite[row])
            if row < arm.n:
                target = target.about_z(cosines[row], -sines[row])
                places.append(target)
        return Chain(cosines, sines, places, target)

    def _translated(self, target: Vectors, theta: FloatArray, row: int, sign: float) -> Vectors:
        """Return the target translated by a link, ±1 times."""
        coordinates = list(target)
        for axis, length, place in self._lengths[row]:
            shift: FloatArray | float = sign * length
            if place is not None:
                shift = shift * (1.0 + theta[..., place, None])
            coordinates[axis] = coordinates[axis] + shift
        return Vectors(*coordinates)

    def _write_motions(self, motions: FloatArray, chain: Chain, axes: Vectors) -> None:
        """Write the motions of points by all parameters but gears and poses, (P, 3, p, ..., k), as a camera sees them.

        Args:
            motions: into which they are written.
            chain: from the target to the mount.
            axes: those of the mount, as the camera sees them.
        """
        n = self.planned.arm.n
        by_zero = motions[self._zeros]
        if self.planned.mount == "fixed":
            for row in range(n + 1):
                self._write_lengths(motions, axes, row, 1.0)
                axes = axes.rotated(self._opposite[row])
                if row < n:
                    x, y, _ = chain.joints[row]
                    np.subtract(x * axes.y, y * axes.x, out=by_zero[row])
                    axes = axes.about_z(chain.cosines[row], -chain.sines[row])
        else:
            for row in reversed(range(n + 1)):
                if row < n:
                    x, y, _ = chain.joints[row]
                    np.subtract(y * axes.x, x * axes.y, out=by_zero[row])
                    axes = axes.about_z(chain.cosines[row], chain.sines[row])
                axes = axes.rotated(self._rotations[row])
                self._write_lengths(motions, axes, row, -1.0)
        for motion, axis in zip(motions[:3], axes, strict=True):
            motion[...] = axis

    def _write_lengths(self, motions: FloatArray, axes: Vectors, row: int, sign: float) -> None:
        """Write the motions by the lengths of a link, of which a translation is ±1 times."""
        for axis, length, place in self._lengths[row]:
            if place is not None:
                np.multiply(sign * length, axes[axis], out=motions[place])


def _axes_of(cameras: FloatArray, turn: FloatArray | None) -> list[FloatArray]:
    """Return the axes of each camera in the frame of the mount, (3, 3, ..., k or 1).

    Args:
        cameras: (..., c, 4, 4), in the same frame.
        turn: by which the first camera is turned about its optical axis, (..., k) [rad]; None for 0.
    """
    rotations = cameras[..., :3, :3]
    axes = list(rotations.transpose(-3, -1, -2, *range(cameras.ndim - 3))[..., None])
    if turn is not None:
        turned = Vectors(*axes[0]).about_z(np.cos(turn), -np.sin(turn))
        axes[0] = np.stack(np.broadcast_arrays(*turned))
    return axes


def _in_cameras(target: Vectors, cameras: FloatArray, axes: list[FloatArray]) -> FloatArray:
    """Return the target in each camera, (3, p, c, ..., k), by its place in the frame of the mount."""
    seen = []
    for camera, own in enumerate(axes):
        place = cameras[..., camera, :3, 3, None]
        away = [each - place[..., axis, :] for axis, each in enumerate(target)]
        seen.append(np.stack(Vectors(*away).rotated(own)))
    return np.stack(seen, axis=2)


def _write_pose(
    motions: FloatArray, points: FloatArray, axes: Vectors, turn: FloatArray | None
) -> None:
    """Write the motions of points by the pose of a camera, (6, 3, p, ..., k).

    Args:
        motions: into which they are written.
        points: as the camera sees them, (3, p, ..., k).
        axes: those of the mount, as the camera sees them.
        turn: by which it is turned, (..., k) [rad]; None for 0.
    """
    x, y, z = points
    none = np.zeros_like(x)
    turns = Vectors(np.stack([none, z, -y]), np.stack([-z, none, x]), np.stack([y, -x, none]))
    if turn is not None:
        # δ turns the camera before its own turn: its axes are those of the camera turned back.
        turns = turns.about_z(np.cos(turn), np.sin(turn))
    motions[:3] = turns
    for motion, axis in zip(motions[3:], axes, strict=True):
        np.negative(axis, out=motion)


def _last_first(array: FloatArray) -> FloatArray:
    """Return a view, (k, ...), of an array (..., k)."""
    # `np.moveaxis` takes ten times as long, here and below.
    return array.transpose(-1, *range(array.ndim - 1))


def _reversed_last(array: FloatArray, count: int) -> FloatArray:
    """Return an array whose first axes are its last ones, in reverse order: (..., k, c, p, 3) for (3, p, c, ..., k)."""
    return array.transpose(*range(count, array.ndim), *reversed(range(count)))


def _sum_of(vectors: Iterable[FloatArray], factors: Iterable[FloatArray | float]) -> FloatArray:
    """Return Σ f v."""
    terms = []
    for vector, factor in zip(vectors, factors, strict=True):
        # Most rotations of an arm are about one axis: many factors are 0 or 1.
        if not isinstance(factor, float):
            terms.append(factor * vector)
        elif factor == 1.0:
            terms.append(vector)
        elif factor != 0.0:
            terms.append(factor * vector)
    return reduce(np.add, terms)
