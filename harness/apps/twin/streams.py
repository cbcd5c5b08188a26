"""Streams of a log as they were recorded: joints, features, commands and references, each with stamps of its own.

A stream lies in a table (CSV, Parquet) or is a topic of a bag: an MCAP file, a rosbag2 folder or its .db3, a .bag of
ROS 1. rosbags reads all of these without ROS, message by message, so that a bag may be larger than the memory. A
message becomes a row of a table, so that one path leads on from both.
"""

import struct
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from servobench.harness.batch.logs import PER_SECOND, TABLES, UnevenRows
from servobench.harness.config.installation import check_installed
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import TIME, numbers_of, read_table, read_toml
from servobench.plant.contract.settings import Number, nested, override, settings, suggest
from servobench.plant.contract.signals import COMMAND, PlantSpec, column_names

RECEIVED = "received"  # column with the times of recording
STAMP = "header.stamp"
VALID = "feature_valid"  # column of a table, 0 in rows without a new frame
NANOSECOND = 1e-9  # [s]
MAX_PARTS = 64  # entries of a list in a message that may be values; images have more
STEPS = (1e-5, 5.0)  # [s] Usual distance of stamps, beyond which they are likely in another unit.
# [s] Longest gaps of a recording without a pause, if they are longer than MAX_LOST usual steps: between joints these
# are interpolated, and a ball may be hidden for a while.
MAX_GAPS = {"joints": 0.2, "features": 60.0}
MAX_LOST = 10.0
FAULTS = (struct.error, TypeError, KeyError, EOFError, RuntimeError, OSError)
"""Errors of rosbags about a damaged bag, beside its own."""


@settings
class StreamMap:
    """Where the values of a stream are, and its stamps."""

    topic: str = ""
    """Of a bag; empty for the usual one, such as /joint_states."""
    time: str = ""
    """Field or column of the stamps; empty for header.stamp, received (when a message was recorded) or time_s."""
    unit: Literal["s", "ms", "µs", "ns"] = "s"
    """Of stamps that are numbers."""
    fields: tuple[str, ...] = ()
    """Fields, such as point.x or data.0, or columns, in the order of joints or features; empty for the usual ones."""
    scale: Number = 1.0
    """[1] by which values are multiplied, such as 0.001 for features in mm."""
    offset: Number = 0.0
    """[s] that is added to stamps."""


@settings
class LogMap:
    """The content of a map of columns."""

    joints: StreamMap = nested(StreamMap)
    """Joint positions; joints that are called otherwise than those of the robot are listed in `fields`."""
    features: StreamMap = nested(StreamMap)
    """Features, in the file of features."""
    commands: StreamMap = nested(StreamMap)
    """Commanded joint velocities, in the file of joints; a log may have none."""
    reference: StreamMap = nested(StreamMap)
    """References, in the file of features; `shadow` alone needs them."""


PLACE = ("point.x", "point.y", "point.z")
SPEEDS = tuple(f"data.{i}" for i in range(MAX_PARTS))
COMMAND_TOPIC = "/forward_velocity_controller/commands"
USUAL = {  # stream -> its kind of columns in a table of steps, its topic, and fields of its messages
    "joints": ("joint_position", "/joint_states", ()),
    "features": ("feature", "/feature", PLACE),
    "commands": (COMMAND, COMMAND_TOPIC, SPEEDS),
    "reference": ("reference", "/reference", PLACE),
}


class StreamAbsent(ConfigurationError):
    """A file has no such stream at all."""


class Stream(NamedTuple):
    """Values with their stamps."""

    time: FloatArray  # stamps, (k,) [s]
    received: FloatArray  # when they were recorded, (k,) [s]; NaN where that is not known
    values: FloatArray  # (k, m)


def read_map(path: Path | None) -> LogMap:
    """Return a map of columns; the usual one without a file.

    Raises:
        ConfigurationError: it cannot be read, or has an unknown key.
    """
    if path is None:
        return LogMap()
    with configuration_errors():
        return override(f"map {path}", LogMap(), read_toml("map", path))


def read_stream(path: Path, kind: str, keys: StreamMap, spec: PlantSpec) -> Stream:
    """Return a stream of a file; messages without its fields, such as of a gripper among joints, are left out.

    Args:
        path: a table or a bag.
        kind: a key of `USUAL`.
        keys: its section of the map.
        spec: of the robot: names and numbers of joints and features.

    Raises:
        StreamAbsent: the bag has no such topic, or the table none of the columns.
        ConfigurationError: file, field, column or joint cannot be found or read.
        UnevenRows: stamps that are doubled or out of order.
    """
    if not path.exists():
        raise ConfigurationError(f"{path} does not exist; wanted a table or a bag")
    what = f"{kind} of {path}"
    signal, topic, of_messages = USUAL[kind]
    is_table = path.suffix.lower() in TABLES
    table = read_table(kind, path) if is_table else _read_topic(path, keys.topic or topic)
    names = column_names(spec)[signal]
    usual = [names, of_messages[: len(names)]]
    if kind == "joints":
        usual += [spec.joint_names, [f"{joint}_joint" for joint in spec.joint_names]]
    found = (list(each) for each in usual if each and set(each) <= set(table))
    columns = list(keys.fields) or next(found, names)
    stamps = keys.time or next((each for each in (STAMP, RECEIVED) if each in table), TIME)
    lacking = [each for each in (stamps, *columns) if each not in table]
    if len(columns) != len(names):
        lacking = [f"{len(names)} fields of values"]
    if lacking:
        known = suggest(lacking[0], map(str, table))
        fault = ConfigurationError
        if is_table and set(columns).isdisjoint(table):
            fault = StreamAbsent
        raise fault(
            f"{what} has no {lacking[0]}; name topic, time and fields in [{kind}] of the map: {known}"
        )
    table = table[table[columns].notna().all(axis=1)]
    if kind == "features" and VALID in table:
        table = table[table[VALID].astype(bool)]
    time = keys.offset + _seconds(what, table, stamps, keys.unit)
    _check_order(what, time)
    _check_gaps(what, time, MAX_GAPS.get(kind, np.inf))
    received = np.full(len(table), np.nan)
    if RECEIVED in table:
        received = _seconds(what, table, RECEIVED, keys.unit)
        _check_unit(f"{what}, {RECEIVED}", received)
    return Stream(time, received, keys.scale * numbers_of(what, table, columns))


