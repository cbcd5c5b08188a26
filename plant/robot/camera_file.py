"""A user's camera and target from a file: image, intrinsics, place, timing and noise; an example is in own_robot.md.

The file is a TOML with the keys of `CameraFile`, or the intrinsics alone: a YAML of a calibration tool, which a
TOML may also name as its `intrinsics`. Keys that it lacks are as on the bench.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import configuration_errors
from servobench.plant.contract.files import read_toml
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import (
    NonNegative,
    Number,
    Positive,
    Usual,
    nested,
    override,
    remark,
    settings,
)
from servobench.plant.robot.camera import PinholeCamera
from servobench.plant.robot.camera_formats import (
    FACTS,
    LENSES,
    in_rows,
    plain_name,
    read_intrinsics,
)

SYNONYMS = {name: lens for lens, names in FACTS["lens_names"].items() for name in names}
WANTED = ", or ".join(f"{lens} with {', '.join(names)}" for lens, names in LENSES.items())
RANGES = {  # unit, least and largest number
    "width": ("px", 16, 20_000), "height": ("px", 16, 20_000), "vertical_fov": ("deg", 2, 170),
    "rate": ("Hz", 0.5, 1000), "latency": ("s", 0, 5),
}  # fmt: skip
FOCAL = (0.1, 30.0)  # least and largest focal length over the width of the image
MAX_PLACE = {"base": 20.0, "flange": 1.0}  # [m] largest coordinate of a place
MAX_OFF = 0.1  # share of the image by which the principal point is usually off its middle
# Share of its distance from the middle by which a distortion usually moves a point at most
MAX_MOVED = 0.5  # [1]
ENDLESS = 1e6  # [1] r² of a ray that no image shows
MAX_ANGLE = math.atan(math.sqrt(ENDLESS))  # [rad] from the optical axis to it
ROUNDED_ROOT = 1e-9  # [1] by which the root of a polynomial is off at most
MIN_AHEAD = 0.5  # usual least cosine of the angle between the z axes of camera and flange
# Largest deviation of whole control periods from a frame that is in step with them
IN_STEP = 2e-4  # [1]
# Largest difference of a frame of whole milliseconds from the camera's
MAX_ROUNDED = 0.015  # [1]
ROUNDED = 1e-3  # largest error of a rotation whose numbers were rounded
Row = tuple[Number, ...]
Lens = tuple[str, tuple[float, ...]]  # its model, a key of `LENSES`, and its coefficients [1]


@settings
class Place:
    """A place on the base or on the flange."""

    frame: Literal["", "base", "flange"] = ""
    """Empty: the bench places it."""
    position: tuple[Annotated[Number, Usual(5.0)], ...] = ()
    """[m]"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        most = MAX_PLACE.get(self.frame, math.inf)
        is_half_given = bool(self.frame) != bool(self.position)
        if is_half_given or len(self.position) not in (0, 3):
            raise ValueError(
                'a place needs frame, "base" or "flange", and position, three numbers in m'
            )
        if max(map(abs, self.position), default=0.0) > most:
            raise ValueError(
                f"position must be in m, at most {most:g} m on the {self.frame}, got {self.position}"
            )


