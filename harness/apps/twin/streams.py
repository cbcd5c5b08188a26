"""Streams of a log as they were recorded: joints, features, commands and references, each with stamps of its own.

A stream lies in a table (CSV, Parquet) or is a topic of a bag: an MCAP file, a rosbag2 folder or its .db3, a .bag of
ROS 1. rosbags reads all of these without ROS, message by message, so that a bag may be larger than the memory.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, NoReturn

import numpy as np
import pandas as pd

from servobench.harness.batch.logs import PER_SECOND, TABLES, UnevenRows
from servobench.harness.config.installation import check_installed
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import TIME, numbers_of, read_table, read_toml
from servobench.plant.contract.settings import (
    Number,
    listed,
    nested,
    override,
    settings,
    suggest,
)
from servobench.plant.contract.signals import COMMAND, PlantSpec, column_names

RECEIVED: Final = (
    "received"  # in place of a field with stamps: the time at which a message was recorded
)
STAMP: Final = "header.stamp"
NANOSECOND: Final = 1e-9  # [s]
MAX_STEP: Final = 5.0  # [s] usual distance of stamps, above which they are likely in another unit
DAMAGED: Final = (struct.error, TypeError, KeyError, EOFError, RuntimeError, OSError)
"""Errors of rosbags about a damaged bag, beside its own."""


@settings
class StreamMap:
    """Where the values of a stream are, and its stamps."""

    topic: str = ""
    """Of a bag; empty for the usual one, such as /joint_states."""
    time: str = ""
    """Field or column of the stamps, or "received" for the times of recording; empty for header.stamp or time_s."""
    unit: Literal["s", "ms", "µs", "ns"] = "s"
    """Of stamps that are numbers."""
    received: str = ""
    """Column of a table with the times of recording, by the same clock for every stream; a bag has its own."""
    fields: tuple[str, ...] = ()
    """Fields, such as point.x or data.0, or columns, in the order of joints or features; empty for the usual ones."""
    names: dict[str, str] = nested(dict)
    """Names that joints of the robot have in messages or columns; others are found by their own names."""
    scale: Number = 1.0
    """[1] by which values are multiplied, such as 0.001 for features in mm."""
    offset: Number = 0.0
    """[s] that is added to stamps."""


@settings
class LogMap:
    """The content of a map of columns."""

    joints: StreamMap = nested(StreamMap)
    """Joint positions."""
    features: StreamMap = nested(StreamMap)
    """Features, in the file of features."""
    commands: StreamMap = nested(StreamMap)
    """Commanded joint velocities, in the file of joints; a log may have none."""
    reference: StreamMap = nested(StreamMap)
    """References, in the file of features; `shadow` alone needs them."""


class Kind(NamedTuple):
    """A kind of stream, with what is usual for it."""

    name: str  # a section of the map
    column: str  # its kind of columns in a table of steps
    topic: str
    message_fields: tuple[str, ...]
    needed: bool


PLACE: Final = ("point.x", "point.y", "point.z")
JOINTS: Final = Kind("joints", "joint_position", "/joint_states", (), needed=True)
FEATURES: Final = Kind("features", "feature", "/feature", PLACE, needed=True)
REFERENCE: Final = Kind("reference", "reference", "/reference", PLACE, needed=False)
COMMANDS: Final = Kind(
    "commands", COMMAND, "/forward_velocity_controller/commands", (), needed=False
)


class Stream(NamedTuple):
    """Values with their stamps."""

    time: FloatArray  # stamps, (k,) [s]
    received: FloatArray  # when they were recorded, (k,) [s]; NaN where that is not known
    values: FloatArray  # (k, m), NaN for none


def read_map(path: Path | None) -> LogMap:
    """Return a map of columns; the usual one without a file.

    Raises:
        ConfigurationError: it cannot be read, or has an unknown key.
    """
    if path is None:
        return LogMap()
    with configuration_errors():
        return override(f"map {path}", LogMap(), read_toml("map", path))


def read_stream(path: Path, kind: Kind, keys: StreamMap, spec: PlantSpec) -> Stream:
    """Return a stream of a file; without samples if it is not there and may be missing.

    Args:
        path: a table or a bag.
        kind: of the stream.
        keys: its section of the map.
        spec: of the robot: names and numbers of joints and features.

    Raises:
        ConfigurationError: file, topic, field, column or joint cannot be found or read.
        UnevenRows: stamps that are doubled or out of order.
    """
    if not path.exists():
        raise ConfigurationError(f"{path} does not exist; wanted a table or a bag")
    is_table = path.suffix.lower() in TABLES
    stream = (_from_table if is_table else _from_bag)(path, kind, keys, spec)
    if stream is None:
        nothing = np.zeros(0)
        return Stream(nothing, nothing, np.zeros((0, 0)))
    finite = np.isfinite(stream.values).all(axis=1)
    if kind is not FEATURES and not finite.all():
        row = int(np.argmin(finite))
        raise ConfigurationError(
            f"{kind.name} of {path}: sample {row} has a number that is not finite"
        )
    time = stream.time + keys.offset
    _check_order(path, kind, keys, time)
    return Stream(time[finite], stream.received[finite], keys.scale * stream.values[finite])


def _check_order(path: Path, kind: Kind, keys: StreamMap, time: FloatArray) -> None:
    """Refuse stamps that do not grow, are too few, or are likely in another unit."""
    what = f"{kind.name} of {path}"
    if len(time) < 2:
        raise ConfigurationError(f"{what} are {len(time)} samples; wanted two or more")
    steps = np.diff(time)
    if kind.needed and (steps <= 0.0).any():
        row = int(np.argmax(steps <= 0.0)) + 1
        found = f"the stamp of sample {row} is {steps[row - 1]:.6g} s after the one before"
        remedy = f'sort them and leave out doubled ones, or take another field, such as time = "{RECEIVED}"'
        raise UnevenRows(f"{what}: {found}: {remedy}")
    usual = float(np.median(steps))
    if not kind.needed or usual <= MAX_STEP:
        return
    counted = usual * PER_SECOND.get(keys.unit, 1.0)
    likely = (unit for unit, count in PER_SECOND.items() if 1e-4 < counted / count < 1.0)
    unit = next(likely, "ms")
    remedy = f'write unit = "{unit}" in [{kind.name}] of the map'
    raise ConfigurationError(f"{what}: stamps are {usual:.4g} s apart; if in {unit}, {remedy}")


def _wanted(kind: Kind, spec: PlantSpec) -> tuple[str, ...]:
    """Return the names of the robot's joints or features that a stream has."""
    if kind in (JOINTS, COMMANDS):
        return spec.joint_names
    return spec.feature_names


