"""Forward kinematics and position Jacobian of a serial arm with revolute joints.

The arm is a chain of fixed transforms and rotations about z: frame i+1 is reached from frame i by a translation, a
rotation in roll, pitch, yaw (fixed axes, as in URDF) and then the rotation of joint i+1 about its z axis. Both sources
map onto it without loss: standard DH, T_i = Rz(θ_i) Tz(d_i) Tx(a_i) Rx(α_i), whose constant part after joint i is the
translation (a_i, 0, d_i) and the roll α_i, and the calibration file that every Universal Robots arm carries.

    θ = g ⊙ q + o          q reported joint position, g gear ratio (1 = as reported), o joint offset
    p = p_flange + R_flange t          t ball centre in the flange frame
    ∂p/∂q_i = g_i z_i × (p − p_i)

The arms of many runs side by side are one arm, whose arrays have leading axes.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, Shape, as_array
from servobench.plant.contract.lanes import matrix
from servobench.plant.contract.settings import Names

# IntArray of the factors in a cross product
YZX = np.array([1, 2, 0])
ZXY = np.array([2, 0, 1])


def freeze_arrays(owner: object, shape: Shape, *names: str) -> None:
    """Check that fields of a frozen dataclass are arrays of a shape, and make them read-only.

    Raises:
        ValueError: a field with another shape, or with a number that is not finite.
    """
    for name in names:
        array = as_array(name, getattr(owner, name), shape)
        object.__setattr__(owner, name, array)


def rotation_from_rpy(rpy: npt.ArrayLike) -> FloatArray:
    """Return Rz(yaw) Ry(pitch) Rx(roll), shape (..., 3, 3), for `rpy` of shape (..., 3) in rad."""
    angles = np.asarray(rpy, dtype=np.float64)
    # The suffixes are those of roll, pitch and yaw.
    cr, cp, cy = np.moveaxis(np.cos(angles), -1, 0)
    sr, sp, sy = np.moveaxis(np.sin(angles), -1, 0)
    x_row = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr]
    y_row = [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr]
    z_row = [-sp, cp * sr, cp * cr]
    return matrix(x_row, y_row, z_row)


def rpy_from_rotation(R: FloatArray) -> FloatArray:
    """Return roll, pitch, yaw, (..., 3) rad, of rotation matrices (..., 3, 3); also valid at a pitch of ±90°.

    The yaw is removed before pitch and roll are computed, so that no angle depends on two vanishing numbers.
    """
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    c = np.cos(yaw)
    s = np.sin(yaw)
    # Sine and cosine of pitch and roll are entries of Rz(−yaw) R = Ry(pitch) Rx(roll).
    sin_pitch = -R[..., 2, 0]
    cos_pitch = c * R[..., 0, 0] + s * R[..., 1, 0]
    sin_roll = s * R[..., 0, 2] - c * R[..., 1, 2]
    cos_roll = c * R[..., 1, 1] - s * R[..., 0, 1]
    pitch = np.arctan2(sin_pitch, cos_pitch)
    roll = np.arctan2(sin_roll, cos_roll)
    return np.stack([roll, pitch, yaw], axis=-1)


def from_frame(pose: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (..., 3) of a frame in the frame in which its pose, (..., 4, 4), is given."""
    return np.matvec(pose[..., :3, :3], points) + pose[..., :3, 3]