@settings
class Pose(Place):
    """The place of a camera; its z axis is the optical axis, x points right and y down in the image."""

    rotation: tuple[Row, ...] | Row = (0.0, 0.0, 0.0, 1.0)
    """Rows of the rotation matrix, or a quaternion x, y, z, w as in ROS."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        super().__post_init__()
        if self.matrix[2, 2] < MIN_AHEAD and self.frame == "flange":
            remark(
                "pose.rotation turns the optical axis by more than 60° from the flange's z axis: z is the "
                "optical axis, x points right and y down, and a quaternion is x, y, z, w"
            )

    @cached_property
    def matrix(self) -> FloatArray:
        """The pose in its frame, (4, 4)."""
        from scipy.spatial.transform import Rotation  # noqa: PLC0415 - a quarter of a second, which lists do not need

        given: FloatArray = np.zeros(0)
        if len({np.size(row) for row in self.rotation}) == 1:
            given = np.array(self.rotation)
        # Numbers may be rounded.
        if given.shape == (4,) and abs(np.linalg.norm(given) - 1.0) < ROUNDED:
            rotation = Rotation.from_quat(given)
        elif given.shape == (3, 3) and _is_rotation_matrix(given):
            rotation = Rotation.from_matrix(given)
        else:
            raise ValueError(
                f"pose.rotation must be a rotation matrix or a quaternion of length 1, got {self.rotation}"
            )
        pose = np.eye(4)
        pose[:3, :3] = rotation.as_matrix()
        pose[:3, 3] = self.position or 0.0
        return pose


def _is_rotation_matrix(given: FloatArray) -> bool:
    """Return whether a matrix (3, 3) is a rotation, whose numbers may be rounded."""
    deviation = np.abs(given @ given.T - np.eye(3)).max()
    return bool(deviation < ROUNDED < np.linalg.det(given))


@settings
class Target(Place):
    """Size and place of the target."""

    radius: Annotated[Positive, Usual(0.5)] | None = None
    """[m] of the ball."""
    side: Annotated[Positive, Usual(2.0)] | None = None
    """[m] of the plate's square, at the corners of which the discs are."""


@settings
class CameraFile:
    """The keys of a file."""

    width: int = 0
    """[px]"""
    height: int = 0
    """[px]"""
    matrix: tuple[Row, ...] = ()
    """[px] f_x, 0, c_x; 0, f_y, c_y; 0, 0, 1, with c counted from the upper left corner of the image."""
    vertical_fov: Positive | None = None
    """[deg] in place of the matrix: square pixels about the middle of the image."""
    distortion: dict[str, Number] | Row = ()
    """Coefficients by name or in OpenCV's order."""
    distortion_model: str = ""
    """By ROS's name; empty for the model of OpenCV with as many coefficients."""
    rate: Positive | None = None
    """[Hz] of the frames."""
    latency: NonNegative | None = None
    """[s] between exposure and delivery of a frame."""
    noise: str | Number = ""
    """Deviation of each feature with its unit, such as 0.5px, or 2mm for places by depth."""
    pose: Pose = nested(Pose)
    """Of the camera."""
    target: Target = nested(Target)
    """Before the camera."""
    intrinsics: str = ""
    """File beside this one, as calibration tools write it."""
    second: str = ""
    """File beside this one, of the second camera of a stereo pair."""


@dataclass(frozen=True, eq=False)
class OwnCamera:
    """A user's camera."""

    files: tuple[Path, ...]  # the files from which it was read, its own first
    keys: CameraFile  # content of the files
    matrix: FloatArray  # (3, 3) [px], matrix of intrinsics
    lens: str  # a key of `LENSES`
    distortion: tuple[float, ...]  # its coefficients [1]
    second: OwnCamera | None  # the other one of a stereo pair; None for a single camera

    @property
    def name(self) -> str:
        """Name of its file."""
        return self.files[0].name

    @property
    def pair(self) -> tuple[OwnCamera, ...]:
        """This camera, and the second one of a stereo pair."""
        if self.second is None:
            return (self,)
        return (self, self.second)

    @cached_property
    def pinhole(self) -> PinholeCamera:
        """An ideal camera with its size and horizontal focal length."""
        focal = float(self.matrix[0, 0])
        vertical_fov = 2.0 * math.degrees(math.atan(0.5 * self.keys.height / focal))
        far = 2.0 * MAX_PLACE["base"]
        return PinholeCamera(self.keys.width, self.keys.height, vertical_fov, far=far)

    def sensing(self, usual: SensingConfig, period: float) -> SensingConfig:
        """Return the settings of a sensor with this camera's timing and noise.

        Raises:
            ValueError: a noise that cannot be read.
        """
        keys = self.keys
        changes: dict[str, Any] = {}
        if keys.rate is not None:
            changes["frame_period"] = frame_time(f"camera {self.name}", keys.rate, period)
        if keys.latency is not None:
            changes["latency"] = keys.latency
        if keys.noise:
            changes["feature_noise"] = keys.noise
        return override(str(self.files[0]), usual, changes)


