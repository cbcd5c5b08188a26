"""A folder of results: `runs.parquet` (a row a run), `steps.parquet` (a row a period), `manifest.json`.

While a batch is under way every finished run is a pair of files below `parts/`, each written under another name and
then renamed, steps first: what is there is whole. At the end they are put together. If the batch was killed,
`load_runs` and `load_steps` read the parts, and `collect` puts together what there is.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from servobench.harness.config.settings import ConfigurationError

SCHEMA_VERSION = "2"
PARTS = "parts"
RUNS = "runs.parquet"
STEPS = "steps.parquet"
MANIFEST = "manifest.json"


def create_folder(folder: Path, manifest: dict[str, Any]) -> None:
    """Make a new results folder with its manifest.

    Raises:
        ConfigurationError: the folder has something in it, or cannot be made.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigurationError(f"results folder {folder} exists already; name another one with --out")
    try:
        (folder / PARTS).mkdir(parents=True)
        write_manifest(folder, manifest)
    except OSError as error:
        raise ConfigurationError(f"results folder {folder} cannot be made: {error.strerror}") from error


def write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    """Write `manifest.json`, whole or not at all; JSON has no infinity, so that a setting without limit reads "inf"."""
    partial = folder / f".{MANIFEST}"
    content = json.dumps(_in_json({"schema_version": SCHEMA_VERSION, **manifest}), indent=2, allow_nan=False)
    partial.write_text(content + "\n", encoding="utf-8")
    partial.replace(folder / MANIFEST)


