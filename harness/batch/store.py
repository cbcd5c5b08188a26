"""Writes folders of results: the manifest, finished runs as parts, and the tables that the parts are put together to.

Each file is written atomically, with its checksum before it has its name; `results` says which files there are.
"""

import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import pandas as pd
import pyarrow as pa

from servobench.harness.batch import tables
from servobench.harness.batch.lock import PARTS, check_empty
from servobench.harness.batch.results import (
    FAILURES,
    PICTURES,
    RUNS,
    STEPS,
    Manifest,
    ResultsFolder,
    part_name,
    wanted_runs,
)
from servobench.harness.batch.schema import MANIFEST, encode
from servobench.harness.batch.tables import writing
from servobench.harness.run.result import RunResult, log_entry
from servobench.plant.bench.plant import ImageArray
from servobench.plant.contract.checksums import SUMS, digest, keep_sums, write_vouched
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import PARTIAL, Write, accessing, write_atomically

Files: TypeAlias = dict[str, Write]  # name -> writes the file


def create_folder(folder: Path, manifest: Manifest) -> None:
    """Make a new results folder with its manifest, also where an earlier call could not.

    Raises:
        ConfigurationError: the folder has something in it, or cannot be made.
    """
    check_empty(folder)
    with accessing(folder, "results folder", "made"):
        (folder / PARTS).mkdir(parents=True, exist_ok=True)
        for path in folder.iterdir():
            if path.name == SUMS or PARTIAL.fullmatch(path.name):
                path.unlink()
        write_manifest(folder, manifest)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write `manifest.json`."""
    write_vouched(folder, {MANIFEST: _text(encode(manifest))})


def write_part(folder: Path, index: int, outcome: Sequence[RunResult], campaign: str = "") -> None:
    """Write finished runs as one part, all else before the rows that make it count.

    Args:
        folder: a results folder.
        index: of the first of them among all runs.
        outcome: results of consecutive runs.
        campaign: digest of the batch that the runs are of; see `servobench.harness.batch.manifest`.

    Raises:
        UnwritableFolder: the folder takes no more files.
    """
    steps = [result.steps for result in outcome if result.steps is not None and len(result.steps)]
    failures = "".join(log_entry(result.row, result.trace) for result in outcome)
    files: Files = {}
    if steps:
        frame = pa.Table.from_pandas(pd.concat(steps, ignore_index=True), preserve_index=False)
        files[part_name(index, STEPS)] = partial(
            tables.write_table, frame.replace_schema_metadata()
        )
    if failures:
        files[part_name(index, FAILURES)] = _text(failures)
    rows = tables.as_table([result.row for result in outcome])
    files[part_name(index, RUNS)] = partial(
        tables.write_table, rows, batch=f"{campaign}@{index}", compression="none"
    )
    with writing(folder):
        for result in outcome:
            if result.picture is not None:
                _write_picture(folder / PICTURES / f"{result.row['run_id']}.png", result.picture)
        write_vouched(folder, files)


def _write_picture(path: Path, picture: ImageArray) -> None:
    import cv2  # noqa: PLC0415 - only pictures of cameras need it

    path.parent.mkdir(exist_ok=True)
    large = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    content = cv2.imencode(".png", cv2.cvtColor(large, cv2.COLOR_RGB2BGR))[1].tobytes()
    write_atomically(path, lambda file: file.write_bytes(content))


def collect(folder: ResultsFolder) -> int:
    """Put the parts together into the two tables and the log and, unless runs are missing, remove them.

    Returns:
        Number of runs.

    Raises:
        ConfigurationError: there are no parts and no tables, or a file is damaged.
        UnwritableFolder: the folder takes no more files.
    """
    folder.runs()  # refuses a table of anything else
    return put_together(folder, folder.manifest)


def put_together(folder: ResultsFolder, manifest: Manifest) -> int:
    """Put the parts of a folder with this manifest together; result and errors are those of `collect`."""
    path = folder.path
    wanted = wanted_runs(manifest)
    if folder.is_whole(wanted):  # at most the clean-up is left
        shutil.rmtree(path / PARTS, ignore_errors=True)
        return tables.row_count(path, RUNS)
    if not folder.part_indices():
        folder.refuse_damaged([name for name in (RUNS, STEPS) if folder.expects(name)])
        raise ConfigurationError(f"{path} holds no finished run")
    files = {}
    for kind in (STEPS, FAILURES, RUNS):
        names = folder.part_names(kind)
        folder.refuse_damaged(names)
        if names and kind == FAILURES:
            logs = [(path / name).read_text(encoding="utf-8") for name in names]
            files[kind] = _text("".join(logs))
        elif names:
            files[kind] = partial(tables.join, path, names, manifest.get("campaign", ""))
    with writing(path):
        write_vouched(path, files)
        folder.vouch([path / name for name in folder.unlisted() if not name.endswith("/")])
        count = tables.row_count(path, RUNS)
        if count >= wanted:
            kept = {name: frozenset([digest(path / name)]) for name in [MANIFEST, *files]}
            keep_sums(path, kept | folder.accompanying())
            shutil.rmtree(path / PARTS)
    return count


def _text(text: str) -> Write:
    return lambda file: file.write_text(text, encoding="utf-8", errors="backslashreplace")
