"""A robot identified from a log of its joints and features, with the uncertainty of each parameter.

The parameters θ of a twin (`servobench.plant.robot.twin`) deviate the nominal robot; the feature of the frame that
arrives at t_k, exposed a latency L before, and the joint motion under commands u that act after a delay d are

    y_k = h(q(t_k − L); θ) + ν_k,   ν ~ N(0, Σ)          τ v̇ = u(t − d) − v,   q(t_{k+1}) − q(t_k) = ∫ v dt

with q a cubic spline through the logged positions. θ minimises Σ ρ(‖Σ^{-1/2} ν_k‖²) + Σ (θ_i/s_i)², with a soft L1 loss
ρ while Σ and the outliers are found, and none at last for the frames that are left. s_i are wide priors (`PRIORS`), so
that directions of θ that no frame tells (the zero of the first joint turns the arm as a turn of the camera does) stay
at the nominal robot. The posterior is N(θ, c (JᵀΣ⁻¹J/f + S⁻²)⁻¹), where f is the correlation time of the residuals.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline  # which loads the others, too
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from servobench.controllers.algebra import nearest_rotation
from servobench.plant.cameras.optics import COLUMNS, locate
from servobench.plant.cameras.setups import PIXEL, POSITION, SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import numbers_of
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import COMMAND, BoolArray, PlantSpec, column_names
from servobench.plant.robot.hand_eye import RobotModel, rotation_matrix
from servobench.plant.robot.mechanics import MechanicsConfig, transmitted
from servobench.plant.robot.twin import CAMERA, LENS, ball_rates, deviated, parameter_names

LOG: Final = "the log"  # in error messages
VELOCITY: Final = COMMAND.removesuffix("_command")  # as commands are misnamed
MAX_LATENCY: Final = 0.25  # [s]
LATENCY_STEP: Final = 0.0125  # [s] of the first search
MIN_FRAMES: Final = 50
MAX_FRAMES: Final = 6000
PRIORS: Final = {  # standard deviations by the begin of a parameter's name
    "latency": 0.1, "camera_turn": 1.0, "camera": 1.0, "tool": 0.05, "focal": 0.1, "centre": 20.0, "distortion": 0.2,
    "gear": 0.1, "zero": 0.2, "link": 0.1, "backlash": 0.02, "ripple": 0.05, "compliance": 0.01, "turning": 0.2,
    "swing": 0.1, "drift": 0.01,
}  # fmt: skip
EXTRAS: Final = ("backlash", "ripple", "drift", "swing_sin", "swing_cos", "compliance", "turning")
"""Parameters of gears, clocks, tool and mounting; pixels do not tell the last two."""
EXPOSURE: Final = ("latency", *EXTRAS[:5])  # which joints a frame shows
ARM: Final = ("gear", "zero", "link", "tool")
"""How the names of the arm's own parameters begin."""
MAX_OFF_TURN: Final = 1.0  # [rad] by which the jump of a wrapped joint is no turn
JUMP_SPEED: Final = 1.5  # [1] of the speed limit of a joint, and
JUMP_STEP: Final = 0.05  # [rad] in addition, beyond which a motion from row to row is a jump
CHANGE: Final = (
    2.5  # [1] of the least change of a feature, such as one pixel, beyond which a change is large
)
MAX_REPEATED: Final = 0.01  # [1] share of frames that equal another one although the arm moves
MIN_JOINT_STEP: Final = 1e-4  # [rad] between two frames of an arm that moves
UNLIKELY: Final = 3.0  # [1] prior deviations of one of these from the nominal robot
TURNINGS: Final = np.radians(np.arange(0.0, 31.0))  # [rad/s] of the first search
SWINGS: Final = np.geomspace(1.0, 20.0, 120)  # [s] periods of the search
SWINGS_IN_LOG: Final = 3  # at least
RIPPLE_ORDER: Final = MechanicsConfig().ripple_order
MIN_PLAY: Final = 0.002  # [rad] about which the effect of play is linear
TOLD: Final = 1.2  # [1] growth of a deviation with a prior of twice the width, below which the log tells a parameter
TOLD_SHARE: Final = 0.5  # [1] of its prior deviation, below which a direction is drawn from
OUTLIER: Final = 16.0  # [1] squared Mahalanobis distance of an outlier
FITS: Final = 4
ROWS_AT_ONCE: Final = 2**14  # of logs that are placed before a camera side by side
STEP: Final = 1e-6  # [1] of differences, in prior deviations
MAX_LAGS: Final = 100  # [frames] of the correlation time


