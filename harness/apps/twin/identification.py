"""A robot identified from a log of its joints and features, with the uncertainty of each parameter.

The parameters θ of a twin (`servobench.plant.robot.twin`) deviate the nominal robot; the feature of the frame that
arrives at t_k, exposed a latency L before, and the joint motion under commands u that act after a delay d are

    y_k = h(q(t_k − L); θ) + ν_k,   ν ~ N(0, Σ)          τ v̇ = u(t − d) − v,   q(t_{k+1}) − q(t_k) = ∫ v dt

with q a cubic spline through the logged positions. Where frames are stamped, t_k is when they would have come at the
mean latency L. θ minimises Σ ρ(‖Σ^{-1/2} ν_k‖²) + Σ (θ_i/s_i)², with a soft L1 loss ρ while Σ and the outliers are
found, and none at last for the frames that are left. s_i are wide priors (`PRIORS`), so that directions of θ that no
frame tells (the zero of the first joint turns the arm as a turn of the camera does) stay at the nominal robot. The
posterior is N(θ, (JᵀΣ⁻¹J/f + S⁻²)⁻¹), with J = ∂h/∂θ and S = diag(s), where f is the correlation time of the residuals.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline  # which loads the others, too
from scipy.optimize import least_squares
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from servobench.controllers.algebra import nearest_rotation
from servobench.harness.apps.twin.log import MAX_LATENCY, Clocks, Log, frames_of
from servobench.plant.cameras.optics import COLUMNS, locate
from servobench.plant.cameras.setups import PIXEL, POSITION, SetupModel
from servobench.plant.contract.checks import FloatArray, NamedArrays
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.hand_eye import RobotModel, rotation_matrix
from servobench.plant.robot.mechanics import MechanicsConfig, transmitted
from servobench.plant.robot.parametric import ParametricModel
from servobench.plant.robot.twin import CAMERA, LENS, Parameters, deviated, parameter_names

LATENCY_STEP = 0.0125  # [s] between latencies of the first search
MAX_FRAMES = 6000
# Prior standard deviation of each kind of parameter, which is the beginning of its name.
PRIORS = {
    "latency": 0.1,  # [s]
    "camera_turn": 1.0,  # [rad]
    "camera": 1.0,  # [m]
    "tool": 0.05,  # [m]
    "focal": 0.1,  # [1]
    "centre": 20.0,  # [px]
    "distortion": 0.2,  # [1]
    "gear": 0.1,  # [1]
    "zero": 0.2,  # [rad]
    "link": 0.1,  # [1]
    "backlash": 0.02,  # [rad]
    "ripple": 0.05,  # [rad]
    "compliance": 0.01,  # [s²]
    "turning": 0.2,  # [rad/s]
    "swing": 0.1,  # [s]
    "drift": 0.01,  # [s/s]
}
EXTRAS = ("backlash", "ripple", "drift", "swing_sin", "swing_cos", "compliance", "turning")
"""Parameters of gears, clocks, tool and mounting; pixels do not tell the last two."""
TOLD_BY_PIXELS = EXTRAS[:5]
EXPOSURE = ("latency", *TOLD_BY_PIXELS)  # parameters that decide which joints a frame shows
ARM = ("gear", "zero", "link", "tool")
"""How the names of the arm's own parameters begin."""
UNLIKELY = 3.0  # [1] A parameter of the arm is unlikely beyond this many prior deviations.
TURNINGS = np.radians(np.arange(0.0, 31.0))  # [rad/s] tried in the first search
SWING_PERIODS = np.geomspace(1.0, 20.0, 120)  # [s] tried in the search
# A swing is taken if it explains this many times the mean square of the frames; the best of noise explains 10 to 15.
MIN_WAVE = 25.0  # [1]
MIN_SWINGS = 3  # A log must be longer than this many periods of a swing.
RIPPLE_ORDER = MechanicsConfig().ripple_order
SMOOTHED_SPAN = 0.2  # [s] span of the rows from which a derivative is taken
MIN_CUBIC_ROWS = 5
MIN_PLAY = 0.002  # [rad] play about which its effect is linearised
# The log tells a parameter if its deviation grows less than this with a prior of twice the width.
MAX_PRIOR_EFFECT = 1.2  # [1]
# The log tells a direction of θ if its posterior deviation is below this share of the prior one.
MAX_PRIOR_SHARE = 0.5  # [1]
OUTLIER = 16.0  # [1] squared Mahalanobis distance of an outlier
FITS = 4
ROBUST_TOLERANCE = 1e-4  # [1] relative tolerance of the cost in robust fits
LAST_TOLERANCE = 1e-6  # [1] and in the last one
MAX_EVALUATIONS = 5  # evaluations of the residuals for each fit and parameter
WEISZFELD_STEPS = 5
ROWS_AT_ONCE = 2**14  # rows of logs for which cameras are placed side by side
STEP = 1e-6  # [1] step of finite differences, in prior deviations
MAX_LAGS = 100  # [frames] longest lag in the correlation time