def frame_time(what: str, rate: float, period: float) -> float:
    """Return how long a frame of a camera with a rate [Hz] takes on the bench [s].

    It is a multiple of the control `period` [s] where the two are nearly in step, and else that of the rate; where two
    or more are delivered in each period, one arrives at every control instant: 0.
    """
    frames = rate * period  # in each period
    whole_frames = round(frames)
    if whole_frames > 1 and abs(frames / whole_frames - 1.0) < ROUNDED:
        return 0.0
    whole_periods = round(1.0 / frames)
    if abs(max(1, whole_periods) * frames - 1.0) < IN_STEP:
        return whole_periods * period
    in_milliseconds = max(1, round(1e3 / rate)) / 1e3
    if abs(in_milliseconds * rate - 1.0) < MAX_ROUNDED:
        off = abs(round(in_milliseconds / period) * period - in_milliseconds)
        if off <= ROUNDED * period:
            return in_milliseconds
    remark(
        f"{what}: a frame takes {1e3 / rate:g} ms and a control period {1e3 * period:g} ms, so delays change; "
        f"run.period={rate:.9g}Hz helps"
    )
    return 1.0 / rate


def read_camera(path: Path, *, second: bool = False) -> OwnCamera:
    """Return the camera of a file, or the second one of a stereo pair.

    Raises:
        ValueError: a file that cannot be used; one line with its path.
    """
    is_toml = path.suffix.lower() == ".toml"
    values = {"intrinsics": path.name}
    if is_toml:
        values = read_toml("camera file", path)
    if "matrix" in values:
        values["matrix"] = in_rows(values["matrix"])
    keys = override(f"camera file {path}", CameraFile(), values)
    if second and keys.second:
        raise ValueError(
            f"camera file {path} is the second of a pair and must name no other, got {keys.second}"
        )
    with configuration_errors(f"camera file {path}: "):
        files = [path]
        if is_toml and keys.intrinsics:
            files.append(path.parent / keys.intrinsics)
        if keys.intrinsics:
            read = read_intrinsics(files[-1])
            twice = sorted(set(read) & set(values))
            if is_toml and twice:
                raise ValueError(
                    f"{twice[0]} is given here and by {keys.intrinsics}, its intrinsics; leave one out"
                )
            keys = override(files[-1].name, keys, read)
        other = None
        if keys.second:
            other = read_camera(path.parent / keys.second, second=True)
            files += other.files
        matrix = _matrix(keys)
        lens, distortion = _lens(keys)
        camera = OwnCamera(tuple(files), keys, matrix, lens, distortion, other)
        _check_distortion(camera)
        if other is not None:
            _check_second(camera, other)
    return camera


def _matrix(keys: CameraFile) -> FloatArray:
    """Return the intrinsic matrix, (3, 3) px, of numbers that are checked."""
    if isinstance(keys.noise, float):
        raise ValueError(  # noqa: TRY004
            f'noise needs its unit, such as "0.5px", or "2mm" for places by depth; got {keys.noise:g}'
        )
    for name, (unit, least, most) in RANGES.items():
        value = getattr(keys, name)
        if value is not None and not least <= value <= most:
            raise ValueError(
                f"{name} must be given in {unit}, from {least:g} to {most:g}, got {value:g}"
            )
    if bool(keys.matrix) == (keys.vertical_fov is not None):
        came = "both" if keys.matrix else "neither"
        raise ValueError(f"either matrix [px] or vertical_fov [deg] must be given, got {came}")
    width = keys.width
    height = keys.height
    rows = keys.matrix
    if keys.vertical_fov is not None:
        f = 0.5 * height / math.tan(math.radians(keys.vertical_fov) / 2.0)
        rows = ((f, 0.0, width / 2.0), (0.0, f, height / 2.0), (0.0, 0.0, 1.0))
    K = np.zeros((3, 3))
    if [len(row) for row in rows] == [3, 3, 3]:
        K = np.array(rows)
    if K[0, 1] != 0.0 or K[1, 0] != 0.0 or (K[2] != (0.0, 0.0, 1.0)).any():
        raise ValueError(f"matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px, got {rows}")
    min_focal, max_focal = FOCAL
    for focal in (float(K[0, 0]), float(K[1, 1])):
        if not min_focal * width <= focal <= max_focal * width:
            raise ValueError(
                f"matrix: a focal length of {focal:g} px does not fit a width of {width} px; in px it is the "
                "focal length in mm over the side of a pixel in mm"
            )
    size = (width, height)
    principal_point = K[:2, 2]
    came = str(principal_point.tolist())
    if not ((principal_point > 0.0) & (principal_point < size)).all():
        raise ValueError(f"matrix: the principal point {came} px must be in the image")
    if (np.abs(principal_point / size - 0.5) > MAX_OFF).any():
        remark(
            f"matrix: the principal point {came} px is far from the middle of {width} × {height} px; are cx and "
            "cy, or width and height, exchanged?"
        )
    return K


