"""Tables in Parquet files with a checksum a page: written, read, and put together while few rows are in memory."""

import contextlib
import errno
import math
import re
from collections.abc import Collection, Iterator, Sequence
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from servobench.harness.run.metrics import BUILT_IN
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.variations import SHORT_NAMES, Row
from servobench.plant.contract.checks import AnyArray
from servobench.plant.contract.checksums import SUMS, Sums, read_sums
from servobench.plant.contract.faults import ConfigurationError, one_line

ROW_GROUP = 2048  # [rows] of a table that are in memory at a time while parts are put together
MAX_COLUMNS, MAX_NAME = 10_000, 200  # of a table, and letters of the name of one
# of a table of any size, and for each byte of its file
MAX_CELLS, MAX_CELLS_A_BYTE = (2 * 10**7, 100)
MAX_TIME = 1e9  # [s] time of a step, which other formats count in nanoseconds
NO_THREAD = "launch worker thread"  # in a message of Arrow
BATCH = b"servobench.batch"  # key of the batch whose rows a table holds


class DamagedFile(ConfigurationError):
    """A file of a results folder was changed since it was written, or is missing."""

    def __init__(self, folder: Path, name: str, fault: str) -> None:
        """Name the file, its fault and the remedy."""
        self.fault = fault
        super().__init__(
            f"{folder / name} {fault}; repeat the command that made the folder with --resume, or type: servobench "
            f"verify {folder}"
        )