def _in_json(value: Any) -> Any:  # noqa: ANN401 - whatever a manifest holds
    if isinstance(value, dict):
        return {key: _in_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_in_json(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def write_part(folder: Path, index: int, row: dict[str, Any], steps: pd.DataFrame) -> None:
    """Write one finished run; the row comes last and makes it count."""
    stem = f"{index:08d}"
    if len(steps):
        _write_table(pa.Table.from_pandas(steps, preserve_index=False), folder / PARTS / f"{stem}.{STEPS}")
    _write_table(pa.Table.from_pylist([row]), folder / PARTS / f"{stem}.{RUNS}")


def write_rows(folder: Path, index: int, rows: list[dict[str, Any]]) -> None:
    """Write several finished runs without their steps as one part.

    Args:
        folder: a results folder.
        index: of the first of them among all runs.
        rows: rows of the table of runs, in order.
    """
    _write_table(pa.Table.from_pandas(pd.DataFrame(rows), preserve_index=False), folder / PARTS / f"{index:08d}.{RUNS}")


def write_summary(folder: Path, tables: dict[str, pd.DataFrame], manifest: dict[str, Any]) -> None:
    """Make a folder that holds several sweeps a results folder itself: one table of all their runs.

    Args:
        folder: the folder.
        tables: tables of runs by the name of the sweep; it becomes the column `part`.
        manifest: of the whole.
    """
    runs = pd.concat([table.assign(part=name) for name, table in tables.items()], ignore_index=True)
    _write_table(pa.Table.from_pandas(runs, preserve_index=False), folder / RUNS)
    write_manifest(folder, manifest)


def finished_parts(folder: Path) -> set[int]:
    """Return the indices of the parts that are there."""
    return {int(path.name.split(".")[0]) for path in _part_files(folder, RUNS)}


def collect(folder: Path) -> int:
    """Put the parts together into the two tables and, unless runs of a sweep are missing, remove them.

    Returns:
        Number of runs.

    Raises:
        ConfigurationError: there are no parts and no tables.
    """
    wanted = read_manifest(folder).get("run_count", 0)
    if (folder / RUNS).is_file():
        count = int(pq.read_metadata(folder / RUNS).num_rows)
        if count >= wanted:  # the tables are whole, at most the clean-up is left
            shutil.rmtree(folder / PARTS, ignore_errors=True)
            return count
    row_files = _part_files(folder, RUNS)
    if not row_files:
        raise ConfigurationError(f"{folder} holds no finished run")
    step_files = [path for path in (_steps_of(path) for path in row_files) if path.is_file()]
    _concatenate(step_files, folder / STEPS)
    _concatenate(row_files, folder / RUNS)
    count = int(pq.read_metadata(folder / RUNS).num_rows)
    if count >= wanted:
        shutil.rmtree(folder / PARTS)
    return count


def load_runs(folder: Path) -> pd.DataFrame:
    """Return the table of runs of a results folder, also of one whose batch was killed.

    Raises:
        ConfigurationError: not a results folder, or one of another schema.
    """
    check_folder(folder)
    return _join(_tables(folder, RUNS))


def load_steps(folder: Path, run_ids: list[str] | None = None) -> pd.DataFrame:
    """Return the table of steps, of all runs or of those named.

    Raises:
        ConfigurationError: not a results folder, or one of another schema.
    """
    check_folder(folder)
    filters = None if run_ids is None else [("run_id", "in", run_ids)]
    steps = _join(_tables(folder, STEPS, filters))
    if steps.empty:
        raise ConfigurationError(f"{folder} holds no steps: every run ended before its first period")
    return steps


def check_folder(folder: Path) -> None:
    """Refuse what is not a results folder of this schema.

    Raises:
        ConfigurationError: says what is missing or different.
    """
    read_manifest(folder)
    if not (folder / RUNS).is_file() and not _part_files(folder, RUNS):
        raise ConfigurationError(f"{folder} holds no finished run")


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a results folder.

    Raises:
        ConfigurationError: not a results folder, or one of another schema.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{folder} is not a results folder: its {MANIFEST} cannot be read") from error
    version = manifest.get("schema_version") if isinstance(manifest, dict) else None
    if version != SCHEMA_VERSION:
        raise ConfigurationError(
            f"{folder} has results of schema {version!r}; this servobench reads {SCHEMA_VERSION!r}"
        )
    return dict(manifest)


def point_latest(folder: Path) -> None:
    """Let the link `latest` beside `folder` point at it; where links cannot be made, nothing happens."""
    link = folder.parent / "latest"
    partial = folder.parent / f".latest-{os.getpid()}"
    if link.exists() and not link.is_symlink():
        return
    try:
        partial.symlink_to(folder.name, target_is_directory=True)
        partial.replace(link)
    except OSError:
        partial.unlink(missing_ok=True)


def _part_files(folder: Path, kind: str) -> list[Path]:
    return sorted((folder / PARTS).glob(f"[0-9]*.{kind}"))


def _steps_of(row_file: Path) -> Path:
    return row_file.with_name(row_file.name.removesuffix(RUNS) + STEPS)


def _tables(folder: Path, kind: str, filters: list[tuple[str, str, Any]] | None = None) -> Iterator[pa.Table]:
    whole = folder / kind
    paths = [whole] if whole.is_file() else _part_files(folder, kind)
    for path in paths:
        yield pq.read_table(path, filters=filters)


def _join(tables: Iterator[pa.Table]) -> pd.DataFrame:
    frames: list[pd.DataFrame] = [table.to_pandas() for table in tables]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()


def _write_table(table: pa.Table, path: Path) -> None:
    partial = path.with_name(f".{path.name}")
    pq.write_table(table, partial)
    partial.replace(path)


def _concatenate(paths: list[Path], target: Path) -> None:
    """Write the tables in `paths` into one file, one in memory at a time; columns that a table lacks become null."""
    if not paths:
        return
    schema = pa.unify_schemas([pq.read_schema(path).remove_metadata() for path in paths], promote_options="permissive")
    partial = target.with_name(f".{target.name}")
    with pq.ParquetWriter(partial, schema) as writer:
        for path in paths:
            table = pq.read_table(path)
            columns = [
                table[field.name].cast(field.type)
                if field.name in table.column_names
                else pa.nulls(len(table), field.type)
                for field in schema
            ]
            writer.write_table(pa.table(columns, schema=schema))
    partial.replace(target)