def _seconds(what: str, table: pd.DataFrame, column: str, unit: str) -> FloatArray:
    """Return the stamps of a column: numbers in a unit, dates, or texts as ISO 8601 has them, (k,) s."""
    stamps = table[column]
    if stamps.dtype.kind not in "iuf":
        with configuration_errors(f"{what}: {column} is neither numbers nor dates of ISO 8601: "):
            dates = pd.to_datetime(stamps, utc=True, format="ISO8601")
        return np.asarray((dates - pd.Timestamp(0, tz="UTC")).dt.total_seconds())
    return numbers_of(what, table, [column])[:, 0] / PER_SECOND.get(unit, 1.0)


def _check_order(what: str, time: FloatArray) -> None:
    """Refuse stamps that do not grow, are too few, or are likely in another unit."""
    steps = np.diff(time)
    grows = np.append(steps > 0.0, steps.size > 0)
    if not grows.all():
        remedy = f"sort two or more, leave out doubled ones, or take others, such as {RECEIVED}"
        raise UnevenRows(
            f"{what}: stamp {np.argmin(grows) + 1} of {len(time)} is not later than the one before: {remedy}"
        )
    _check_unit(what, time)


def _check_unit(what: str, time: FloatArray) -> None:
    """Refuse stamps that are likely in another unit."""
    usual = np.median(np.diff(time))
    least, most = STEPS
    if not least <= usual <= most:
        remedy = 'write their unit, such as unit = "ns" or "s", in the map'
        raise ConfigurationError(f"{what}: stamps are {usual:.4g} s apart; {remedy}")


def _check_gaps(what: str, time: FloatArray, most: float) -> None:
    """Refuse a pause of the recording, over which joints would be guessed and frames would count as lost."""
    steps = np.diff(time)
    place = steps.argmax()
    if steps[place] > max(most, MAX_LOST * np.median(steps)):
        raise ConfigurationError(
            f"{what}: none for {steps[place]:.4g} s after stamp {place + 1}, as where a recording pauses or a clock "
            "is set: cut the log there"
        )


def _read_topic(path: Path, topic: str) -> pd.DataFrame:
    """Return a table with a row a message of a topic, and a column a field."""
    check_installed(("rosbags",), f"the bag {path}")
    from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 - of the extra bag
    from rosbags.highlevel.anyreader import ReaderErrors  # noqa: PLC0415 - likewise
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - likewise

    rows = []
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
            chosen = [each for each in bag.connections if each.topic == topic]
            if not chosen:
                known = suggest(topic, bag.topics)
                raise StreamAbsent(f"{path} has no topic {topic}; name it in the map: {known}")
            for connection, received, raw in bag.messages(connections=chosen):
                message = bag.deserialize(raw, connection.msgtype)
                rows.append({**dict(_flat("", message)), RECEIVED: NANOSECOND * received})
    except (AnyReaderError, *ReaderErrors, *FAULTS) as error:
        raise ConfigurationError(
            f"{path} cannot be read as a bag ({type(error).__name__}: {error}); wanted a finished MCAP file, a "
            "rosbag2 folder, .db3 or .bag; `mcap recover` repairs one"
        ) from error
    table = pd.DataFrame(rows)
    if STAMP in table:  # a publisher may repeat a message, as a robot does that waits in lockstep
        table = table.drop_duplicates([name for name in table if name != RECEIVED])
    return table


def _flat(name: str, value: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401 - any part of a message
    """Yield the numbers of a message by their paths, such as point.x, and positions of joints by the joints' names."""
    if hasattr(value, "nanosec"):
        yield name, value.sec + NANOSECOND * value.nanosec
    elif hasattr(value, "position") and hasattr(value, "name"):
        yield from _flat("header", value.header)
        # A gripper may tell names without positions.
        yield from zip(value.name, value.position.tolist(), strict=False)
    elif is_dataclass(value):
        for each in fields(value):
            yield from _flat(f"{name}.{each.name}".lstrip("."), getattr(value, each.name))
    elif isinstance(value, list | np.ndarray):
        for i, part in enumerate(value[:MAX_PARTS]):
            yield from _flat(f"{name}.{i}", part)
    elif isinstance(value, int | float | np.number):
        yield name, value
