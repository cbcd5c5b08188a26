"""The rows of a log: time, joints, frames and commands as arrays, and mistakes that can be seen in them."""

import sys
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import numbers_of
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import COMMAND, BoolArray, PlantSpec, column_names

LOG = "the log"  # in error messages
VELOCITY = COMMAND.removesuffix("_command")  # as commands are misnamed
CAPTURED = "capture_time_s"  # column with the stamps of frames
MAX_LATENESS_RANGE = (
    2.0  # [s] between the latest and the earliest stamped frame, by the rows' clock
)
MAX_CLOCK_DRIFT = 0.02  # [s/s] by which the clock of a camera may drift
MAX_LATENCY = 0.25  # [s]
MIN_FRAMES = 50
MAX_OFF_TURN = 1.0  # [rad] A joint is wrapped if it jumps by 2π to within this.
# A motion from row to row is a jump if it is faster than this many speed limits, and JUMP_STEP more.
JUMP_SPEED = 1.5  # [1]
JUMP_STEP = 0.05  # [rad]
# A change of a feature is large if it exceeds its least change, such as one pixel, by this factor.
LARGE_CHANGE_RATIO = 2.5  # [1]
MAX_REPEATED = 0.01  # [1] share of frames that equal another one although the arm moves
MIN_JOINT_STEP = 1e-4  # [rad] between two frames of an arm that moves


class Clocks(NamedTuple):
    """Clocks of a log whose frames are stamped by a clock of known or sought offset to that of the joints."""

    # Latencies among which that behind stamps is sought [s]; a negative one is an offset of clocks, too.
    lowest: float
    highest: float
    # [s] By how much longer frames take from stamp to recording than joints; None where one clock did not record both.
    delivery: float | None


class Log(NamedTuple):
    """Rows of a log."""

    spec: PlantSpec
    time: FloatArray  # (k,) [s]
    joints: FloatArray  # (k, n) [rad]
    features: FloatArray  # (k, m) [unit of the feature]
    valid: BoolArray  # (k,) whether a row has a new frame
    # (k, n) [rad/s], each from its row to the next; velocities of the joints are those of a spline
    commands: FloatArray | None
    captured: (
        FloatArray  # (k,) [s] when frames were exposed by the camera's clock; NaN without a stamp
    )
    clocks: Clocks | None = (
        None  # None for stamps whose offset to the rows is that of the mean frame
    )

    @property
    def stamped(self) -> BoolArray:
        """Which rows have a new frame with a stamp, (k,)."""
        return self.valid & np.isfinite(self.captured)

    @property
    def lateness(self) -> FloatArray:
        """By how much each stamped frame came later than they do in the mean, (k,) [s]; 0 for others.

        The mean takes the unknown offset of the camera's clock away; its drift is a parameter (`drift`). Where clocks
        are given, nothing is taken away: the offset is part of the latency.
        """
        stamped = self.stamped
        if not stamped.any():
            return np.zeros(len(self.time))
        late = self.time - self.captured
        usual = 0.0 if self.clocks else np.mean(late[stamped])
        return np.where(stamped, late - usual, 0.0)

    @property
    def frame_time(self) -> FloatArray:
        """When frames came, or by their stamps would have at the mean latency; with clocks their stamps, (k,) [s]."""
        return self.time - self.lateness

    def farthest_joint(self) -> tuple[float, str]:
        """Return how far a joint is beyond its range at most [rad], and where that is."""
        q = self.joints
        lower = self.spec.joint_lower
        upper = self.spec.joint_upper
        beyond = np.maximum(q - upper, lower - q)
        row, joint = np.unravel_index(int(beyond.argmax()), q.shape)
        name = self.spec.joint_names[joint]
        place = f"row {row} of the log has {name} at {q[row, joint]:.4g} rad"
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
        jumps = np.abs(np.diff(self.joints, axis=0, prepend=self.joints[:1]))
        limits = self.spec.joint_velocity_limit
        farthest = JUMP_SPEED * limits * self.spec.period + JUMP_STEP
        beyond = np.argwhere(jumps > farthest).tolist()
        if not beyond:
            return "", False
        turns = np.abs(jumps - 2.0 * np.pi) <= MAX_OFF_TURN
        # The maximum of truth values is the first turn, or the first jump where none is a turn.
        row, joint = max(beyond, key=lambda place: turns[*place])
        name = self.spec.joint_names[joint]
        where = f"joint {name} jumps by {jumps[row, joint]:.4g} rad in row {row}"
        if turns[row, joint]:
            return f"{where}, as it is wrapped at ±π: unwrap it (numpy.unwrap)", True
        remedy = "interpolate lost or held positions, or cut there"
        return f"{where}, above {limits[joint]:.3g} rad/s: {remedy}", False

    def frame_mistake(self) -> str:
        """Name frames given as new that equal the one before, or are all the same, although the arm moves."""
        rows = frames_of(self)
        repeated = _repeated(self.features[rows])
        joint_steps = np.abs(np.diff(self.joints[rows], axis=0)).max(axis=1)
        moving = joint_steps > MIN_JOINT_STEP
        if not moving.any():
            return ""
        share = float(np.mean(repeated[moving]))
        if share <= MAX_REPEATED:
            return ""
        first = rows[1:][repeated & moving][0]
        found = f"{share:.0%} of the frames repeat another one although the arm moves"
        return f"{found}, first in row {first}: give rows without a new frame feature_valid = 0"


