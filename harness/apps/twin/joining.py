"""A log of streams with stamps of their own: rows of a controller, and frames at their stamps by the joints' clock.

Rows are as far apart as the stamps of the faster stream. A frame stands in the row in which it arrived, and keeps its
stamp, which the fit takes as it is; it counts if joints are logged at every latency that is sought. Commands and
references of a row are those that hold in its middle. Where one clock has recorded both streams, the time from a stamp
to its recording is known for both, so that latency and offset of the clocks are told apart: the latency is then from
exposure to recording, relative to that of joints, and the offset is the latency behind stamps.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.interpolate import PchipInterpolator

from servobench.harness.apps.twin.log import CAPTURED, MAX_LATENCY, Clocks
from servobench.harness.apps.twin.streams import (
    USUAL,
    Stream,
    StreamAbsent,
    StreamMap,
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
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import PlantSpec, column_names
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.mismatch import Mismatch

MAX_OFFSET = 1.0  # [s] between clocks, with the latency, within which it is sought
ROUNDING = 1e-3  # [rows] by which a frame may come after its row


class _Frames(NamedTuple):
    """Frames by the clock of the joints."""

    captured: FloatArray  # stamps, (f,) [s]
    arrived: FloatArray  # (f,) [s]
    values: FloatArray  # (f, m)


def joined(
    files: tuple[Path, Path, Path | None], named: tuple[str, str], controller: str
) -> tuple[ResolvedRun, pd.DataFrame, Clocks]:
    """Return the log of two files: the run that it is taken for, rows with the columns of steps, and its clocks.

    Args:
        files: table or bag with joints, and commands if it has any; the same with features, and references if it has
            any; map of the columns, None for the usual ones.
        named: robot and sensing.
        controller: that is to see the log.

    Raises:
        ConfigurationError: a stream cannot be read, or no frame is within the time of the joints.
        UnevenRows: stamps that are doubled or out of order.
    """
    robot, sensing = named
    model = find_sensing(sensing).nominal(find_robot(robot))
    spec = hand_eye_spec(model, 1.0, 1.0, 1.0)
    joints, features, columns = files
    keys = read_map(columns)
    moved = read_stream(joints, "joints", keys.joints, spec)
    seen = read_stream(features, "features", keys.features, spec)
    clocks, frames = _by_clock_of_joints(moved, seen, same_file=joints.samefile(features))
    period = min(_period(moved.time), _period(frames.captured))
    table = _rows(moved, frames, period, column_names(spec))
    begin, *_, end = moved.time.tolist()
    # A frame counts if joints are logged at every latency that is sought.
    table["feature_valid"] = table[CAPTURED].between(clocks.highest, end - begin + clocks.lowest)
    if not table["feature_valid"].any():
        first = frames.captured[0]
        raise ConfigurationError(
            f"{features} and {joints} do not overlap: features run from {first:.3f} s on, joints from {begin:.3f} "
            f"to {end:.3f} s; if clocks are apart, write offset = … (in s) in [features] of the map"
        )
    middles = begin + table[TIME] + 0.5 * period
    _add_held(table, "commands", joints, keys.commands, spec, middles)
    _add_held(table, "reference", features, keys.reference, spec, middles)
    request = RunRequest(PLANT, controller, TASK, Mismatch(), 0, robot=robot, sensing=sensing)
    settings = Settings({"run": {"period": period}, PLANT: {"command_delay": 0.0}})
    return resolve(request, settings), table, clocks


def _by_clock_of_joints(moved: Stream, seen: Stream, *, same_file: bool) -> tuple[Clocks, _Frames]:
    """Return the clocks of two streams, and frames whose stamps are set on by how much longer they take to a recorder.

    Without times of recording by one clock, stamps stay as they are.
    """
    delay = _delay(moved)
    delivery = _delay(seen) - delay
    if same_file and math.isfinite(delivery):
        frames = _Frames(seen.time + delivery, seen.received - delay, seen.values)
        return Clocks(0.0, MAX_LATENCY, delivery), frames
    return Clocks(-MAX_OFFSET, MAX_OFFSET, None), _Frames(seen.time, seen.time, seen.values)


def _rows(
    moved: Stream, frames: _Frames, period: float, names: Mapping[str, list[str]]
) -> pd.DataFrame:
    """Return rows `period` [s] apart from the first joints on: joints, and frames where they arrived."""
    begin, *_, end = moved.time.tolist()
    time = np.arange(0.0, end - begin, period)
    positions = PchipInterpolator(moved.time - begin, moved.values)(time)
    table = pd.DataFrame(positions, columns=names["joint_position"])
    table.insert(0, TIME, time)
    places = (frames.arrived - begin) / period
    values = _in_rows(places, np.column_stack([frames.values, frames.captured]), len(time))
    table[names["feature"]] = values[:, :-1]
    table[CAPTURED] = values[:, -1] - begin
    return table


def _add_held(
    table: pd.DataFrame,
    kind: str,
    path: Path,
    keys: StreamMap,
    spec: PlantSpec,
    instants: FloatArray,
) -> None:
    """Add a stream that a log may lack, as it holds at instants (k,) [s]; a broken one is named and left out.

    One that the map describes has to be there, and whole.
    """
    try:
        stream = read_stream(path, kind, keys, spec)
    except ConfigurationError as error:
        if keys != StreamMap():
            raise
        if not isinstance(error, StreamAbsent):
            remark(f"{error}; {kind} are left out")
        return
    newest = np.searchsorted(stream.time, instants) - 1
    signal, *_ = USUAL[kind]
    table[column_names(spec)[signal]] = stream.values[np.maximum(newest, 0)]


def _period(stamps: FloatArray) -> float:
    """Return the distance of stamps (k,) of which some may be missing [s]."""
    steps = np.diff(stamps)
    return float(np.sum(steps) / np.rint(steps / np.median(steps)).sum())


def _delay(stream: Stream) -> float:
    """Return how long after its stamp a sample is recorded [s]."""
    return np.median(stream.received - stream.time).item()


def _in_rows(rows: FloatArray, values: FloatArray, count: int) -> FloatArray:
    """Return values (f, m) of frames that arrive at `rows` (f,) in the next whole row, NaN in others, (count, m).

    Where two frames arrive within a row, the second one stands in the next row: its stamp is what counts.
    """
    inside = (rows >= 0.0) & (rows < count)
    number = np.arange(int(inside.sum()))
    place = np.ceil(rows[inside] - ROUNDING)
    place = np.maximum.accumulate(place - number) + number
    fitting = place < count
    found = np.full((count, values.shape[1]), np.nan)
    found[place[fitting].astype(int)] = values[inside][fitting]
    return found