class Log(NamedTuple):
    """Rows of a log."""

    spec: PlantSpec
    time: FloatArray  # (k,) [s]
    joints: FloatArray  # (k, n) [rad]
    features: FloatArray  # (k, m) [unit of the feature]
    valid: BoolArray  # (k,) of rows with a new frame
    commands: FloatArray | None  # (k, n) [rad/s], each from its row to the next

    def farthest_joint(self) -> tuple[float, str]:
        """Return how far a joint is beyond its range at most [rad], and where that is."""
        q, lower, upper = self.joints, self.spec.joint_lower, self.spec.joint_upper
        beyond = np.maximum(q - upper, lower - q)
        row, joint = np.unravel_index(int(beyond.argmax()), q.shape)
        place = (
            f"row {row} of the log has {self.spec.joint_names[joint]} at {q[row, joint]:.4g} rad"
        )
        limits = f"{lower[joint]:.4g} to {upper[joint]:.4g} rad"
        return float(beyond[row, joint]), f"{place}, beyond its range of {limits}"

    def joint_mistake(self) -> str:
        """Name joints in degrees, or one that jumps by a turn from row to row; empty for none."""
        excess, where = self.farthest_joint()
        if excess > np.pi:
            return f"{where}; if the log is in degrees, write it in rad"
        jump, is_turn = self.first_jump()
        return jump if is_turn else ""

    def first_jump(self) -> tuple[str, bool]:
        """Return where a joint moves far beyond its speed, by a turn if one does, with the remedy; and if by a turn."""
        jumps, limits = (
            np.abs(np.diff(self.joints, axis=0, prepend=self.joints[:1])),
            self.spec.joint_velocity_limit,
        )
        beyond = np.argwhere(jumps > JUMP_SPEED * limits * self.spec.period + JUMP_STEP).tolist()
        if not beyond:
            return "", False
        turns = np.abs(jumps - 2.0 * np.pi) <= MAX_OFF_TURN
        row, joint = max(beyond, key=lambda at: turns[*at])  # the first of them
        where = f"joint {self.spec.joint_names[joint]} jumps by {jumps[row, joint]:.4g} rad in row {row}"
        if turns[row, joint]:
            return f"{where}, as it is wrapped at ±π: unwrap it (numpy.unwrap)", True
        return (
            f"{where}, above {limits[joint]:.3g} rad/s: interpolate lost or held positions, or cut there",
            False,
        )

    def frame_mistake(self) -> str:
        """Name frames given as new that equal the one before, or are all the same, although the arm moves."""
        rows = frames_of(self)
        _, kinds, counts = np.unique(
            self.features[rows], axis=0, return_inverse=True, return_counts=True
        )
        steps = np.diff(self.features[rows], axis=0)
        moves = steps[changed := steps.any(axis=1)]
        large = (
            np.abs(moves) > CHANGE * np.abs(moves).min(axis=0, initial=np.inf, where=moves != 0.0)
        ).any(axis=1)
        # Large changes before or after equal frames
        jumps = np.append(False, large) | np.append(large, True)
        back = np.linalg.norm(moves[:-1] + moves[1:], axis=1) < 0.5 * np.linalg.norm(
            moves[1:], axis=1
        )
        # As 0 stands for no frame, but not in laps
        often = (counts > max(2, MAX_REPEATED * len(rows)))[kinds[1:]]
        since = np.cumsum(changed)  # changes so far, which equal frames share
        same = (~changed | (often & np.pad(back, 1)[since])) & jumps[since]
        moving = np.abs(np.diff(self.joints[rows], axis=0)).max(axis=1) > MIN_JOINT_STEP
        if not moving.any() or (share := float(np.mean(same[moving]))) <= MAX_REPEATED:
            return ""
        found = (
            f"{share:.0%} of the frames repeat another one although the arm moves, first in row "
        )
        return (
            f"{found}{rows[1:][same & moving][0]}: give rows without a new frame feature_valid = 0"
        )


