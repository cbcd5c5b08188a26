"""A log of streams with stamps of their own: rows of a controller, and frames at their stamps by the joints' clock.

Rows are the samples of the joints. Where their stamps jitter about the ticks of an even clock, and the motion is
smoother by this clock than by the stamps, they are taken at its ticks. A frame stands in the row in which it arrived,
and keeps its stamp, which the fit takes as it is. Where one clock has recorded both streams, the delay between a stamp
and its recording is known for both, so that latency and offset of the clocks are told apart:

    latency = exposure → recording of a frame, relative to that of joints;  offset = delivery − latency
"""

import math
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from scipy.interpolate import PchipInterpolator

from servobench.harness.apps.twin.identification import CAPTURED, MAX_LATENCY, Clocks
from servobench.harness.apps.twin.streams import (
    COMMANDS,
    FEATURES,
    JOINTS,
    REFERENCE,
    Stream,
    read_map,
    read_stream,
)
from servobench.harness.batch.logs import PLANT, TASK
from servobench.harness.config.sensing import find_sensing
from servobench.harness.config.settings import Settings
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import ResolvedRun, resolve
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import TIME
from servobench.plant.contract.signals import BoolArray, column_names
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.mismatch import Mismatch

MAX_OFFSET: Final = 1.0  # [s] between clocks, with the latency, within which it is sought
# Joints are not known in a gap longer than this, nor than some samples.
MAX_GAP: Final = 0.1  # [s]
MAX_LOST_SAMPLES: Final = 3.0
FIRST_SAMPLES: Final = 1024  # by which the period of a clock is found
PERIODS: Final = np.linspace(0.9, 1.1, 4001)  # [1] tried periods over the median distance of stamps
# Frames are faster than joints if they are nearer to each other than this share of the joints' period.
FASTER_RATIO: Final = 0.95  # [1]
ROUNDING: Final = 1e-3  # [rows] by which a frame may come after its row


class Joined(NamedTuple):
    """Rows of a log, as of a table with the columns of steps."""

    table: pd.DataFrame
    period: float  # [s]
    clocks: Clocks
    known: BoolArray  # rows with a frame that shows joints within the log at every latency that is sought, (k,)


class _Rows(NamedTuple):
    """The instants of rows, with the joints there."""

    begin: float  # [s] the first instant by the joints' clock
    period: float  # [s]
    joints: FloatArray  # (k, n) [rad]
    gaps: FloatArray  # (g, 2) [s] begin and end of gaps between samples by the joints' clock

    @property
    def edges(self) -> FloatArray:
        """Instants of the rows and the end of the last one by the joints' clock, (k + 1,) [s]."""
        return np.asarray(self.begin + self.period * np.arange(len(self.joints) + 1))


def joined(joints: Path, features: Path, columns: Path | None, named: tuple[str, str]) -> Joined:
    """Return the log of two files.

    Args:
        joints: table or bag with joint positions, and commands if it has any.
        features: table or bag with features, and references if it has any.
        columns: map of the columns or topics; None for the usual ones.
        named: robot and sensing.

    Raises:
        ConfigurationError: a stream cannot be read, or no frame is within the time of the joints.
        UnevenRows: stamps that are doubled or out of order.
    """
    robot, sensing = named
    model = find_sensing(sensing).nominal(find_robot(robot))
    spec = hand_eye_spec(model, period=1.0, max_joint_speed=1.0, joint_range=1.0)
    keys = read_map(columns)
    moved = read_stream(joints, JOINTS, keys.joints, spec)
    seen = read_stream(features, FEATURES, keys.features, spec)
    same_clock = joints.samefile(features) or bool(keys.joints.received and keys.features.received)
    is_recorded = np.isfinite(moved.received).all() and np.isfinite(seen.received).all()
    if same_clock and is_recorded:
        delay = _delay(moved)
        clocks = Clocks(0.0, MAX_LATENCY, _delay(seen) - delay)
        arrived = seen.received - delay
        captured = seen.time + _delay(seen) - delay
    else:
        clocks = Clocks(-MAX_OFFSET, MAX_OFFSET, None)
        arrived = seen.time
        captured = seen.time
    rows = _rows(moved, float(np.median(np.diff(captured))))
    end = rows.edges[-1]
    if not ((captured >= rows.begin) & (captured <= end)).any():
        span = f"from {captured[0]:.3f} to {captured[-1]:.3f} s, joints from {rows.begin:.3f} to {end:.3f} s"
        remedy = "if their clocks are apart, write offset = … (in s, added to stamps) in [features] of the map"
        raise ConfigurationError(
            f"{features} and {joints} do not overlap: features run {span}; {remedy}"
        )
    names = column_names(spec)
    table = pd.DataFrame(rows.joints, columns=names["joint_position"])
    table.insert(0, TIME, rows.edges[:-1] - rows.begin)
    frames = _in_rows(rows, arrived, np.column_stack([seen.values, captured]))
    table[names["feature"]] = frames[:, :-1]
    table["feature_valid"] = np.isfinite(frames[:, -1])
    table[CAPTURED] = frames[:, -1] - rows.begin
    commands = read_stream(joints, COMMANDS, keys.commands, spec)
    if commands.time.size:
        since = np.where(
            np.isfinite(commands.received), commands.received - _delay(moved), commands.time
        )
        table[names[COMMANDS.column]] = _means(rows, since, commands.values)
    reference = read_stream(features, REFERENCE, keys.reference, spec)
    if reference.time.size:
        newest = (
            np.searchsorted(reference.time, rows.edges[:-1] + ROUNDING * rows.period, side="right")
            - 1
        )
        table[names[REFERENCE.column]] = reference.values[np.maximum(newest, 0)]
    return Joined(table, rows.period, clocks, _are_known(rows, frames[:, -1], clocks))