def _from_table(path: Path, kind: Kind, keys: StreamMap, spec: PlantSpec) -> Stream | None:
    """Return the stream of a table; None where a stream that may be missing has no columns."""
    table = read_table(kind.name, path)
    what = f"{kind.name} {path}"
    columns = list(keys.fields) or column_names(spec)[kind.column]
    if not keys.fields and not set(columns) <= set(table):
        if not kind.needed and not keys.names:
            return None
        if kind in (JOINTS, COMMANDS):
            columns = _matched(what, _wanted(kind, spec), [str(name) for name in table], keys, kind)
    _check_count(what, columns, kind, spec)
    stamps = keys.time or TIME
    lacking = [name for name in (stamps, *columns) if name not in table]
    if lacking:
        key = "time" if lacking[0] == stamps else "fields"
        remedy = f"name it by {key} in [{kind.name}] of the map"
        raise ConfigurationError(
            f"{what} has no column {lacking[0]}; {remedy}: {suggest(lacking[0], map(str, table))}"
        )
    time = _seconds(what, table, stamps, keys.unit)
    received = np.full(len(table), np.nan)
    if keys.received:
        received = _seconds(what, table, keys.received, keys.unit)
    present = table[columns].notna()
    numbers = numbers_of(what, table.assign(**table[columns].where(present, 0.0)), columns)
    return Stream(time, received, np.where(present, numbers, np.nan))