class UnwritableFolder(OSError):
    """The results folder takes no more files."""


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Name the results folder where the system refuses to write.

    Raises:
        UnwritableFolder: it did.
    """
    try:
        yield
    except UnwritableFolder:
        raise
    except OSError as error:
        why = error.strerror or str(error) or type(error).__name__
        if error.errno == errno.ENOENT and not folder.is_dir():
            why = "it was removed"
        raise UnwritableFolder(
            error.errno, f"results folder {folder} cannot be written: {why}"
        ) from error


def sums_of(folder: Path) -> Sums | None:
    """Return the lines of a results folder; None where it has none, as one of an earlier version.

    Raises:
        ConfigurationError: they cannot be read.
    """
    try:
        return read_sums(folder)
    except OSError as error:
        wrong = f"{folder / SUMS} cannot be read: {error.strerror}"
        raise ConfigurationError(
            wrong if folder.is_dir() else f"{folder} is not a results folder"
        ) from error


def as_table(rows: Sequence[Row]) -> pa.Table:
    """Return rows as a table with the columns of all; NaN is null, and an empty column of numbers is one of numbers."""

    def column(name: str, values: Sequence[Any]) -> pa.Array:
        made = pa.array(values, from_pandas=True)
        if pa.types.is_null(made.type) and (name in NUMBERS or float in map(type, values)):
            return pa.nulls(len(values), pa.float64())
        return made

    names = dict.fromkeys(chain.from_iterable(rows))
    return pa.table({name: column(name, [row.get(name) for row in rows]) for name in names})


def write_table(table: pa.Table, path: Path, batch: str = "", compression: str = "snappy") -> None:
    """Write a table.

    Args:
        table: without metadata.
        path: of the file.
        batch: whose rows these are.
        compression: "none" for a short-lived file, which takes less time and more space.
    """
    schema = table.schema.with_metadata({BATCH: batch} if batch else None)
    with (
        path.open("wb") as file,
        pq.ParquetWriter(file, schema, compression=compression, write_page_checksum=True) as writer,
    ):
        if len(table):
            writer.write_table(table.replace_schema_metadata(schema.metadata))


def join(folder: Path, names: Sequence[str], batch: str, path: Path) -> None:
    """Write tables as one, holding few rows in memory; the columns that a table lacks are null."""
    schema = common_schema(folder, names).with_metadata({BATCH: batch} if batch else None)
    start, rows = schema.empty_table(), 0
    waiting = [start]
    with (
        path.open("wb") as file,
        pq.ParquetWriter(file, schema, write_page_checksum=True) as writer,
    ):
        for name in names:
            with opened(
                folder, name
            ) as part:  # threads and datasets would hold memory that grows with the parts
                table = part.read(use_threads=False).replace_schema_metadata()
                waiting.append(pa.concat_tables([start, table], promote_options="permissive"))
            rows += len(table)
            if rows >= ROW_GROUP or (name == names[-1] and rows):
                writer.write_table(
                    pa.concat_tables(waiting).replace_schema_metadata(schema.metadata)
                )
                waiting, rows = [start], 0


def read_tables(
    folder: Path,
    names: Sequence[str],
    only: pc.Expression | None = None,
    columns: Collection[str] | None = None,
) -> pd.DataFrame:
    """Return the rows of tables, one below the other.

    Args:
        folder: a results folder.
        names: of the files within it.
        only: which rows; None for all.
        columns: these only, as far as there are such; None for all.
    """
    tables = [pa.table({})]
    for name in names:
        with opened(folder, name) as file:
            own = file.schema_arrow.names
            known = own if columns is None else [each for each in own if each in columns]
            if only is None:
                table = file.read(known)
            else:
                table = pq.read_table(
                    folder / name, columns=known, filters=only, page_checksum_verification=True
                )
            tables.append(table.replace_schema_metadata())
    with reading(folder, names[-1] if names else ""):
        made: pd.DataFrame = pa.concat_tables(tables, promote_options="permissive").to_pandas()
    return made


def row_groups(folder: Path, name: str, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
    """Yield the row groups of a table, with those of `columns` that it has."""
    with opened(folder, name) as file:
        known = [each for each in columns if each in file.schema_arrow.names]
        for group in range(file.num_row_groups):
            yield (
                file.read_row_group(group, known, use_threads=False)
                .replace_schema_metadata()
                .to_pandas()
            )


def row_count(folder: Path, name: str) -> int:
    """Return the number of rows of a table."""
    with opened(folder, name) as file:
        return int(file.metadata.num_rows)


def owner(folder: Path, name: str) -> str:
    """Return whose rows a table says it holds; empty where it does not say."""
    with opened(folder, name) as file:
        return ((file.schema_arrow.metadata or {}).get(BATCH) or b"").decode(errors="replace")


def common_schema(folder: Path, names: Sequence[str]) -> pa.Schema:
    """Return the columns of all tables; of a column that one has as nothing, the type is that of the others."""
    common = pa.schema([])
    for name in names:
        with opened(folder, name) as file:
            own = file.schema_arrow.remove_metadata()
            if own != common:
                common = pa.unify_schemas([common, own], promote_options="permissive")
    return common


@contextlib.contextmanager
def opened(folder: Path, name: str) -> Iterator[pq.ParquetFile]:
    """Yield a table that is open for reading.

    Raises:
        DamagedFile: it cannot be read, unpacks to too much, or has columns of wrong names.
    """
    with (
        reading(folder, name),
        pq.ParquetFile(folder / name, page_checksum_verification=True) as file,
    ):
        names, cells = file.schema_arrow.names, file.metadata.num_rows * file.metadata.num_columns
        if wrong := unfit_names(tuple(names)):
            raise DamagedFile(folder, name, wrong)
        if cells > max(MAX_CELLS, MAX_CELLS_A_BYTE * (folder / name).stat().st_size):
            raise DamagedFile(folder, name, f"is a bomb: it unpacks to {cells:.2g} cells")
        yield file


@lru_cache(8)  # the rows of a batch have the same names
def unfit_names(names: tuple[str, ...]) -> str:
    """Return why names cannot be those of columns, as a predicate of the table; empty if they can."""
    if len(names) > MAX_COLUMNS:
        return f"has {len(names)} columns; a table has at most {MAX_COLUMNS}"
    fit = len(set(names)) == len(names) and all(
        each.isprintable() and len(each) <= MAX_NAME for each in names
    )
    if fit:
        return ""
    return "has two columns of one name, or a name that cannot be printed"


@contextlib.contextmanager
def reading(folder: Path, name: str) -> Iterator[None]:
    """Name a table from whose content nothing can be made.

    Raises:
        DamagedFile: names it.
    """
    try:
        yield
    except ConfigurationError:
        raise
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        why = one_line(error) or type(error).__name__
        if NO_THREAD in why:
            raise ConfigurationError(
                f"{folder / name} cannot be read, as no more threads or processes may be started here: ulimit -u"
            ) from error
        raise DamagedFile(folder, name, f"cannot be read ({why[:160].rstrip('.')})") from error


NEEDED = {
    "runs": ("run_id", "plant", "controller", "task", "mismatch", "seed", "status"),
    "steps": ("run_id", "time_s", "error_norm"),
}
TEXTS = frozenset(
    ("run_id", "plant", "controller", "task", "mismatch", "robot", "sensing", "engine", "task_kind", "feature_unit",
     "status", "outcome", "reason", "mismatch_values", "part")
)  # fmt: skip
WHOLE = frozenset(("seed", "periods"))
NUMBERS = frozenset(
    {"settling_band", *WHOLE, *BUILT_IN, *(short.column for short in SHORT_NAMES.values())}
)
# And 0 is the least
MOST = {name: 1.0 if name.endswith("_fraction") else math.inf for name in NUMBERS}
OWN_STEMS = frozenset(  # names of files and folders that a results folder, or its export, has itself
    ("runs", "steps", "manifest", "failures", "sha256sums", "parts", "pictures", "networks", "figures", "recordings",
     "report", "latest")
)  # fmt: skip
MAX_NUMBER = 1e150  # whose square is finite
# Also the name of a file: no separator, no ".."
RUN_ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9.=+_-]*")


def lacking(kind: str, schema: pa.Schema) -> str:
    """Return which columns a table of runs or steps lacks, or has of another type, as a predicate; empty if none."""
    if missing := [name for name in NEEDED[kind] if name not in schema.names]:
        columns = "column" if len(missing) == 1 else "columns"
        return f"lacks the {columns} {', '.join(missing)}"
    for name, given in zip(schema.names, schema.types, strict=True):
        is_text = pa.types.is_string(given) or pa.types.is_large_string(given)
        is_whole, is_truth = (
            pa.types.is_integer(given),
            pa.types.is_boolean(given) and name not in NUMBERS,
        )
        is_number = is_whole or is_truth or (pa.types.is_floating(given) and name not in WHOLE)
        text, number = name in TEXTS, name in NUMBERS or (kind == "steps" and name != "run_id")
        if not (pa.types.is_null(given) or (is_text and not number) or (is_number and not text)):
            wanted = "texts" if text else "whole numbers" if name in WHOLE else "numbers"
            return f"has {given} in the column {name}, where {wanted} belong"
    return ""


def steps_of_run(records: AnyArray, run_id: str) -> pd.DataFrame:
    """Return the table of steps of a run from the records that another process has sent.

    Raises:
        ValueError: they are no steps.
    """
    if any(records.dtype[name].kind not in "fib" for name in records.dtype.names or ()):
        raise ValueError("its steps are no numbers")
    table = pd.DataFrame.from_records(records)
    table.insert(0, "run_id", run_id)
    if wrong := unfit_names(tuple(table.columns)) or lacking("steps", pa.Schema.from_pandas(table)):
        raise ValueError(f"its table of steps {wrong}")
    if not table["time_s"].between(0.0, MAX_TIME).all():
        raise ValueError("its steps have no times")
    return table


def refuse_lacking(path: Path, kind: str, schema: pa.Schema) -> None:
    """Refuse a table that is none of runs or steps.

    Raises:
        ConfigurationError: names the table and its wrong columns.
    """
    if lack := lacking(kind, schema):
        raise ConfigurationError(f"{path} is no table of {kind}: it {lack}")


def refuse_nameless(path: Path, runs: pd.DataFrame) -> None:
    """Refuse a table of runs with a number that cannot be, or a run whose identifier cannot name a file of its own.

    Raises:
        ConfigurationError: names the table, the column and the row.
    """
    if fault := _fault_of_runs(runs):
        raise ConfigurationError(f"{path} is no table of runs: {fault}")


def _fault_of_runs(runs: pd.DataFrame) -> str:
    for name in NEEDED["runs"]:
        if (empty := runs[name].isna().to_numpy()).any():
            return f"row {empty.argmax()} has no {name}"
    if "settling_time_s" not in runs and (runs["status"] == COMPLETED).any():
        return "it lacks the column settling_time_s"
    least, most = runs.min(numeric_only=True).to_dict(), runs.max(numeric_only=True).to_dict()
    for name in [each for each in MOST if each in least]:
        is_huge = runs[name].between(MAX_NUMBER, math.inf, inclusive="neither").any()
        if least[name] < 0.0 or most[name] > MOST[name] or is_huge:
            return f"{name} is {min(least[name], 0.0) or most[name]:g}"
    taken: dict[str, int] = {}
    for row, run_id in enumerate(runs["run_id"]):
        if not isinstance(run_id, str) or RUN_ID.fullmatch(run_id) is None:
            return (
                f"the run_id of row {row}, {str(run_id)[:60]!r}, is unfit for the name of a file; it has letters, "
                "digits and . = + _ - only, and does not begin with a dot"
            )
        name = run_id.casefold()
        if name.partition(".")[0] in OWN_STEMS:
            return f"the run_id of row {row}, {run_id!r}, is a name of its folder"
        before = taken.setdefault(name, row)
        if before != row:
            return (
                f"rows {before} and {row} have the run_id {run_id!r}, in which capitals do not count; restore the "
                "table from a copy"
            )
    return ""