def run_of_rows(period: float, controller: str, named: tuple[str, str]) -> ResolvedRun:
    """Return the run of a controller with a period [s], on robot and sensing as `named`, for which a log is taken."""
    robot, sensing = named
    request = RunRequest(PLANT, controller, TASK, Mismatch(), 0, robot=robot, sensing=sensing)
    return resolve(request, Settings({"run": {"period": period}, PLANT: {"command_delay": 0.0}}))


def _delay(stream: Stream) -> float:
    """Return how long after its stamp a sample is recorded [s]."""
    return float(np.median(stream.received - stream.time))


def _rows(moved: Stream, frame_period: float) -> _Rows:
    """Return rows at the period of the joints, or at a part of it where frames come faster [s]."""
    time = moved.time
    period = float(np.median(np.diff(time)))
    even = _even_clock(time)
    if even is not None:
        ticks, even_period = even
        if _roughness(ticks, moved.values) <= _roughness(time, moved.values):
            time = ticks
            period = even_period
    steps = np.diff(time)
    lost = np.flatnonzero(steps > max(MAX_GAP, MAX_LOST_SAMPLES * period))
    gaps = np.stack([time[lost], time[lost + 1]], axis=1)
    period /= max(1, math.ceil(FASTER_RATIO * period / frame_period))
    count = math.floor((time[-1] - time[0]) / period + ROUNDING) + 1
    instants = np.minimum(time[0] + period * np.arange(count), time[-1])
    joints = PchipInterpolator(time, moved.values)(instants)
    return _Rows(float(time[0]), period, joints, gaps)


def _even_clock(stamps: FloatArray) -> tuple[FloatArray, float] | None:
    """Return the ticks of an even clock behind stamps (k,) and its period [s]; None if two stamps share a tick.

    The period is that of the strongest line in the spectrum of the first stamps, Σ exp(2πi t/T), which jitter and
    losses hardly move. It is then fitted to more and more samples, so that no number of a tick is in doubt.
    """
    since = stamps - stamps[0]
    first = since[:FIRST_SAMPLES]
    tried = float(np.median(np.diff(since))) * PERIODS
    lines = np.exp(2j * np.pi * first / tried[:, None]).mean(axis=1)
    strongest = int(np.abs(lines).argmax())
    period = float(tried[strongest])
    begin = float(np.angle(lines[strongest])) / (2.0 * np.pi) * period
    size = min(FIRST_SAMPLES, len(since))
    numbers = np.rint((since - begin) / period)
    while np.ptp(numbers[:size]) > 0.0:
        period, begin = np.polyfit(numbers[:size], since[:size], 1).tolist()
        numbers = np.rint((since - begin) / period)
        if size == len(since):
            break
        size = min(2 * size, len(since))
    if (np.diff(numbers) < 1.0).any():
        return None
    return stamps[0] + begin + period * numbers, period


def _roughness(time: FloatArray, values: FloatArray) -> float:
    """Return how far every second sample is from the curve through the others, in the median [rad]."""
    if len(time) < 5:
        return 0.0
    curve = PchipInterpolator(time[::2], values[::2])
    inner = slice(1, 2 * ((len(time) - 1) // 2), 2)
    return float(np.median(np.abs(curve(time[inner]) - values[inner]).max(axis=1)))


def _in_rows(rows: _Rows, arrived: FloatArray, values: FloatArray) -> FloatArray:
    """Return values (f, m) of frames in the rows at which they are there, NaN in others, (k, m).

    Where two frames arrive within a row, the second one stands in the next row: its stamp is what counts.
    """
    place = np.ceil((arrived - rows.begin) / rows.period - ROUNDING)
    inside = (place >= 0.0) & (place < len(rows.joints))
    number = np.arange(int(inside.sum()))
    place = np.maximum.accumulate(place[inside] - number) + number
    fitting = place < len(rows.joints)
    found = np.full((len(rows.joints), values.shape[1]), np.nan)
    found[place[fitting].astype(int)] = values[inside][fitting]
    return found


def _means(rows: _Rows, since: FloatArray, commands: FloatArray) -> FloatArray:
    """Return the mean of commands (c, n), each of which is in force until the next, in each row, (k, n)."""
    edges = rows.edges
    ends = np.append(since[1:], max(edges[-1], since[-1]))
    turned = np.cumsum((ends - since)[:, None] * commands, axis=0)
    knots = np.append(since, ends[-1])
    total = np.concatenate([np.zeros((1, commands.shape[1])), turned])
    at_edges = np.stack([np.interp(edges, knots, each) for each in total.T], axis=1)
    return np.asarray(np.diff(at_edges, axis=0) / rows.period)


def _are_known(rows: _Rows, captured: FloatArray, clocks: Clocks) -> BoolArray:
    """Return which frames show joints within the log, and in no gap, at every latency that is sought, (k,)."""
    first = captured - clocks.highest
    last = captured - clocks.lowest
    known = (first >= rows.begin) & (last <= rows.edges[-1])
    for begin, end in rows.gaps:
        known &= (last < begin) | (first > end)
    return np.asarray(known)
