"""A folder of results: `runs.parquet` (a row a run), `steps.parquet` (a row a period), `manifest.json`, `failures.log`.

While runs are under way, finished ones lie below `parts/`: a pair of files for each run or block of runs, each written
atomically, steps first, so that a part counts once its rows are there. At the end the parts are put together. If the
process was killed, `load_runs` and `load_steps` read the parts, and `collect` puts together what there is.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from servobench.harness.batch.lock import check_empty
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.ending import log_entry
from servobench.plant.files import write_atomically

if TYPE_CHECKING:
    from servobench.harness.run.episode import RunResult
    from servobench.plant.plant import ImageArray

SCHEMA_VERSION = "4"
CHANGES: Final = {"3": "; the column latency_periods [periods] is now latency_s [s]"}  # since an earlier schema
PARTS = "parts"
PICTURES = "pictures"
RUNS = "runs.parquet"
STEPS = "steps.parquet"
FAILURES = "failures.log"
MANIFEST = "manifest.json"
ROW_GROUP: Final = 2048  # [rows] of a table that are in memory at a time while parts are put together


def create_folder(folder: Path, manifest: dict[str, Any]) -> None:
    """Make a new results folder with its manifest.

    Raises:
        ConfigurationError: the folder has something in it, or cannot be made.
    """
    check_empty(folder)
    try:
        (folder / PARTS).mkdir(parents=True)
        write_manifest(folder, manifest)
    except OSError as error:
        raise ConfigurationError(f"results folder {folder} cannot be made: {error.strerror}") from error


def write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    """Write `manifest.json` atomically; JSON has no infinity, so a setting without limit reads "inf"."""
    content = json.dumps(_in_json({"schema_version": SCHEMA_VERSION, **manifest}), indent=2, allow_nan=False)
    _write_text(folder / MANIFEST, content + "\n")


def _in_json(value: Any) -> Any:  # noqa: ANN401 - whatever a manifest holds
    if isinstance(value, dict):
        return {key: _in_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_in_json(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def write_part(folder: Path, index: int, outcome: Sequence[RunResult]) -> None:
    """Write finished runs as one part, all else before the rows that make it count.

    Args:
        folder: a results folder.
        index: of the first of them among all runs.
        outcome: results of consecutive runs.
    """
    for result in outcome:
        if result.picture is not None:
            _write_picture(folder / PICTURES / f"{result.row['run_id']}.png", result.picture)
    steps = [result.steps for result in outcome if result.steps is not None and len(result.steps)]
    if steps:
        _write_frame(pd.concat(steps, ignore_index=True), folder / PARTS / f"{index:08d}.{STEPS}")
    failures = "".join(log_entry(result.row, result.trace) for result in outcome)
    if failures:
        _write_text(folder / PARTS / f"{index:08d}.{FAILURES}", failures)
    rows = _table([result.row for result in outcome])
    write_atomically(folder / PARTS / f"{index:08d}.{RUNS}", partial(pq.write_table, rows))


def _table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Return rows as a table with the columns of all; NaN is null, and a column of NaN alone is one of numbers."""

    def column(name: str) -> pa.Array:
        values = [row.get(name) for row in rows]
        made = pa.array(values, from_pandas=True)
        return made.cast(pa.float64()) if pa.types.is_null(made.type) and float in map(type, values) else made

    return pa.table({name: column(name) for name in dict.fromkeys(name for row in rows for name in row)})


def _write_picture(path: Path, picture: ImageArray) -> None:
    import cv2  # noqa: PLC0415 - only pictures of cameras need it

    path.parent.mkdir(exist_ok=True)
    large = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    content = cv2.imencode(".png", cv2.cvtColor(large, cv2.COLOR_RGB2BGR))[1].tobytes()
    write_atomically(path, lambda file: file.write_bytes(content))


def write_summary(folder: Path, tables: dict[str, pd.DataFrame], manifest: dict[str, Any]) -> None:
    """Make a folder that holds several sweeps a results folder itself: one table of all their runs.

    Args:
        folder: the folder.
        tables: tables of runs by the name of the sweep; it becomes the column `part`.
        manifest: of the whole.
    """
    runs = pd.concat([table.assign(part=name) for name, table in tables.items()], ignore_index=True)
    _write_frame(runs, folder / RUNS)
    write_manifest(folder, manifest)