@dataclass(frozen=True, eq=False)
class Identified:
    """A robot identified from a log."""

    names: tuple[str, ...]  # the parameters
    values: FloatArray  # θ, (p,), for the camera the difference from its nominal pose
    covariance: FloatArray  # covariance of the posterior, (p, p)
    told: BoolArray  # which parameters the log tells, (p,)
    factor: FloatArray  # (d, p), whose rows are the directions that the log tells; factorᵀ factor is their covariance
    untold: FloatArray  # (e, p), directions of θ that it does not tell, of length 1 in units of the priors
    pose: FloatArray  # pose of the camera at θ, (4, 4)
    noise: FloatArray  # Σ, (m, m)
    residuals: FloatArray  # residuals of all valid frames, (k, m)
    rows: Any  # rows of these frames in the log, (k,)
    inliers: BoolArray  # which of them are no outliers, (k,)
    correlation: float  # f [frames]
    swing_period: float  # [s]

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations of the parameters, (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def estimate(self, name: str) -> tuple[float, float]:
        """Return a parameter and its standard deviation; 0 and infinite for one that the log does not have."""
        if name not in self.names:
            return 0.0, np.inf
        k = self.names.index(name)
        return float(self.values[k]), float(self.deviations[k])

    def values_by_name(self) -> dict[str, float]:
        """Return θ by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    def sizes(self) -> dict[str, float]:
        """Return gears, zeros, links and tool by name, in deviations of their priors."""
        values = self.values_by_name()
        return {n: value / prior(n) for n, value in values.items() if n.startswith(ARM)}

    def unlikely(self) -> list[str]:
        """Return the names of those that are far from the nominal robot."""
        return [name for name, size in self.sizes().items() if abs(size) > UNLIKELY]

    def rates(self, log: Log) -> FloatArray:
        """Return how fast the features of these frames move, (k, m), 1/s."""
        predicted = log.features[self.rows] - self.residuals
        return np.gradient(predicted, log.frame_time[self.rows], axis=0)

    def model(self, nominal: RobotModel) -> RobotModel:
        """Return the robot at θ, given the nominal one."""
        values = self.values_by_name()
        deviating = {name: value for name, value in values.items() if not name.startswith("camera")}
        return deviated(nominal.with_camera(self.pose), deviating)

    def errors(self, log: Log, nominal: RobotModel) -> FloatArray:
        """Return the residuals of all valid frames of a log after the longest latency, (k, m)."""
        rows = frames_of(log)
        latency = self.values[self.names.index("latency")]
        joints = CubicSpline(log.time, log.joints)(log.frame_time[rows] - latency)
        features = self.model(nominal).feature(joints)
        return log.features[rows] - features


def kind_of(name: str) -> str:
    """Return the beginning of a parameter's name, by which it has its unit and its prior."""
    if name.startswith("camera_turn"):
        return "camera_turn"
    return name.partition("_")[0]


def prior(name: str) -> float:
    """Return the standard deviation of a parameter before any log."""
    return PRIORS[kind_of(name)]


class _Evaluation(NamedTuple):
    """The values that were computed for the residuals at one z."""

    values: dict[str, float]  # θ by name
    time: FloatArray  # when the frames were exposed, (k,) [s]
    joints: FloatArray  # q, behind the gears then, (k, n) [rad]
    model: RobotModel  # the robot at θ
    ball: FloatArray  # in its base frame, (k, 3) m
    image: FloatArray  # features of a camera that does not turn and a rigid tool, (k, m)


class _Placed(NamedTuple):
    """The camera where it fits best, among some latencies and speeds of turning."""

    error: float  # median error [unit of the feature]
    latency: float  # [s]
    turning: float  # [rad/s]
    pose: FloatArray  # (4, 4)


class _Problem:
    """Residuals of the valid frames of a log as a function of z = θ / s.

    Attributes:
        rows: rows of these frames in the log, (k,).
        time: when they arrived, (k,) [s].
        y: their features, (k, m).
        motion: joint positions over time, a spline.
        smooth: the same without their noise, by whose velocities latencies are told.
        names: the parameters θ.
        scale: s, their prior deviations, (p,).
        of_camera: which of them are the pose of the camera, (p,).
        nominal: pose of the nominal camera, (4, 4).
        model: the robot with the pose from which the camera deviates.
        pace: angular frequency of the latency's swing [rad/s].
        spread: median error of the first placement [unit of the feature].
        z: where the search begins, (p,).
    """

    def __init__(self, log: Log, model: RobotModel, most: int, begin: Parameters) -> None:
        """Place the camera where the nominal robot, changed by the parameters `begin`, fits a log best."""
        self.log = log
        self.rows = frames_of(log, most)
        self.time = log.frame_time[self.rows]
        self.y = log.features[self.rows]
        self.motion = CubicSpline(log.time, log.joints)
        self.smooth = CubicSpline(log.time, self._by_cubics(log.joints, 0))
        self.middle = float(log.time.mean())
        pixels = sees_pixels(model)
        self.names = _parameters(model, pixels=pixels)
        self.scale = np.array([prior(name) for name in self.names])
        self.nominal = model.camera
        self.of_camera = np.array([name.startswith("camera") for name in self.names])
        self.model = model
        self.pace = 1.0
        # The last evaluation, and the z, pace and model that it belongs to.
        self._last_key: Any = None
        self._last: Any = None
        first_guess = deviated(model, begin)
        lowest, highest, _ = log.clocks or Clocks(0.0, MAX_LATENCY, None)
        latencies = np.arange(lowest, highest + 1e-9, LATENCY_STEP)
        placed = self._placed(first_guess, latencies, np.zeros_like(latencies))
        latency = placed.latency
        if not pixels:
            placed = self._placed(first_guess, np.full(len(TURNINGS), latency), TURNINGS)
        self.spread = placed.error
        found = {**begin, "latency": latency, "turning": placed.turning}
        start = np.array([found.get(name, 0.0) for name in self.names])
        # The pose of the camera is that of the model, so its own parameters begin at 0.
        self.z = start / self.scale * ~self.of_camera
        self.model = self.model.with_camera(placed.pose)

    def _placed(self, model: RobotModel, latencies: FloatArray, turnings: FloatArray) -> _Placed:
        """Return the camera for the pair of latency and speed of turning, of (s,) each, with the least error."""
        exposed = self.time - latencies[:, None]
        y = turned(self.y, -turnings[:, None] * exposed) if turnings.any() else self.y
        poses, errors = fit_cameras(model, self.motion(exposed), y)
        best = int(errors.argmin())
        return _Placed(
            float(errors[best]), float(latencies[best]), float(turnings[best]), poses[best]
        )

    def values(self, z: FloatArray) -> dict[str, float]:
        """Return θ by name."""
        return dict(zip(self.names, (self.scale * z).tolist(), strict=True))

    def _exposed(
        self, values: Mapping[str, Any], motion: CubicSpline
    ) -> tuple[FloatArray, FloatArray]:
        """Return when the frames were exposed, (..., k) s, and the joints behind their gears then, (..., k, n) rad."""
        drift = values["drift"] * (self.time - self.middle)
        steady = self.time - values["latency"] - drift
        time = steady
        swing_sin = values["swing_sin"]
        swing_cos = values["swing_cos"]
        if np.any([swing_sin, swing_cos]):
            # The swing is that at the exposure, which depends on it: a fixed point.
            for _ in range(8):
                phase = self.pace * time
                time = steady - swing_sin * np.sin(phase) - swing_cos * np.cos(phase)
        ripple = np.expand_dims(values["ripple"], -1)
        backlash = np.expand_dims(values["backlash"], -1)
        geared = transmitted(motion(time), ripple, RIPPLE_ORDER)
        return time, geared + backlash * self.play(time)

    def _seen(self, values: Parameters, time: FloatArray, image: FloatArray) -> FloatArray:
        """Return h, (..., k, m), given what a camera that does not turn would see of a rigid tool."""
        if "turning" not in values:
            return image
        # A soft tool lags behind by its compliance times the acceleration of the rigid one.
        bent = image - values["compliance"] * self.pull(time)
        return turned(bent, values["turning"] * time)

    def errors(self, z: FloatArray) -> FloatArray:
        """Return y − h, (k, m)."""
        values = self.values(z)
        time, q = self._exposed(values, self.motion)
        model = deviated(self.model, values)
        ball = model.arm.ball_position(q)
        image = _image(model, ball)
        self._last_key = self._key(z)
        self._last = _Evaluation(values, time, q, model, ball, image)
        return self.y - self._seen(values, time, image)

    def _key(self, z: FloatArray) -> tuple[bytes, float, RobotModel]:
        return z.tobytes(), self.pace, self.model

    def jacobian(self, z: FloatArray) -> FloatArray:
        """Return ∂(y − h)/∂z, (p, k, m): for arm and camera by the chain rule, for others by differences."""
        if self._last_key != self._key(z):
            self.errors(z)
        at: _Evaluation = self._last
        values = at.values
        h = self._seen(values, at.time, at.image)
        by_joint, by_parameter = self._by_robot(at)
        rates = {}
        for name, rate in by_parameter.items():
            rates[name] = prior(name) * self._turned_as_seen(at, rate)

        # Parameters of the exposure change the joints that a frame shows.
        sizes = STEP * np.diag([prior(name) for name in EXPOSURE])[..., None]
        later = {name: values[name] + size for name, size in zip(EXPOSURE, sizes, strict=True)}
        _, joints = self._exposed(values, self.smooth)
        time, joints_then = self._exposed(values | later, self.smooth)
        shown = at.image + np.matvec(by_joint, joints_then - joints)
        by_exposure = (self._seen(values, time, shown) - h) / STEP
        rates |= dict(zip(EXPOSURE, by_exposure, strict=True))

        # The others are those of the lens and of what the camera sees of a ball in its place.
        for name in set(self.names) - set(rates):
            changed = {**values, name: values[name] + STEP * prior(name)}
            image = at.image
            if name in LENS:
                camera = self.model.with_camera(at.model.camera).with_lens(_lens(changed))
                image = _image(camera, at.ball)
            rates[name] = (self._seen(changed, at.time, image) - h) / STEP
        return -np.stack([rates[name] for name in self.names])

    def _turned_as_seen(self, at: _Evaluation, rate: FloatArray) -> FloatArray:
        """Return the motion of h, (k, m), with one of the image."""
        if "turning" not in at.values:
            return rate
        return turned(rate, at.values["turning"] * at.time)

    def _by_robot(self, at: _Evaluation) -> tuple[FloatArray, NamedArrays]:
        """Return the derivatives of the image by the joints, (k, m, n), and by parameters of arm and camera, (k, m)."""
        values = at.values
        robot = ParametricModel(self.model.with_lens(_lens(values)))
        theta = np.array([values[name] for name in robot.names])
        theta[robot.pose_columns] = 0.0
        found = robot.derivatives(theta, at.model.camera[None], at.joints)
        rates = dict(zip(robot.names, np.moveaxis(found.by_parameter, -1, 0), strict=True))
        # Those by a turn are about the axes of the camera that has turned; here, a rotation vector grows.
        turns = CAMERA[:3]
        turn = np.array([values[name] for name in turns])
        turned_more = rotation_matrix(turn + STEP * np.eye(3))
        further = Rotation.from_matrix(rotation_matrix(turn).T @ turned_more).as_rotvec() / STEP
        by_turn = np.tensordot(further, np.stack([rates[name] for name in turns]), axes=1)
        return found.by_joint, rates | dict(zip(turns, by_turn, strict=True))

    def weighted(self, z: FloatArray, root: FloatArray, weights: FloatArray) -> FloatArray:
        """Return residuals with their weights (k,) and Σ^{-1/2}, and z for its prior."""
        white = weights[:, None] * self.errors(z) @ root.T
        return np.concatenate([white.ravel(), z])

    def weighted_jacobian(self, z: FloatArray, root: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the derivatives of `weighted` by z, (k m + p, p)."""
        rates = (weights[:, None] * self.jacobian(z) @ root.T).reshape(len(z), -1)
        return np.concatenate([rates.T, np.eye(len(z))])

    def pose(self, z: FloatArray) -> FloatArray:
        """Return the pose of the camera, (4, 4)."""
        return deviated(self.model, self.values(z)).camera

    def recentred(self, z: FloatArray) -> FloatArray:
        """Take the pose of the camera for that from which it deviates, and return the z that is left.

        The effects of play and of a soft tool are linearised anew about this z, too.
        """
        self.model = self.model.with_camera(self.pose(z))
        values = self.values(z)
        play = max(abs(values["backlash"]), MIN_PLAY)
        gears = transmitted(self.log.joints, values["ripple"], RIPPLE_ORDER)
        self.play = CubicSpline(self.log.time, played(gears, play) / play)
        rigid = deviated(self.model, values | dict.fromkeys(CAMERA, 0.0))
        path = rigid.feature(self.log.joints)
        self.pull = CubicSpline(self.log.time, self._by_cubics(path, 2))
        return z * ~self.of_camera

    def _by_cubics(self, path: FloatArray, derivative: int) -> FloatArray:
        """Return a derivative of a path at the rows, (k, m), by cubics through what is near each row.

        Those of a spline through all rows hold the noise of the joints, such as jitter of their stamps. The frame has
        the same noise, so that a tool of negative compliance would explain it; and a velocity with noise seems to tell
        a latency from all else that is like it, such as play, though no change of the latency lessens that noise.
        """
        period = self.log.spec.period
        rows = max(2 * round(0.5 * SMOOTHED_SPAN / period) + 1, MIN_CUBIC_ROWS)
        return savgol_filter(path, rows, 3, deriv=derivative, delta=period, axis=0)

    def swung(self, z: FloatArray) -> FloatArray:
        """Take the period with which the latency swings most likely, and return the z with the sizes there.

        Each frame tells its own lateness along ∂h/∂latency; a sine and a cosine of each period are fitted to these.
        """
        swings = [name.startswith("swing") for name in self.names]
        z = np.where(swings, 0.0, z)
        error = self.errors(z)
        rates = self.jacobian(z)[self.names.index("latency")] / prior("latency")
        weight = np.sum(rates**2, axis=1) + 1e-12
        late = -np.sum(rates * error, axis=1) / weight  # [s]
        told = late[late != 0.0]  # an arm at rest tells none
        if not told.size:
            return z
        # Cauchy weights, so that outliers count little.
        scaled = late / np.median(np.abs(told))
        weight = np.sqrt(weight / (1.0 + scaled**2))
        wave = fitted_wave(self.time, late, weight)
        if wave is None:
            return z
        pace, sizes, left = wave
        if len(late) * (1.0 - left) > MIN_WAVE:
            self.pace = pace
            z[swings] = sizes / prior("swing")
        return z

    def differences(self, z: FloatArray) -> FloatArray:
        """Return θ, for the camera the difference from its nominal pose in the same form."""
        values = self.scale * z
        pose = self.pose(z)
        turn = Rotation.from_matrix(self.nominal[:3, :3].T @ pose[:3, :3]).as_rotvec()
        values[self.of_camera] = np.concatenate([turn, pose[:3, 3] - self.nominal[:3, 3]])
        return values


def fitted_wave(
    time: FloatArray, late: FloatArray, weight: FloatArray
) -> tuple[float, FloatArray, float] | None:
    """Return the angular frequency [rad/s] whose sine and cosine, of sizes (2,) [s], fit latenesses (k,) [s] best.

    The third number is the share of the weighted squares that is left. None for a log that is too short for any wave.
    """
    fits: list[tuple[float, float, list[float]]] = []
    target = late * weight
    fitting = SWING_PERIODS[np.ptp(time) > MIN_SWINGS * SWING_PERIODS]
    for pace in 2.0 * np.pi / fitting:
        phase = pace * time
        waves = np.stack([np.sin(phase), np.cos(phase)], axis=1) * weight[:, None]
        sizes = np.linalg.lstsq(waves, target, rcond=None)[0]
        left = float(np.sum((target - waves @ sizes) ** 2))
        fits.append((left, pace, sizes.tolist()))
    if not fits:
        return None
    left, pace, best = min(fits)
    return pace, np.array(best), left / max(float(np.sum(target**2)), 1e-18)


def sees_pixels(model: RobotModel) -> bool:
    """Return whether the features of a model are pixels."""
    return isinstance(model, SetupModel) and model.setup.name == PIXEL.name


def _lens(values: Parameters) -> FloatArray:
    return np.array([values.get(name, 0.0) for name in LENS])


def _image(model: RobotModel, ball: FloatArray) -> FloatArray:
    """Return the features of balls in the base frame, (..., k, 3) m, before any turning of the camera."""
    if isinstance(model, SetupModel):
        return model.feature_at(ball[..., None, :])
    places: Any = model  # whose features are places in the camera frame
    return np.asarray(places.to_camera(ball))


def _parameters(model: RobotModel, *, pixels: bool) -> tuple[str, ...]:
    """Return the names of θ: those of a twin but for the drive, of the lens only where features are pixels."""
    lacking = {"command_delay", "lag"}
    extras: tuple[str, ...] = TOLD_BY_PIXELS
    if not pixels:
        lacking.update(LENS)
        extras = EXTRAS
    own = [name for name in parameter_names(model.arm) if name not in lacking]
    return (*own, *extras)


def turned(places: FloatArray, angle: FloatArray) -> FloatArray:
    """Return places (..., k, 3) as cameras see them that are turned about the optical axis by angles (..., k) [rad]."""
    x, y, z = np.moveaxis(places, -1, 0)
    c = np.cos(angle)
    s = np.sin(angle)
    return np.stack(np.broadcast_arrays(c * x + s * y, c * y - s * x, z), axis=-1)


def played(joints: FloatArray, size: float) -> FloatArray:
    """Return by how much joints (k, n) behind gears with a play of ±size are elsewhere, (k, n) [rad]."""
    mechanics = MechanicsConfig(backlash=size)
    # A joint stays where it is until its gear has crossed the play, so each row depends on the one before.
    behind = np.empty(joints.shape)
    x = joints[0]
    for k, q in enumerate(joints):
        x = mechanics.driven(x, q)
        behind[k] = x
    return behind - joints


def fit_cameras(
    model: RobotModel, joints: FloatArray, features: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return robust poses of a fixed camera, (s, 4, 4), and the median of the errors of each [unit of the feature].

    Args:
        model: nominal robot with one camera.
        joints: joint positions of s logs, (s, k, n) [rad].
        features: (s, k, 3) m, places of the ball, or (s, k, 2) px, its pixels; without s the same for all.
    """
    features = np.broadcast_to(features, (*joints.shape[:2], features.shape[-1]))
    logs_at_once = max(1, ROWS_AT_ONCE // joints.shape[1])
    fit: Any = _by_pixels if sees_pixels(model) else _by_places
    poses = []
    errors = []
    for first in range(0, len(joints), logs_at_once):
        part = slice(first, first + logs_at_once)
        own_poses, own_errors = fit(model, joints[part], features[part])
        poses.append(own_poses)
        errors.append(own_errors)
    return np.concatenate(poses), np.concatenate(errors)


def _by_pixels(
    model: SetupModel, joints: FloatArray, features: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the poses by perspective-n-point with RANSAC; see `fit_cameras`."""
    import cv2  # noqa: PLC0415 - a tenth of a second

    optics = model.optics
    matrix = np.eye(3)
    matrix[[0, 1], [0, 1]] = optics.focal_lengths[0]
    matrix[:2, 2] = optics.centre[0]
    poses = np.tile(np.eye(4), (len(joints), 1, 1))
    errors = np.zeros(len(joints))
    # OpenCV knows none of the lenses with more coefficients: their pixels become those of a pinhole.
    further = optics.further
    wide = further is not None and further.shape[-1] > COLUMNS["plumb_bob"]
    for k, (q, y) in enumerate(zip(joints, features, strict=True)):
        points = np.ascontiguousarray(model.points(q)[:, 0])
        flat = y.copy()
        if wide:
            rays = locate(y[:, None, None], np.ones((len(y), 1, 1)), optics)[:, 0, 0]
            flat = np.ascontiguousarray((rays @ matrix.T)[:, :2])
        found, turn, place, _ = cv2.solvePnPRansac(
            points, flat, matrix, None, reprojectionError=20.0
        )
        if found:
            # OpenCV returns the base in the camera frame.
            poses[k, :3, :3] = cv2.Rodrigues(turn)[0]
            poses[k, :3, 3] = place[:, 0]
            poses[k] = np.linalg.inv(poses[k])
        else:
            poses[k] = model.camera
        misses = model.with_camera(poses[k]).feature(q) - y
        errors[k] = np.median(np.linalg.norm(misses, axis=1))
    return poses, errors


def _by_places(
    model: RobotModel, joints: FloatArray, features: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the poses by Kabsch's rotation with the weights of Weiszfeld's median; see `fit_cameras`."""
    points = model.arm.ball_position(joints)
    weights = np.ones(points.shape[:2])
    for _ in range(WEISZFELD_STEPS):
        share = (weights / weights.sum(axis=1, keepdims=True))[:, None]
        middle = share @ points
        mean = share @ features
        R = nearest_rotation((points - middle).mT @ ((features - mean) * share.mT))
        place = middle - mean @ R.mT
        distance = np.linalg.norm(features - (points - place) @ R, axis=2)
        errors = np.median(distance, axis=1)
        weights = 1.0 / np.maximum(distance, errors[:, None] + 1e-9)
    poses = np.tile(np.eye(4), (len(joints), 1, 1))
    poses[:, :3, :3] = R
    poses[:, :3, 3] = place[:, 0]
    return poses, errors


def identify(
    log: Log,
    model: RobotModel,
    most: int = MAX_FRAMES,
    fits: int = FITS,
    begin: Parameters | None = None,
) -> Identified:
    """Identify a robot from a log.

    Args:
        log: rows of a robot with one fixed camera.
        model: nominal robot under the sensing of the log, position or pixel.
        most: frames that are used, at equal distances.
        fits: number of fits, the last without a robust loss.
        begin: parameters by name, with which the search begins.

    Raises:
        ConfigurationError: another sensing.
    """
    _check_sensing(model)
    problem = _Problem(log, model, most, begin or {})
    z = problem.z
    inliers = np.ones(len(problem.rows), dtype=np.bool_)
    deviation = max(problem.spread, 1e-4 * log.spec.feature.scale)
    noise = np.eye(log.spec.m) * deviation**2

    for left in reversed(range(fits)):
        root = np.linalg.inv(np.linalg.cholesky(noise))
        z = problem.recentred(z)
        if left == 1:
            z = problem.swung(z)
        distances = np.sum((problem.errors(z) @ root.T) ** 2, axis=1)
        if left:
            # The square roots of the weights of a soft L1 loss.
            weights = np.asarray((1.0 + distances) ** -0.25, dtype=np.float64)
            tolerance = ROBUST_TOLERANCE
        else:
            weights = np.asarray(inliers, dtype=np.float64)
            tolerance = LAST_TOLERANCE
        solved: Any = least_squares(
            partial(problem.weighted, root=root, weights=weights),
            z,
            partial(problem.weighted_jacobian, root=root, weights=weights),
            method="lm",
            max_nfev=MAX_EVALUATIONS * fits * len(z),
            ftol=tolerance,
            xtol=1e-6,
        )
        z = solved.x
        noise, inliers = robust_covariance(problem.errors(z))
    without_prior = solved.jac[: -len(z)]
    return _posterior(problem, z, without_prior)


def errors_along(log: Log, model: RobotModel, robot: Identified) -> tuple[Any, FloatArray]:
    """Return rows of frames of a log, (k,), and their residuals, (k, m), by the robot of another part of it.

    All parameters count, those of gears, tool and clocks, too; `model` is the nominal robot.
    """
    values = robot.values_by_name()
    problem = _Problem(log, model, MAX_FRAMES, values)
    problem.model = model.with_camera(robot.pose)
    problem.pace = 2.0 * np.pi / robot.swing_period
    z = robot.values / problem.scale * ~problem.of_camera
    return problem.rows, problem.errors(problem.recentred(z))


def _check_sensing(model: RobotModel) -> None:
    """Refuse a model whose camera cannot be identified."""
    sensing = POSITION.name
    if isinstance(model, SetupModel):
        sensing = model.setup.name
        if model.mount != "fixed":
            sensing += f":{model.mount}"
    if sensing not in (POSITION.name, PIXEL.name):
        wanted = "logs with --sensing position or pixel, of a fixed camera"
        raise ConfigurationError(f"identify takes {wanted}; got {sensing}")


def _posterior(problem: _Problem, z: FloatArray, jacobian: FloatArray) -> Identified:
    """Return the robot at z with its uncertainty, given the Jacobian of the whitened residuals by z, (k m, p).

    In z the prior is N(0, I): its information is I, and I/4 with twice the width.
    """
    errors = problem.errors(z)
    noise, inliers = robust_covariance(errors)
    white = whitened(errors, noise)
    correlation = correlation_time(white * inliers[:, None])
    information = jacobian.T @ jacobian / correlation
    unit = np.eye(len(z))
    covariance = np.linalg.inv(information + unit)
    wider = np.linalg.inv(information + unit / 4.0)
    growth = np.sqrt(np.diag(wider) / np.diag(covariance))
    eigenvalues, directions = np.linalg.eigh(information)
    shares = 1.0 / np.sqrt(1.0 + eigenvalues)  # posterior over prior deviation of each direction
    known = shares < MAX_PRIOR_SHARE
    s = problem.scale
    return Identified(
        names=problem.names,
        values=problem.differences(z),
        covariance=s[:, None] * covariance * s,
        told=growth < MAX_PRIOR_EFFECT,
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


def whitened(errors: FloatArray, noise: FloatArray) -> FloatArray:
    """Return errors (k, m) in a base and units in which their covariance (m, m) is I."""
    return errors @ np.linalg.inv(np.linalg.cholesky(noise)).T


def robust_covariance(errors: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the covariance of errors (k, m) without outliers, and which are none, (k,)."""
    spread = 1.4826 * np.median(np.abs(errors), axis=0) + 1e-12
    inliers = np.sum((errors / spread) ** 2, axis=1) < OUTLIER
    for _ in range(5):
        # NumPy multiplies an array with its own transpose by another routine, with other last bits: hence two copies.
        covariance = errors[inliers].T @ errors[inliers] / max(int(inliers.sum()), 1)
        distances = np.einsum("ki,ij,kj->k", errors, np.linalg.inv(covariance), errors)
        inliers = distances < OUTLIER
    return covariance, inliers


def correlation_time(white: FloatArray) -> float:
    """Return 1 + 2 Σ ρ_l of white residuals (k, m) [frames], at least 1, up to the first ρ_l below 2/√k."""
    total = 1.0
    square = float(np.sum(white**2))
    count = len(white)
    for lag in range(1, min(MAX_LAGS, count // 4)):
        share = float(np.sum(white[lag:] * white[:-lag])) / square
        if share < 2.0 / (count * white.shape[1]) ** 0.5:
            break
        total += 2.0 * share
    return total