def read_log(spec: PlantSpec, table: pd.DataFrame, least: int = MIN_FRAMES) -> Log:
    """Return the rows of a table with columns as `steps.parquet` has them, `spec.period` apart.

    Raises:
        ConfigurationError: a column or a number is missing, or fewer than `least` frames are valid.
    """
    names, rows = column_names(spec), np.arange(len(table))
    frames = table.filter(names["feature"])
    lost = frames.isna().all(axis=1)  # as a log may write a row without a new frame
    table = table.assign(**frames.where(~lost, frames.ffill().bfill(), axis=0))
    joints, features = (
        numbers_of(LOG, table, names[each]) for each in ("joint_position", "feature")
    )
    told = (
        numbers_of(LOG, table, ["feature_valid"])[:, 0]
        if "feature_valid" in table
        else np.ones(len(rows))
    )
    valid = (told != 0.0) & ~lost.to_numpy()
    lacking = [name for name in names[COMMAND] if name not in table]
    if lacking and any(str(name).startswith(VELOCITY) for name in table):
        remark(
            f"the log has columns {VELOCITY}_… but no {', '.join(lacking)}: commands are left out"
        )
    commands = None if lacking else numbers_of(LOG, table, names[COMMAND])
    log = Log(spec, np.asarray(spec.period * rows), joints, features, valid, commands)
    if (count := len(frames_of(log))) < least:
        after = f"after the first {MAX_LATENCY:g} s"
        raise ConfigurationError(
            f"the log has {count} valid frames {after}; wanted {least} or more"
        )
    return log