def _lens(keys: CameraFile) -> Lens:
    """Return the model of the lens, a key of `LENSES`, and its coefficients."""
    given = keys.distortion
    values = list(given)
    if isinstance(given, dict):
        values = list(given.values())
    lens = SYNONYMS.get(plain_name(keys.distortion_model))
    if lens is None:
        raise ValueError(
            f"distortion_model {keys.distortion_model!r} is not known; wanted {WANTED}, or none"
        )
    if lens == "none" and any(values):
        raise ValueError(
            f"distortion_model {keys.distortion_model!r} must have no coefficients but 0, got {given}; wanted "
            f"{WANTED}"
        )
    if lens in ("none", "plumb_bob", "rational_polynomial") and not any(values):
        return "plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)
    if isinstance(given, dict):
        return _named_coefficients(lens, given)
    count = len(given)
    if not lens:
        # A file that does not name its model has that of OpenCV with as many coefficients.
        if count == 4 and any(given):
            remark(
                'distortion of four numbers is k1, k2, p1, p2; of a fisheye, write distortion_model = "equidistant"'
            )
        lens = "plumb_bob"
        if any(given[5:]):
            lens = "rational_polynomial"
    wanted = len(LENSES[lens])
    is_cut = count < wanted and any(given[5:])
    is_short = 0 < count < 4 or (lens == "equidistant" and not count)
    if is_cut or is_short or any(given[wanted:]):
        raise ValueError(
            f"distortion must be of {lens} with {', '.join(LENSES[lens])}, got {given}; wanted {WANTED}"
        )
    zeros = (0.0,) * wanted
    return _least_lens(lens, (*given, *zeros)[:wanted])


def _named_coefficients(lens: str, given: Mapping[str, float]) -> Lens:
    """Return the model of the lens, empty where the file does not say it, and coefficients that are given by name."""
    if not lens and {"k4", "k5", "k6"} <= set(given):
        lens = "rational_polynomial"
    lens = lens or "plumb_bob"
    unknown = sorted(name for name, value in given.items() if value and name not in LENSES[lens])
    if unknown:
        raise ValueError(
            f"distortion has no coefficient {unknown[0]!r} in {lens}; wanted distortion_model {WANTED}"
        )
    return _least_lens(lens, tuple(given.get(name, 0.0) for name in LENSES[lens]))


def _least_lens(lens: str, coefficients: tuple[float, ...]) -> Lens:
    """Return a lens of the rational model without denominator as one of the usual model."""
    if lens == "rational_polynomial" and not any(coefficients[5:]):
        return "plumb_bob", coefficients[:5]
    return lens, coefficients


def stretch(coefficients: Sequence[float], s: FloatArray) -> npt.NDArray[np.floating]:
    """Return the factor by which a lens without tangential distortion moves points away from the middle.

    Args:
        coefficients: of one of `LENSES`.
        s: r² [1], for a fisheye θ² [rad²].
    """
    if len(coefficients) == len(LENSES["equidistant"]):
        k1, k2, k3, k4 = coefficients
        return np.polyval([k4, k3, k2, k1, 1.0], s)
    k1, k2, _, _, k3, *others = coefficients
    above = np.polyval([k3, k2, k1, 1.0], s)
    if not others:
        return above
    k4, k5, k6 = others
    return above / np.polyval([k6, k5, k4, 1.0], s)


