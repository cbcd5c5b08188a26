"""Units and axes of a log: whether its joints, features and references can be those of a robot."""

import numpy as np

from servobench.controllers.algebra import nearest_rotation
from servobench.harness.apps.twin.log import Log
from servobench.harness.apps.twin.predictions import MAX_LATE, rms
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import Channel
from servobench.plant.robot.hand_eye import RobotModel

MAX_EXCESS = 0.1  # [rad] by which a joint may be beyond its range without a remark
MAX_FEATURE = 20.0  # [m] largest feature that a camera may see, in natural units
# Noise may be larger than a motion whose RMS distance from the mean is below this.
MIN_MOTION = 0.02  # [m]
# A mirrored motion can be told from a turned one if its second direction has this share of the first one's size.
MIN_SECOND_DIRECTION = 0.1  # [1]
# Share of the motion that the model may leave unexplained without a remark, by unit.
MAX_UNEXPLAINED = {"m": 0.2, "px": 0.35}
# Pixels have no usual size, so an affine map explains any small motion: the model's must not be larger by this factor.
MAX_MOTION_RATIO = 8.0  # [1]


def check_units(log: Log, reference: FloatArray, model: RobotModel | None) -> None:
    """Refuse joints and features that no robot of this kind has, and remark on features that move otherwise.

    Args:
        log: the log.
        reference: that of the log, (k, m).
        model: the robot that was logged; None where it is unknown.

    Raises:
        ConfigurationError: names the row, and the unit in which the log has to be.
    """
    mistake = log.joint_mistake()
    if mistake:
        raise ConfigurationError(mistake)
    excess, where = log.farthest_joint()
    if excess > MAX_EXCESS:
        remark(where)
    jump, _ = log.first_jump()
    if jump:
        remark(jump)
    repeated = log.frame_mistake()
    if repeated:
        remark(repeated)
    channel = log.spec.feature
    _check_size(channel, "feature", log.features)
    _check_size(channel, "reference", reference)
    if model is not None and log.valid[MAX_LATE:].any():
        _check_motion(log, model)


def _check_size(channel: Channel, kind: str, values: FloatArray) -> None:
    """Refuse features or references (k, m) that are larger than any camera sees."""
    unit = channel.unit
    sizes = np.abs(values).max(axis=1)
    size = float(sizes.max())
    if unit not in ("m", "px") or size <= MAX_FEATURE * channel.scale:
        return
    row = int(sizes.argmax())
    found = f"row {row} of the log has a {kind} of {size:g} {unit}, beyond any camera"
    if unit == "m":
        found += "; if the log is in mm, write it in m"
    raise ConfigurationError(found)


def _check_motion(log: Log, model: RobotModel) -> None:
    """Remark on features that are no late image of a model's at these joints: turned, or affine of pixels."""
    channel = log.spec.feature
    valid = log.valid
    features = log.features / channel.scale
    modelled = model.feature(log.joints) / channel.scale
    fits = []
    for late in range(min(MAX_LATE, len(features) // 2)):
        # A feature shows the joints of `late` rows before.
        rows = len(features) - late
        known = valid[late:]
        fits.append(_image_fit(features[late:][known], modelled[:rows][known], channel.unit))
    unexplained, mirrored = min(fits)
    if unexplained > MAX_UNEXPLAINED.get(channel.unit, MAX_UNEXPLAINED["px"]):
        remark(
            f"features of the log move otherwise than this robot's at these joints, by {unexplained:.0%}: look "
            "for other units, another order or sign of joints, another arm, or a camera that was moved"
        )
    elif mirrored:
        remark("features of the log are mirrored: x points right in the image, y down, z ahead")


def _image_fit(y: FloatArray, p: FloatArray, unit: str) -> tuple[float, bool]:
    """Return the share of the motion of features (k, m) that no image of p explains, or 0, and if y is mirrored.

    The image of places is a rotation, and that of pixels an affine map.
    """
    y = y - y.mean(axis=0)
    p = p - p.mean(axis=0)
    motion = rms(y)
    motion_of_model = rms(p)
    if max(motion, motion_of_model) < MIN_MOTION:
        return 0.0, False
    if unit == "m":
        image = nearest_rotation(y.T @ p).T
        whole = max(motion, motion_of_model)
    else:
        if MAX_MOTION_RATIO * motion < motion_of_model:
            return 1.0, False
        affine, *_ = np.linalg.lstsq(p, y, rcond=None)
        image = np.asarray(affine, dtype=np.float64)
        whole = motion
    rest = rms(y - p @ image)
    sizes = np.linalg.svd(y.T @ p, compute_uv=False)
    has_sides = len(sizes) in (2, 3) and sizes[1] > MIN_SECOND_DIRECTION * sizes[0]
    mirrored = has_sides and np.linalg.det(image[:2, :2]) < 0.0
    return rest / whole, bool(mirrored)