def frames_of(log: Log, most: int = sys.maxsize) -> Any:  # noqa: ANN401 - of indices
    """Return the rows of frames that were exposed within the log at any latency: `most` at most, equally spaced."""
    rows = np.flatnonzero(log.valid & (log.time >= log.time[0] + MAX_LATENCY))
    return rows[:: max(1, -(-len(rows) // most))]


@dataclass(frozen=True, eq=False)
class Identified:
    """A robot identified from a log."""

    names: tuple[str, ...]  # of the parameters
    values: FloatArray  # θ, (p,), for the camera the difference from its nominal pose
    covariance: FloatArray  # of the posterior, (p, p)
    told: BoolArray  # which parameters the log tells, (p,)
    factor: FloatArray  # (d, p), whose rows are the directions that the log tells; factorᵀ factor is their covariance
    untold: FloatArray  # (e, p), directions of θ that it does not tell, of length 1 in units of the priors
    pose: FloatArray  # of the camera at θ, (4, 4)
    noise: FloatArray  # Σ, (m, m)
    residuals: FloatArray  # of all valid frames, (k, m)
    rows: Any  # of these frames in the log, (k,)
    inliers: BoolArray  # which of them are no outliers, (k,)
    correlation: float  # f [frames]
    swing_period: float  # [s]

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations of the parameters, (p,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def estimate(self, name: str) -> tuple[float, float]:
        """Return a parameter and its standard deviation; 0 and infinite for one that the log does not have."""
        where = [k for k, own in enumerate(self.names) if own == name]
        return next(
            ((float(self.values[k]), float(self.deviations[k])) for k in where), (0.0, np.inf)
        )

    def sizes(self) -> dict[str, float]:
        """Return gears, zeros, links and tool by name, in deviations of their priors."""
        known = zip(self.names, self.values.tolist(), strict=True)
        return {name: value / prior(name) for name, value in known if name.startswith(ARM)}

    def unlikely(self) -> list[str]:
        """Return the names of those that are far from the nominal robot."""
        return [name for name, size in self.sizes().items() if abs(size) > UNLIKELY]

    def rates(self, log: Log) -> FloatArray:
        """Return how fast the features of these frames move, (k, m), 1/s."""
        return np.asarray(
            np.gradient(log.features[self.rows] - self.residuals, log.time[self.rows], axis=0)
        )

    def model(self, nominal: RobotModel) -> RobotModel:
        """Return the robot at θ, given the nominal one."""
        values = dict(zip(self.names, self.values.tolist(), strict=True))
        deviating = {name: value for name, value in values.items() if not name.startswith("camera")}
        return deviated(nominal.with_camera(self.pose), deviating)

    def errors(self, log: Log, nominal: RobotModel) -> FloatArray:
        """Return the residuals of all valid frames of a log after the longest latency, (k, m)."""
        rows, latency = frames_of(log), self.values[self.names.index("latency")]
        joints = CubicSpline(log.time, log.joints)(log.time[rows] - latency)
        features = np.asarray(self.model(nominal).feature(joints))
        return np.asarray(log.features[rows] - features)


def kind_of(name: str) -> str:
    """Return the begin of a parameter's name, by which it has its unit and its prior."""
    return "camera_turn" if name.startswith("camera_turn") else name.partition("_")[0]


def prior(name: str) -> float:
    """Return the standard deviation of a parameter before any log."""
    return PRIORS[kind_of(name)]


class _Problem:
    """Residuals of the valid frames of a log as a function of z = θ / s."""

    def __init__(self, log: Log, model: RobotModel, most: int, begin: Mapping[str, float]) -> None:
        self.rows = frames_of(log, most)
        self.time, self.y = log.time[self.rows], log.features[self.rows]
        self.motion, self.log, self.middle = (
            CubicSpline(log.time, log.joints),
            log,
            float(log.time.mean()),
        )
        pixels = isinstance(model, SetupModel) and model.setup.name == PIXEL.name
        lens: tuple[str, ...] = () if pixels else LENS
        self.names = tuple(
            each
            for each in parameter_names(model.arm)
            if each not in ("command_delay", "lag", *lens)
        )
        self.names += EXTRAS[:5] if pixels else EXTRAS
        self.scale = np.array([prior(name) for name in self.names])
        self.nominal = np.asarray(model.camera)
        self._of_camera = np.array([name.startswith("camera") for name in self.names])
        self.model, self.pace, model = model, 1.0, deviated(model, begin)
        # Z, pace and model of the last errors, and values computed for them
        self._last: tuple[Any, Any] = (None, None)
        latencies = np.arange(0.0, MAX_LATENCY + 1e-9, LATENCY_STEP)
        self.spread, latency, turning, pose = self._placed(
            model, latencies, np.zeros_like(latencies)
        )
        if not pixels:
            self.spread, _, turning, pose = self._placed(
                model, np.full(len(TURNINGS), latency), TURNINGS
            )
        found = {**begin, "latency": latency, "turning": turning}
        self.z = (
            np.array([found.get(name, 0.0) for name in self.names]) / self.scale * ~self._of_camera
        )
        self.model = self.model.with_camera(pose)

    def _placed(
        self, model: RobotModel, latencies: FloatArray, turnings: FloatArray
    ) -> tuple[float, float, float, FloatArray]:
        """Return of some latencies and speeds of turning those with the least median error: it, both and the pose."""
        exposed = self.time - latencies[:, None]
        y = turned(self.y, -turnings[:, None] * exposed) if turnings.any() else self.y
        poses, errors = fit_cameras(model, self.motion(exposed), y)
        best = int(errors.argmin())
        return float(errors[best]), float(latencies[best]), float(turnings[best]), poses[best]

    def values(self, z: FloatArray) -> dict[str, float]:
        """Return θ by name."""
        return dict(zip(self.names, (self.scale * z).tolist(), strict=True))

    def _exposed(self, values: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
        """Return when the frames were exposed, (..., k) s, and the joints behind their gears then, (..., k, n) rad."""
        steady = time = self.time - values["latency"] - values["drift"] * (self.time - self.middle)
        swings = np.any([values["swing_sin"], values["swing_cos"]])
        for _ in range(8 if swings else 0):  # the swing is that at the exposure
            phase = self.pace * time
            time = (
                steady - values["swing_sin"] * np.sin(phase) - values["swing_cos"] * np.cos(phase)
            )
        ripple, backlash = (np.expand_dims(values[name], -1) for name in ("ripple", "backlash"))
        return time, transmitted(self.motion(time), ripple, RIPPLE_ORDER) + backlash * self.play(
            time
        )

    def _seen(
        self, model: RobotModel, values: Mapping[str, float], time: FloatArray, ball: FloatArray
    ) -> FloatArray:
        """Return h, (..., k, m), by the camera of a model for the ball in the base frame, (..., k, 3) m."""
        own: Any = model
        y = (
            own.feature_at(ball[..., None, :])
            if isinstance(model, SetupModel)
            else own.to_camera(ball)
        )
        if "turning" in values:
            y = turned(y - values["compliance"] * self.pull(time), values["turning"] * time)
        return np.asarray(y)

    def errors(self, z: FloatArray) -> FloatArray:
        """Return y − h, (k, m)."""
        values = self.values(z)
        (time, q), model = self._exposed(values), deviated(self.model, values)
        frames = model.arm.frames(q)
        self._last = (z.tobytes(), self.pace, self.model), (values, time, q, model, frames)
        return np.asarray(self.y - self._seen(model, values, time, model.arm.ball(frames)))

    def jacobian(self, z: FloatArray) -> FloatArray:
        """Return ∂(y − h)/∂z, (p, k, m): of arm and camera by the chain rule, of others by differences."""
        if self._last[0] != (z.tobytes(), self.pace, self.model):
            self.errors(z)
        values, time, q, model, frames = self._last[1]
        ball, motions = ball_rates(self.model, model.arm, q, frames)
        by_joint = np.stack([motions.pop(name) for name in self.model.arm.joint_names], axis=-1)
        seen = self._seen(model, values, time, ball)
        # A turned or moved camera sees what the other one would of a ball that moves the other way.
        pose, turn, steps = model.camera, [values[name] for name in CAMERA[:3]], STEP * np.eye(3)
        back, lever = (
            pose[:3, :3] @ (self.model.camera[:3, :3] @ rotation_matrix(turn + steps)).mT,
            ball - pose[:3, 3],
        )
        motions |= dict(zip(CAMERA, (*(lever @ back.mT - lever) / STEP, *-np.eye(3)), strict=True))
        moved = self._seen(model, values, time, ball + steps[:, None])
        by_ball = np.stack([*(moved - seen)], axis=-1) / STEP
        rates = {name: prior(name) * np.matvec(by_ball, motion) for name, motion in motions.items()}
        sizes = STEP * np.diag([prior(name) for name in EXPOSURE])[..., None]
        then, joints = self._exposed(
            values | {name: values[name] + s for name, s in zip(EXPOSURE, sizes, strict=True)}
        )
        found = self._seen(model, values, then, ball + np.matvec(by_joint, joints - q))
        rates |= dict(zip(EXPOSURE, (found - seen) / STEP, strict=True))
        for name in set(self.names) - set(rates):
            other, eye = {**values, name: values[name] + STEP * prior(name)}, model
            if name in LENS:
                eye = self.model.with_camera(pose).with_lens(
                    np.array([other[each] for each in LENS])
                )
            rates[name] = (self._seen(eye, other, time, ball) - seen) / STEP
        return -np.stack([rates[name] for name in self.names])

    def weighted(self, z: FloatArray, root: FloatArray, weights: FloatArray) -> FloatArray:
        """Return residuals with their weights (k,) and Σ^{-1/2}, and z for its prior."""
        return np.concatenate([(weights[:, None] * self.errors(z) @ root.T).ravel(), z])

    def weighted_jacobian(self, z: FloatArray, root: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the derivatives of `weighted` by z, (k m + p, p)."""
        rates = (weights[:, None] * self.jacobian(z) @ root.T).reshape(len(z), -1)
        return np.concatenate([rates.T, np.eye(len(z))])

    def pose(self, z: FloatArray) -> FloatArray:
        """Return the pose of the camera, (4, 4)."""
        return np.asarray(deviated(self.model, self.values(z)).camera)

    def recentred(self, z: FloatArray) -> FloatArray:
        """Take the pose of the camera for that from which it deviates, and return the z that is left."""
        self.model, values = self.model.with_camera(self.pose(z)), self.values(z)
        size = max(abs(values["backlash"]), MIN_PLAY)
        gears = transmitted(self.log.joints, values["ripple"], RIPPLE_ORDER)
        self.play = CubicSpline(self.log.time, played(gears, size) / size)
        rigid = deviated(self.model, values | dict.fromkeys(CAMERA, 0.0))
        self.pull = CubicSpline(self.log.time, rigid.feature(self.log.joints)).derivative(2)
        return np.asarray(z * ~self._of_camera)

    def swung(self, z: FloatArray) -> FloatArray:
        """Take the period with which the latency swings most likely, and return the z with the sizes there."""
        swings = [name.startswith("swing") for name in self.names]
        error = self.errors(z := np.where(swings, 0.0, z))
        rates = self.jacobian(z)[self.names.index("latency")] / prior("latency")
        weight = np.sum(rates**2, axis=1) + 1e-12
        late = -np.sum(rates * error, axis=1) / weight
        weight = np.sqrt(weight / (1.0 + (late / np.median(np.abs(late))) ** 2))
        found: list[tuple[float, float, list[float]]] = []
        for pace in 2.0 * np.pi / SWINGS[np.ptp(self.time) > SWINGS_IN_LOG * SWINGS]:
            waves = (
                np.stack([np.sin(pace * self.time), np.cos(pace * self.time)], axis=1)
                * weight[:, None]
            )
            sizes = np.linalg.lstsq(waves, late * weight, rcond=None)[0]
            found.append(
                (float(np.sum((late * weight - waves @ sizes) ** 2)), pace, sizes.tolist())
            )
        _, self.pace, sizes = min(found, default=(0.0, self.pace, [0.0, 0.0]))
        z[swings] = np.array(sizes) / prior("swing")
        return z

    def differences(self, z: FloatArray) -> FloatArray:
        """Return θ, for the camera the difference from its nominal pose in the same form."""
        values, pose = self.scale * z, self.pose(z)
        turn = Rotation.from_matrix(self.nominal[:3, :3].T @ pose[:3, :3]).as_rotvec()
        values[self._of_camera] = np.concatenate([turn, pose[:3, 3] - self.nominal[:3, 3]])
        return values


def turned(places: FloatArray, angle: FloatArray) -> FloatArray:
    """Return places (..., k, 3) as cameras see them that are turned about the optical axis by angles (..., k) [rad]."""
    (x, y, z), c, s = np.moveaxis(places, -1, 0), np.cos(angle), np.sin(angle)
    return np.stack(np.broadcast_arrays(c * x + s * y, c * y - s * x, z), axis=-1)


def played(joints: FloatArray, size: float) -> FloatArray:
    """Return by how much joints (k, n) behind gears with a play of ±size are elsewhere, (k, n) [rad]."""
    mechanics, x = MechanicsConfig(backlash=size), joints[0]
    behind = np.array([x := mechanics.driven(x, q) for q in joints])
    return behind - joints


def fit_cameras(
    model: RobotModel, joints: FloatArray, features: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return robust poses of a fixed camera, (s, 4, 4), and the median of the errors of each [unit of the feature].

    Args:
        model: nominal robot with one camera.
        joints: of s logs, (s, k, n) [rad].
        features: (s, k, 3) m, places of the ball, or (s, k, 2) px, its pixels; without s the same for all.
    """
    features = np.broadcast_to(features, (*joints.shape[:2], features.shape[-1]))
    pixels = isinstance(model, SetupModel) and model.setup.name == PIXEL.name
    most = max(1, ROWS_AT_ONCE // joints.shape[1])
    fit: Any = _by_pixels if pixels else _by_places
    starts = range(0, len(joints), most)
    poses, errors = zip(
        *(fit(model, joints[k : k + most], features[k : k + most]) for k in starts), strict=True
    )
    return np.concatenate(poses), np.concatenate(errors)


def _by_pixels(
    model: SetupModel, joints: FloatArray, features: FloatArray
) -> tuple[FloatArray, FloatArray]:
    import cv2  # noqa: PLC0415 - a tenth of a second

    matrix, poses, errors = (
        np.eye(3),
        np.tile(np.eye(4), (len(joints), 1, 1)),
        np.zeros(len(joints)),
    )
    matrix[[0, 1], [0, 1]], matrix[:2, 2] = model.optics.focal_lengths[0], model.optics.centre[0]
    wide = (
        model.optics.further is not None and model.optics.further.shape[-1] > COLUMNS["plumb_bob"]
    )
    for k, (q, y) in enumerate(zip(joints, features, strict=True)):
        points = np.ascontiguousarray(model.points(q)[:, 0])
        flat = y.copy()
        if wide:
            rays = locate(y[:, None, None], np.ones((len(y), 1, 1)), model.optics)[:, 0, 0]
            flat = np.ascontiguousarray((rays @ matrix.T)[:, :2])
        found, turn, place, _ = cv2.solvePnPRansac(
            points, flat, matrix, None, reprojectionError=20.0
        )
        if found:
            poses[k, :3, :3], poses[k, :3, 3] = cv2.Rodrigues(turn)[0], place[:, 0]
        poses[k] = np.linalg.inv(poses[k]) if found else model.camera
        errors[k] = np.median(np.linalg.norm(model.with_camera(poses[k]).feature(q) - y, axis=1))
    return poses, errors


def _by_places(
    model: RobotModel, joints: FloatArray, features: FloatArray
) -> tuple[FloatArray, FloatArray]:
    points, poses = model.arm.ball_position(joints), np.tile(np.eye(4), (len(joints), 1, 1))
    weights = np.ones(points.shape[:2])
    for _ in range(5):  # Kabsch's rotation with the weights of Weiszfeld's median
        share = (weights / weights.sum(axis=1, keepdims=True))[:, None]
        middle, mean = share @ points, share @ features
        R = nearest_rotation((points - middle).mT @ ((features - mean) * share.mT))
        place = middle - mean @ R.mT
        distance = np.linalg.norm(features - (points - place) @ R, axis=2)
        errors = np.median(distance, axis=1)
        weights = 1.0 / np.maximum(distance, errors[:, None] + 1e-9)
    poses[:, :3, :3], poses[:, :3, 3] = R, place[:, 0]
    return poses, errors


def identify(
    log: Log,
    model: RobotModel,
    most: int = MAX_FRAMES,
    fits: int = FITS,
    begin: Mapping[str, float] | None = None,
) -> Identified:
    """Identify a robot from a log.

    Args:
        log: of a robot with one fixed camera.
        model: nominal robot under the sensing of the log, position or pixel.
        most: frames that are used, at equal distances.
        fits: number of fits, the last without a robust loss.
        begin: parameters by name, with which the search begins.

    Raises:
        ConfigurationError: another sensing.
    """
    sensing = model.setup.name if isinstance(model, SetupModel) else POSITION.name
    if sensing not in (POSITION.name, PIXEL.name) or (
        isinstance(model, SetupModel) and model.mount != "fixed"
    ):
        wanted = "logs with --sensing position or pixel, of a fixed camera"
        raise ConfigurationError(f"identify takes {wanted}; got {sensing}")
    problem = _Problem(log, model, most, begin or {})
    inliers = np.ones(len(problem.rows), dtype=np.bool_)
    noise, z = (
        np.eye(log.spec.m) * max(problem.spread, 1e-4 * log.spec.feature.scale) ** 2,
        problem.z,
    )
    for left in reversed(range(fits)):
        root, z = np.linalg.inv(np.linalg.cholesky(noise)), problem.recentred(z)
        if left == 1:
            z = problem.swung(z)
        distances = np.sum((problem.errors(z) @ root.T) ** 2, axis=1)
        weights = np.asarray((1.0 + distances) ** -0.25 if left else inliers, dtype=np.float64)
        solved: Any = least_squares(
            partial(problem.weighted, root=root, weights=weights),
            z, partial(problem.weighted_jacobian, root=root, weights=weights),
            method="lm", max_nfev=5 * fits * len(z), ftol=1e-4 if left else 1e-6, xtol=1e-6,
        )  # fmt: skip
        z = solved.x
        noise, inliers = robust_covariance(problem.errors(z))
    return _posterior(problem, z, solved.jac[: -len(z)])


def _posterior(problem: _Problem, z: FloatArray, jacobian: FloatArray) -> Identified:
    """Return the robot at z with its uncertainty, given the Jacobian of the residuals, (k m, p)."""
    errors, s, unit = problem.errors(z), problem.scale, np.eye(len(z))
    noise, inliers = robust_covariance(errors)
    correlation = correlation_time(
        (errors @ np.linalg.inv(np.linalg.cholesky(noise)).T) * inliers[:, None]
    )
    information = jacobian.T @ jacobian / correlation
    covariance = np.linalg.inv(information + unit)
    wider = np.linalg.inv(information + unit / 4.0)
    eigenvalues, directions = np.linalg.eigh(information)
    shares = 1.0 / np.sqrt(1.0 + eigenvalues)
    known = shares < TOLD_SHARE
    return Identified(
        names=problem.names,
        values=problem.differences(z),
        covariance=s[:, None] * covariance * s,
        told=np.sqrt(np.diag(wider) / np.diag(covariance)) < TOLD,
        factor=shares[known, None] * directions.T[known] * s,
        untold=directions.T[~known],
        pose=problem.pose(z),
        noise=noise,
        residuals=errors,
        rows=problem.rows,
        inliers=inliers,
        correlation=correlation,
        swing_period=2.0 * np.pi / problem.pace,
    )


def robust_covariance(errors: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the covariance of errors (k, m) without outliers, and which are none, (k,)."""
    spread = 1.4826 * np.median(np.abs(errors), axis=0) + 1e-12
    inliers = np.sum((errors / spread) ** 2, axis=1) < OUTLIER
    for _ in range(5):
        covariance = errors[inliers].T @ errors[inliers] / max(int(inliers.sum()), 1)
        inliers = np.einsum("ki,ij,kj->k", errors, np.linalg.inv(covariance), errors) < OUTLIER
    return covariance, inliers


def correlation_time(white: FloatArray) -> float:
    """Return 1 + 2 Σ ρ_l of white residuals (k, m) [frames], at least 1, up to the first ρ_l below 2/√k."""
    total, square, count = 1.0, float(np.sum(white**2)), len(white)
    for lag in range(1, min(MAX_LAGS, count // 4)):
        share = float(np.sum(white[lag:] * white[:-lag])) / square
        if share < 2.0 / (count * white.shape[1]) ** 0.5:
            break
        total += 2.0 * share
    return total
