"""Tables in Parquet files with a checksum a page: written, read, and put together while few rows are in memory."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from servobench.harness.batch.checksums import DamagedFile
from servobench.harness.config.settings import ConfigurationError

ROW_GROUP: Final = 2048  # [rows] of a table that are in memory at a time while parts are put together
BATCH: Final = b"servobench.batch"  # key of what a table says about whose rows it holds


def as_table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Return rows as a table with the columns of all; NaN is null, and a column of NaN alone is one of numbers."""

    def column(name: str) -> pa.Array:
        values = [row.get(name) for row in rows]
        made = pa.array(values, from_pandas=True)
        return made.cast(pa.float64()) if pa.types.is_null(made.type) and float in map(type, values) else made

    return pa.table({name: column(name) for name in dict.fromkeys(name for row in rows for name in row)})


def write_table(table: pa.Table, path: Path, batch: str = "") -> None:
    """Write a table.

    Args:
        table: without metadata.
        path: of the file.
        batch: whose rows these are.
    """
    schema = table.schema.with_metadata({BATCH: batch} if batch else None)
    with path.open("wb") as file, _writer(file, schema) as writer:
        if len(table):
            writer.write_table(table.cast(schema))


def join(folder: Path, names: Sequence[str], batch: str, path: Path) -> None:
    """Write tables as one, holding few rows in memory; what a table lacks is null."""
    schema = common_schema(folder, names)
    waiting = schema.empty_table()
    with path.open("wb") as target, _writer(target, schema.with_metadata({BATCH: batch} if batch else None)) as writer:
        for name in names:
            with opened(folder, name) as part:  # threads and datasets would hold memory that grows with the parts
                table = part.read(use_threads=False).replace_schema_metadata()
            waiting = pa.concat_tables([waiting, table], promote_options="permissive")
            if len(waiting) >= ROW_GROUP:
                writer.write_table(waiting.replace_schema_metadata(writer.schema.metadata))
                waiting = schema.empty_table()
        if len(waiting):
            writer.write_table(waiting.replace_schema_metadata(writer.schema.metadata))


def _writer(file: Any, schema: pa.Schema) -> pq.ParquetWriter:  # noqa: ANN401 - an open file
    return pq.ParquetWriter(file, schema, write_page_checksum=True)


def read_tables(
    folder: Path, names: Sequence[str], only: ds.Expression | None = None, columns: Collection[str] | None = None
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
                table = pq.read_table(folder / name, columns=known, filters=only, page_checksum_verification=True)
            tables.append(table.replace_schema_metadata())
    with reading(folder, names[-1] if names else ""):
        made: pd.DataFrame = pa.concat_tables(tables, promote_options="permissive").to_pandas()
    return made


def row_groups(folder: Path, name: str, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
    """Yield the row groups of a table, with those of `columns` that it has."""
    with opened(folder, name) as file:
        known = [each for each in columns if each in file.schema_arrow.names]
        for group in range(file.num_row_groups):
            yield file.read_row_group(group, known, use_threads=False).to_pandas()


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
        DamagedFile: it cannot be read.
    """
    with reading(folder, name), pq.ParquetFile(folder / name, page_checksum_verification=True) as file:
        yield file


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
        why = " ".join(str(error).split()) or type(error).__name__
        raise DamagedFile(folder, name, f"cannot be read ({why[:160].rstrip('.')})") from error