def _repeated(features: FloatArray) -> BoolArray:
    """Return which features (k, m), from the second one on, stand for no frame: (k − 1,).

    A held feature equals the one before, and a placeholder, such as 0, comes again and again. A coarse detector repeats
    features, too, but changes by its least step only; so there has to be a large change before or after.
    """
    steps = np.diff(features, axis=0)
    changed = steps.any(axis=1)
    changes = steps[changed]  # (c, m)
    sizes = np.abs(changes)
    least = sizes.min(axis=0, initial=np.inf, where=changes != 0.0)
    large = (sizes > LARGE_CHANGE_RATIO * least).any(axis=1)
    # Index i of the arrays of length c + 1 is the run of equal features after i changes.
    beside_large = np.append(False, large) | np.append(large, True)
    runs = np.cumsum(changed)
    # Features leave for a placeholder and come back, as they do not in laps.
    returned = np.linalg.norm(changes[:-1] + changes[1:], axis=1)
    back = returned < 0.5 * np.linalg.norm(changes[1:], axis=1)
    left_and_back = np.pad(back, 1)
    _, kinds, counts = np.unique(features, axis=0, return_inverse=True, return_counts=True)
    is_frequent = counts > max(2, MAX_REPEATED * len(features))
    placeholder = is_frequent[kinds[1:]] & left_and_back[runs]
    return (~changed | placeholder) & beside_large[runs]


def read_log(
    spec: PlantSpec, table: pd.DataFrame, least: int = MIN_FRAMES, clocks: Clocks | None = None
) -> Log:
    """Return the rows of a table with columns as `steps.parquet` has them, `spec.period` apart.

    Raises:
        ConfigurationError: a column or a number is missing, or fewer than `least` frames are valid.
    """
    names = column_names(spec)
    rows = np.arange(len(table))
    # A log may leave the features of a row without a new frame empty; their neighbours' stand in for them.
    frames = table.filter(names["feature"])
    lost = frames.isna().all(axis=1)
    filled = frames.where(~lost, frames.ffill().bfill(), axis=0)
    table = table.assign(**filled)
    joints = numbers_of(LOG, table, names["joint_position"])
    features = numbers_of(LOG, table, names["feature"])
    marked = np.ones(len(rows))
    if "feature_valid" in table:
        marked = numbers_of(LOG, table, ["feature_valid"])[:, 0]
    valid = (marked != 0.0) & ~lost.to_numpy()
    time = np.asarray(spec.period * rows)
    commands = None
    lacking = [name for name in names[COMMAND] if name not in table]
    if not lacking:
        commands = numbers_of(LOG, table, names[COMMAND])
    elif any(str(name).startswith(VELOCITY) for name in table):
        missing = ", ".join(lacking)
        remark(f"the log has columns {VELOCITY}_… but no {missing}: commands are left out")
    log = Log(spec, time, joints, features, valid, commands, _stamps(table), clocks)
    _check_clock(log)
    count = len(frames_of(log))
    if count < least:
        after = f"after the first {MAX_LATENCY:g} s"
        wanted = f"wanted {least} or more"
        raise ConfigurationError(f"the log has {count} valid frames {after}; {wanted}")
    return log


def _stamps(table: pd.DataFrame) -> FloatArray:
    """Return the stamps of the frames of rows, (k,) [s]; NaN for none."""
    if CAPTURED not in table:
        return np.full(len(table), np.nan)
    given = table[CAPTURED].notna().to_numpy()
    filled = table.assign(**{CAPTURED: table[CAPTURED].where(given, 0.0)})
    return np.where(given, numbers_of(LOG, filled, [CAPTURED])[:, 0], np.nan)


def _check_clock(log: Log) -> None:
    """Refuse stamps that run faster or slower than the rows, as in another unit."""
    stamped = log.stamped
    if not stamped.any():
        return
    rows = float(np.ptp(log.time[stamped]))
    stamps = float(np.ptp(log.captured[stamped]))
    if np.ptp(log.lateness[stamped]) > MAX_LATENESS_RANGE + MAX_CLOCK_DRIFT * rows:
        raise ConfigurationError(
            f"{CAPTURED} of {LOG} runs {stamps:.4g} s while its rows run {rows:.4g} s: write stamps in seconds"
        )


def frames_of(log: Log, most: int = sys.maxsize) -> Any:  # noqa: ANN401 - of indices
    """Return the rows of frames that were exposed within the log at any latency: `most` at most, equally spaced."""
    rows = np.flatnonzero(log.valid & (log.frame_time >= log.time[0] + MAX_LATENCY))
    stride = -(-len(rows) // most)  # rounded up
    return rows[:: max(1, stride)]
