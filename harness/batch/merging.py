"""Merges the parts of a batch that were carried out in folders of their own, as on several machines, into one."""

import shutil
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import pandas as pd

from servobench.harness.batch import store, tables
from servobench.harness.batch.differences import check_same_batch
from servobench.harness.batch.lock import check_empty
from servobench.harness.batch.results import (
    PICTURES,
    RUNS,
    ResultsFolder,
    part_name,
)
from servobench.harness.batch.tables import refuse_nameless, writing
from servobench.harness.run.result import NETWORKS
from servobench.plant.contract.checksums import write_vouched
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import writing_together


def merge(folders: Sequence[Path], out: Path, note: Callable[[str], None]) -> int:
    """Put the finished runs of a batch that was carried out in parts, each in a folder of its own, into one folder.

    Where runs are missing, the same call without a part carries them out in the new folder.

    Args:
        folders: of the parts, in any order.
        out: new folder.
        note: gets a line for each difference between the folders that may matter.

    Returns:
        Number of runs.

    Raises:
        ConfigurationError: a folder without parts, of another batch or with a damaged file, or a run that two have.
    """
    opened = [ResultsFolder(folder) for folder in folders]
    manifest = opened[0].manifest
    found = []
    runs = []
    for folder in opened:
        # Refuses a table of anything else, whose names are of files
        runs.append(folder.runs())
        check_same_batch(folder, manifest, note, remedy="leave it away")
        parts = folder.finished_runs()
        if not parts:
            raise ConfigurationError(
                f"{folder.path} holds a whole batch, no part; join tables of several with pandas"
            )
        found += [(each, folder) for each in parts]
    found.sort(key=lambda pair: pair[0].start)
    for (own, folder), (others, other) in pairwise(found):
        if others.start < own.stop:
            raise ConfigurationError(
                f"{folder.path} and {other.path} have the same runs: leave one away"
            )
    refuse_nameless(out, pd.concat(runs, ignore_index=True))
    check_empty(out)
    with writing(out), writing_together(out) as unfinished:
        store.create_folder(unfinished, manifest)
        copy_parts(((folder, own.start) for own, folder in found), unfinished)
        return store.put_together(ResultsFolder(unfinished), manifest)


def copy_parts(parts: Iterable[tuple[ResultsFolder, int]], other: Path) -> None:
    """Copy parts, each of a folder and beginning with a run, with pictures of their runs and networks into another one.

    Raises:
        ConfigurationError: a file of them is damaged.
        UnwritableFolder: the other folder takes no more files.
    """
    files: store.Files = {}
    for folder, index in parts:
        names = folder.files_of_part(index)
        folder.refuse_damaged(names)
        networks = sorted((folder.path / NETWORKS).glob("*.npz"))
        names = [
            *_pictures_of(folder, index),
            *names,
            *(f"{NETWORKS}/{path.name}" for path in networks),
        ]
        files |= {name: partial(shutil.copyfile, folder.path / name) for name in names}
    with writing(other):
        for name in (PICTURES, NETWORKS):
            if any(file.startswith(name) for file in files):
                (other / name).mkdir(exist_ok=True)
        write_vouched(other, files)


def _pictures_of(folder: ResultsFolder, index: int) -> list[str]:
    """Return the names within a folder of the pictures of the runs of a part."""
    if not (folder.path / PICTURES).is_dir():
        return []
    rows = tables.read_tables(folder.path, [part_name(index, RUNS)], columns=("run_id",))
    names = [f"{PICTURES}/{run}.png" for run in rows["run_id"]]
    return [name for name in names if (folder.path / name).is_file()]