def finished_runs(folder: Path) -> list[range]:
    """Return the indices of the runs whose part is there, in order."""
    begins = ((int(path.name.split(".")[0]), pq.read_metadata(path).num_rows) for path in _part_files(folder, RUNS))
    return [range(begin, begin + count) for begin, count in begins]


def collect(folder: Path) -> int:
    """Put the parts together into the two tables and the log and, unless runs are missing, remove them.

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
    if not _part_files(folder, RUNS):
        raise ConfigurationError(f"{folder} holds no finished run")
    for kind in (STEPS, RUNS):
        files = _part_files(folder, kind)
        if files:
            write_atomically(folder / kind, partial(_join, files))
    failures = [path.read_text(encoding="utf-8") for path in _part_files(folder, FAILURES)]
    if failures:
        _write_text(folder / FAILURES, "".join(failures))
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
    return _load(folder, RUNS)


def iterate_runs(folder: Path, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
    """Yield the table of runs of a finished batch, at most `ROW_GROUP` rows at a time and those of `columns` it has."""
    with pq.ParquetFile(folder / RUNS) as file:
        known = [name for name in columns if name in file.schema_arrow.names]
        for group in range(file.num_row_groups):
            yield file.read_row_group(group, known, use_threads=False).to_pandas()


def load_steps(folder: Path, run_ids: list[str] | None = None, columns: Collection[str] | None = None) -> pd.DataFrame:
    """Return the table of steps, of all runs or of those named.

    Args:
        folder: a results folder.
        run_ids: of these runs only.
        columns: these only, as far as there are such; None for all.

    Raises:
        ConfigurationError: not a results folder, or one of another schema.
    """
    check_folder(folder)
    steps = _load(folder, STEPS, None if run_ids is None else ds.field("run_id").isin(run_ids), columns)
    if steps.empty:
        raise ConfigurationError(f"{folder} holds no steps: every run ended before its first period")
    return steps


def has_steps(folder: Path) -> bool:
    """Return whether a results folder has a table of steps."""
    return (folder / STEPS).is_file() or bool(_part_files(folder, STEPS))


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
            f"{CHANGES.get(str(version), '')}"
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
    """Return the files of one kind of the parts that count, in order."""
    rows = sorted((folder / PARTS).glob(f"[0-9]*.{RUNS}"))
    files = [path.with_name(path.name.removesuffix(RUNS) + kind) for path in rows]
    return [path for path in files if path.is_file()]


def _load(
    folder: Path, kind: str, only: ds.Expression | None = None, columns: Collection[str] | None = None
) -> pd.DataFrame:
    paths = [folder / kind] if (folder / kind).is_file() else _part_files(folder, kind)
    if not paths:
        return pd.DataFrame()
    data = ds.dataset([str(path) for path in paths], _common_schema(paths))
    wanted = None if columns is None else [name for name in data.schema.names if name in columns]
    table: pd.DataFrame = data.to_table(filter=only, columns=wanted).to_pandas()
    return table


def _common_schema(paths: Sequence[Path]) -> pa.Schema:
    """Return the columns of all tables; of a column that one has as nothing, the type is that of the others."""
    common = pa.schema([])
    for path in paths:
        own = pq.read_schema(path).remove_metadata()
        if own != common:
            common = pa.unify_schemas([common, own], promote_options="permissive")
    return common


def _join(paths: Sequence[Path], path: Path) -> None:
    """Write tables as one, holding few rows in memory; what a table lacks is null."""
    empty = _common_schema(paths).empty_table()
    with pq.ParquetWriter(path, empty.schema) as writer:
        waiting = empty
        for file in paths:
            with pq.ParquetFile(file) as part:  # threads and datasets would hold memory that grows with the parts
                waiting = pa.concat_tables([waiting, part.read(use_threads=False)], promote_options="permissive")
            if len(waiting) >= ROW_GROUP:
                writer.write_table(waiting)
                waiting = empty
        if len(waiting):
            writer.write_table(waiting)


def _write_frame(frame: pd.DataFrame, path: Path) -> None:
    write_atomically(path, lambda file: pq.write_table(pa.Table.from_pandas(frame, preserve_index=False), file))


def _write_text(path: Path, text: str) -> None:
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8", errors="backslashreplace"))