def _seconds(what: str, table: pd.DataFrame, column: str, unit: str) -> FloatArray:
    """Return the stamps of a column: numbers in a unit, dates, or texts as ISO 8601 has them, (k,) s."""
    if column not in table:
        raise ConfigurationError(
            f"{what} has no column {column}: {suggest(column, map(str, table))}"
        )
    stamps = table[column]
    if pd.api.types.is_numeric_dtype(stamps):
        return numbers_of(what, table, [column])[:, 0] / PER_SECOND.get(unit, 1.0)
    with configuration_errors(
        f"{what}: {column} has a stamp that is no number and no date of ISO 8601: "
    ):
        dates = pd.to_datetime(
            stamps, utc=True, format="ISO8601" if stamps.dtype.kind != "M" else None
        )
    if dates.isna().any():
        raise ConfigurationError(
            f"{what}: {column} has no stamp in row {int(dates.isna().argmax())}"
        )
    elapsed = dates - pd.Timestamp(0, tz="UTC")
    return np.asarray(elapsed.dt.total_seconds(), dtype=np.float64)


def _check_count(what: str, columns: Sequence[str], kind: Kind, spec: PlantSpec) -> None:
    """Refuse another number of fields than the robot has joints or features."""
    wanted = _wanted(kind, spec)
    if len(columns) != len(wanted):
        raise ConfigurationError(
            f"{what}: [{kind.name}] of the map has {len(columns)} fields; wanted {len(wanted)}, of {', '.join(wanted)}"
        )


def _plain(name: str) -> str:
    return "".join(filter(str.isalnum, name)).lower()


def _matched(
    what: str, joints: Sequence[str], offered: Sequence[str], keys: StreamMap, kind: Kind
) -> list[str]:
    """Return the name of each joint among those that are offered: that of the map, else the one that holds its own."""
    found = []
    for joint in joints:
        name = keys.names.get(joint, joint)
        fitting = [each for each in offered if each == name]
        if not fitting and joint not in keys.names:
            fitting = [each for each in offered if _plain(name) in _plain(each)]
        if len(fitting) != 1:
            came = f"fits {listed(fitting)}" if fitting else f"is not among {listed(offered)}"
            remedy = f'write {joint} = "…" in [{kind.name}.names] of the map'
            raise ConfigurationError(f"{what}: joint {name} {came}; {remedy}")
        found += fitting
    return found


def _from_bag(path: Path, kind: Kind, keys: StreamMap, spec: PlantSpec) -> Stream | None:
    """Return the stream of a topic; None where a stream that may be missing has none."""
    check_installed(("rosbags",), f"the bag {path}")
    from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 - of the extra bag
    from rosbags.highlevel.anyreader import ReaderErrors  # noqa: PLC0415 - likewise
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - likewise

    topic = keys.topic or kind.topic
    what = f"{kind.name} of {path}"
    reader = _Messages(what, kind, keys, spec)
    rows: list[tuple[float, float, list[float]]] = []
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
            chosen = [each for each in bag.connections if each.topic == topic]
            if not chosen and not kind.needed and not keys.topic:
                return None
            if not chosen:
                known = {each.topic for each in bag.connections}
                remedy = f"name it in [{kind.name}] of the map: {suggest(topic, known)}"
                raise ConfigurationError(f"{what}: there is no topic {topic}; {remedy}")
            for connection, received, raw in bag.messages(connections=chosen):
                message = bag.deserialize(raw, connection.msgtype)
                row = reader.row(message, NANOSECOND * received)
                if row is not None:
                    rows.append(row)
    except (AnyReaderError, *ReaderErrors, *DAMAGED) as error:
        found = f"{path} cannot be read as a bag ({type(error).__name__}: {error})"
        remedy = "wanted a finished MCAP file, a rosbag2 folder, .db3 or .bag; `mcap recover` repairs an unfinished one"
        raise ConfigurationError(f"{found}; {remedy}") from error
    if not rows:
        reader.refuse()
    time, recorded, values = zip(*rows, strict=True)
    return Stream(np.array(time), np.array(recorded), np.array(values))