def turning_point(coefficients: Sequence[float]) -> float:
    """Return the least r² at which the image of a ray no longer moves away from the middle; 1e6 where it always does.

    Args:
        coefficients: of one of `LENSES`.
    """
    if len(coefficients) == len(LENSES["equidistant"]):
        k1, k2, k3, k4 = coefficients
        angle = math.sqrt(_least_root([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0]))
        return math.tan(min(angle, MAX_ANGLE)) ** 2
    k1, k2, _, _, k3, *others = coefficients
    rate = [7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0]
    if not any(others):
        return _least_root(rate)
    # r N / D turns back where (r N)' D − r N D' = 0, with N = 1 + k₁ s + k₂ s² + k₃ s³, D = 1 + k₄ s + k₅ s² + k₆ s³,
    # s = r² and derivatives by r.
    k4, k5, k6 = others
    below = [k6, k5, k4, 1.0]
    below_rate = np.polymul([2.0 * k3, 2.0 * k2, 2.0 * k1, 2.0], [3.0 * k6, 2.0 * k5, k4, 0.0])
    whole_rate = np.polysub(np.polymul(rate, below), below_rate)
    return min(_least_root(below), _least_root(whole_rate))


def _least_root(polynomial: npt.ArrayLike) -> float:
    """Return the least positive root of a polynomial; a million where it has none."""
    roots = np.roots(polynomial)
    is_real = np.abs(roots.imag) < 1e-9 * np.abs(roots)
    positive = roots.real[is_real & (roots.real > 0.0)]
    return float(min(positive, default=ENDLESS))


def _check_distortion(camera: OwnCamera) -> None:
    """Refuse a distortion that folds the image; remark on one that moves points far.

    The image of a fisheye may be a circle that does not reach the corners: its nearest border counts.
    """
    D = camera.distortion
    K = camera.matrix
    keys = camera.keys
    # Distances of the principal point from the further borders, over the focal length
    far_u = max(K[0, 2], keys.width - K[0, 2]) / K[0, 0]
    far_v = max(K[1, 2], keys.height - K[1, 2]) / K[1, 1]
    fisheye = camera.lens == "equidistant"
    turn = turning_point(D)
    last = (1.0 - ROUNDED_ROOT) * turn
    edge = math.hypot(far_u, far_v)
    tangential = 3.0 * math.hypot(*D[2:4])
    if fisheye:
        tangential = 0.0
        edge = min(far_u, far_v, MAX_ANGLE)
        last = math.atan(math.sqrt(last)) ** 2
    reach = math.sqrt(last) * float(stretch(D, np.array(last)))
    if reach < edge and not (fisheye and turn >= ENDLESS):
        raise ValueError(
            f"distortion {list(D)} folds an image of {keys.width} × {keys.height} px before its corners, with "
            "this matrix; take them from one calibration"
        )
    squares = np.linspace(0.0, min(edge**2, last))
    radial = np.abs(stretch(D, squares) - 1.0)
    moved = (radial + tangential * np.sqrt(squares)).max()
    if moved > MAX_MOVED:
        remark(
            f"distortion {list(D)} moves points by {moved:.0%} of their distance from the middle; "
            f"coefficients of OpenCV are no percent, and {', '.join(LENSES[camera.lens])}"
        )


def _check_second(camera: OwnCamera, second: OwnCamera) -> None:
    """Refuse a second camera of a pair whose image, mount or kind of lens is not that of the first."""
    name = camera.keys.second
    first_keys = camera.keys
    second_keys = second.keys
    same_size = (first_keys.width, first_keys.height) == (second_keys.width, second_keys.height)
    if not same_size or first_keys.pose.frame != second_keys.pose.frame:
        raise ValueError(
            f"{name}, the second camera, must have the same width, height and pose.frame"
        )
    if (camera.lens == "equidistant") != (second.lens == "equidistant"):
        raise ValueError(
            f"{name}, the second camera, must be a fisheye (equidistant) where the first is one"
        )