def into_frame(pose: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (..., 3) in the frame with a pose, (..., 4, 4), that is given as they are; undoes `from_frame`."""
    return np.vecmat(points - pose[..., :3, 3], pose[..., :3, :3])


@dataclass(frozen=True, eq=False)
class SerialArm:
    """A serial arm with n revolute joints and a ball on its flange.

    All arrays have the same leading axes.
    """

    joint_names: Names  # n names
    translation: FloatArray  # (..., n+1, 3), m; row i leads from frame i to joint i+1, the last row to the flange.
    rpy: FloatArray  # (..., n+1, 3), rad; the rotations that belong to them.
    joint_offset: FloatArray  # (..., n), rad.
    gear_ratio: FloatArray  # (..., n), true joint motion over reported joint motion.
    tool: FloatArray  # (..., 3), m, ball centre in the flange frame.

    def __post_init__(self) -> None:
        """Check shapes and freeze the arrays."""
        lead = np.shape(self.translation)[:-2]
        freeze_arrays(self, (*lead, self.n + 1, 3), "translation", "rpy")
        freeze_arrays(self, (*lead, self.n), "joint_offset", "gear_ratio")
        freeze_arrays(self, (*lead, 3), "tool")

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @cached_property
    def _fixed(self) -> FloatArray:
        """Fixed transforms as homogeneous matrices, (n+1, ..., 4, 4)."""
        translation = np.moveaxis(self.translation, -2, 0)
        fixed = np.zeros((*translation.shape[:-1], 4, 4))
        fixed[..., :3, :3] = np.moveaxis(rotation_from_rpy(self.rpy), -3, 0)
        fixed[..., :3, 3] = translation
        fixed[..., 3, 3] = 1.0
        return fixed

    def joint_angle(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the true joint angles θ = g ⊙ q + o, (..., n) rad, for reported positions (..., n) rad."""
        q = np.asarray(joint_position, dtype=np.float64)
        if q.shape[-1:] != (self.n,):
            raise ValueError(f"joint_position must have shape (..., {self.n}), got {q.shape}")
        return self.gear_ratio * q + self.joint_offset

    def frames(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the poses of all joint frames and of the flange in the base frame.

        Args:
            joint_position: (..., n), rad, as reported.

        Returns:
            (..., n+1, 4, 4), m: entry i is the frame after joint i+1, the last one is the flange.
        """
        theta = self.joint_angle(joint_position)
        lead = theta.shape[:-1]
        fixed = self._fixed
        missing_axes = 3 + len(lead) - fixed.ndim
        if missing_axes > 0:
            fixed = fixed.reshape(self.n + 1, *(1,) * missing_axes, *fixed.shape[1:])
        # The chain is the first axis here: the joints are multiplied one after the other, all leading axes at once.
        angle = theta[..., None]
        if lead:
            angle = np.moveaxis(theta, -1, 0)[..., None]
        c = np.cos(angle)
        s = np.sin(angle)
        x = fixed[:-1, ..., 0]
        y = fixed[:-1, ..., 1]
        # A turn about z makes x c + y s and y c - x s of columns 0 and 1, and leaves the others as they are.
        turned = np.empty((self.n, *lead, 4, 4))
        turned[..., 0] = x * c + y * s
        turned[..., 1] = y * c - x * s
        turned[..., 2:] = fixed[:-1, ..., 2:]
        steps = (*turned[1:], fixed[-1])
        poses = np.empty((self.n + 1, *lead, 4, 4))
        poses[0] = turned[0]
        for before, step, pose in zip(poses, steps, poses[1:], strict=False):
            np.matmul(before, step, out=pose)
        if lead:
            return np.moveaxis(poses, 0, -3)
        return poses

    def ball_position(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the ball centre in the base frame, (..., 3) m, for joint positions (..., n) in rad."""
        return self.ball(self.frames(joint_position))

    def ball_and_jacobian(self, joint_position: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the ball centre, (..., 3) m, and its derivative by the reported (..., n) rad, (..., 3, n) m/rad."""
        frames = self.frames(joint_position)
        ball = self.ball(frames)
        motions = self.motions(frames, ball[..., None, :])[..., 0, :, :]
        return ball, motions.mT

    def motions(self, frames: FloatArray, points: FloatArray) -> FloatArray:
        """Return g_i z_i × (p − p_i), (..., p, n, 3) m/rad, for points (..., p, 3) m of the base frame and `frames`."""
        axis = frames[..., None, : self.n, :3, 2]
        lever = points[..., None, :] - frames[..., None, : self.n, :3, 3]
        # numpy.cross would cost as much as the forward kinematics.
        motions = axis.take(YZX, axis=-1) * lever.take(ZXY, axis=-1)
        motions -= axis.take(ZXY, axis=-1) * lever.take(YZX, axis=-1)
        motions *= self.gear_ratio[..., None, :, None]
        return motions

    def ball(self, frames: FloatArray) -> FloatArray:
        """Return the ball centre in the base frame, (..., 3) m, for `frames`."""
        return from_frame(frames[..., -1, :, :], self.tool)


def plain_arm(
    joint_names: Names,
    translation: FloatArray,
    rpy: FloatArray,
    tool: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> SerialArm:
    """Return an arm with gear ratios of 1 and no joint offsets; the arguments are the fields of `SerialArm`."""
    n = len(joint_names)
    return SerialArm(joint_names, translation, rpy, np.zeros(n), np.ones(n), np.asarray(tool))


def numbered_joints(n: int) -> Names:
    """Return names for the joints of an arm that has none."""
    return tuple(f"joint_{i}" for i in range(1, n + 1))


def arm_from_dh(
    a: npt.ArrayLike,
    d: npt.ArrayLike,
    alpha: npt.ArrayLike,
    joint_names: Names,
    *,
    modified: bool = False,
) -> SerialArm:
    """Return the arm of a DH table, without a ball.

    T_i = Rz(θ_i) Tz(d_i) Tx(a_i) Rx(α_i) by the standard convention, Rx(α_i) Tx(a_i) Rz(θ_i) Tz(d_i) by the modified.

    Args:
        a: (n,), m, link lengths; by the modified convention also (n+1,), of which the last one leads to the flange.
        d: the same, m, link offsets.
        alpha: the same, rad, link twists.
        joint_names: n names.
        modified: whether the table is by the modified convention.

    Returns:
        The arm with gear ratios of 1, no joint offsets and its ball in the flange's origin.

    Raises:
        ValueError: a column of the wrong length.
    """
    n = len(joint_names)
    size = n
    if modified and np.shape(a) == (n + 1,):
        size = n + 1
    # Zero rows before and after those of the table: the base, or the flange
    missing = (0, n + 1 - size) if modified else (1, 0)
    x = np.pad(as_array("a", a, (size,)), missing)
    offset = np.pad(as_array("d", d, (size,)), missing)
    roll = np.pad(as_array("alpha", alpha, (size,)), missing)
    if modified:
        # The offset is along the next joint's axis, which the twist has turned.
        y = -offset * np.sin(roll)
        z = offset * np.cos(roll)
    else:
        y = np.zeros(n + 1)
        z = offset
    rpy = np.zeros((n + 1, 3))
    rpy[:, 0] = roll
    return plain_arm(joint_names, np.stack([x, y, z], axis=-1), rpy)


@dataclass(frozen=True, eq=False)
class JointLimits:
    """The limits of n joints."""

    lower: FloatArray  # (n,) [rad]
    upper: FloatArray  # (n,) [rad]
    speed: FloatArray  # (n,) [rad/s], the same both ways

    def __post_init__(self) -> None:
        """Check order and signs and freeze the arrays."""
        freeze_arrays(self, (len(self.lower),), "lower", "upper", "speed")
        if not (self.lower < self.upper).all():
            raise ValueError(
                f"joint_lower must be below joint_upper for every joint, got {self.lower.tolist()} and "
                f"{self.upper.tolist()}"
            )
        if not (self.speed > 0.0).all():
            raise ValueError(f"joint_velocity_limit must be positive, got {self.speed.tolist()}")


@dataclass(frozen=True, eq=False)
class Links:
    """The moving links as rigid bodies and as shapes; row i is the link after joint i+1.

    Masses lie in the frame at the link's far end, before the rotation of the next joint: DH frame i+1.
    """

    mass: FloatArray  # (n,) [kg]
    centre: FloatArray  # (n, 3) [m], centre of mass
    inertia: FloatArray  # about it [kg m²]: (n, 2), across the link and along it; or (n, 3, 3)
    torque: FloatArray  # (n,) [Nm], largest of the joint
    radius: FloatArray  # (n,) [m], radius of the link's tube
    aside: FloatArray  # (n,) [m], offset of the tube from its joints, along the joint's axis
    payload: float  # rated load [kg]

    def __post_init__(self) -> None:
        """Check the shapes and freeze the arrays."""
        n = len(self.mass)
        freeze_arrays(self, (n,), "mass", "torque", "radius", "aside")
        freeze_arrays(self, (n, 3), "centre")
        freeze_arrays(self, (n, 3, 3) if np.ndim(self.inertia) == 3 else (n, 2), "inertia")


def narrow_limits(limits: JointLimits | None, n: int, speed: float, reach: float) -> JointLimits:
    """Return limits of `n` joints within a speed [rad/s], a distance from zero [rad] and, where given, others.

    Raises:
        ValueError: a speed or a distance that is not positive, or one that leaves a joint no range.
    """
    if limits is None:
        return JointLimits(np.full(n, -reach), np.full(n, reach), np.full(n, speed))
    return JointLimits(
        limits.lower.clip(-reach),
        limits.upper.clip(max=reach),
        limits.speed.clip(max=speed),
    )