class _Messages:
    """The values of the messages of a topic.

    Messages without the joints of the robot, such as those of a gripper on the same topic, are left out.
    """

    def __init__(self, what: str, kind: Kind, keys: StreamMap, spec: PlantSpec) -> None:
        """Take the fields of the map, or the usual ones."""
        self.what = what
        self.kind = kind
        self.keys = keys
        self.wanted = _wanted(kind, spec)
        usual = kind.message_fields[: spec.m]
        if kind is COMMANDS:
            usual = tuple(f"data.{i}" for i in range(spec.n))
        self.fields = keys.fields or usual
        if self.fields:
            _check_count(what, self.fields, kind, spec)
        # The places of the robot's joints in messages with these names; none for messages of others.
        self._places: dict[tuple[str, ...], list[int] | None] = {}

    def row(self, message: Any, received: float) -> tuple[float, float, list[float]] | None:  # noqa: ANN401 - any message
        """Return stamp [s], time of recording [s] and values of a message; None without the robot's joints."""
        if self.fields:
            values = [self._number(message, field) for field in self.fields]
        else:
            names = tuple(self._get(message, "name"))
            if names not in self._places:
                self._places[names] = self._find(names)
            places = self._places[names]
            if places is None:
                return None
            positions = self._get(message, "position")
            values = [float(positions[place]) for place in places]
        return self._stamp(message, received), received, values

    def refuse(self) -> NoReturn:
        """Refuse a topic without any message of the robot's joints."""
        names = max(self._places, key=len, default=())
        if names:
            _matched(self.what, self.wanted, names, self.keys, self.kind)
        raise ConfigurationError(f"{self.what}: the topic has no message")

    def _find(self, names: tuple[str, ...]) -> list[int] | None:
        try:
            found = _matched(self.what, self.wanted, names, self.keys, self.kind)
        except ConfigurationError:
            return None
        return [names.index(name) for name in found]

    def _stamp(self, message: Any, received: float) -> float:  # noqa: ANN401 - as above
        """Return the stamp of a message [s]; without a header the time of recording."""
        field = self.keys.time
        if field == RECEIVED or (not field and not hasattr(message, "header")):
            return received
        stamp = self._get(message, field or STAMP)
        if hasattr(stamp, "nanosec"):
            return float(stamp.sec + NANOSECOND * stamp.nanosec)
        return self._as_number(stamp, field) / PER_SECOND.get(self.keys.unit, 1.0)

    def _number(self, message: Any, field: str) -> float:  # noqa: ANN401 - as above
        """Return the number in a field; NaN where a list is too short, as that of the detections in an empty image."""
        try:
            return self._as_number(self._get(message, field), field)
        except IndexError:
            return math.nan

    def _as_number(self, value: Any, field: str) -> float:  # noqa: ANN401 - as above
        if isinstance(value, int | float | np.number):
            return float(value)
        raise ConfigurationError(
            f"{self.what}: field {field} is no number; name one of its parts in the map{_parts(value)}"
        )

    def _get(self, message: Any, field: str) -> Any:  # noqa: ANN401 - as above
        """Return a field of a message by its path, such as detections.0.center.x."""
        value = message
        for part in field.split("."):
            if part.isdecimal():
                value = value[int(part)]
                continue
            if not hasattr(value, part):
                remedy = f"name another in [{self.kind.name}] of the map{_parts(value)}"
                raise ConfigurationError(f"{self.what}: messages have no field {field}; {remedy}")
            value = getattr(value, part)
        return value


def _parts(value: Any) -> str:  # noqa: ANN401 - a part of a message
    """Return the names of the fields of a message, for an error."""
    if not is_dataclass(value):
        return ""
    names = [each.name for each in fields(value) if not each.name.startswith("__")]
    return f": {listed(names)}"
