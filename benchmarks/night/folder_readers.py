"""What reads a results folder, a study or an entry of the cache, for fuzzing: others may have written any file of it.

A reader gets what one file holds instead of what was written; the files beside it are whole. Nothing vouches for the
tables, as in a folder of another program, so that they are read and not only found to be changed.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import pandas as pd

from servobench.harness.analysis.folder import describe_folder, describe_settings
from servobench.harness.analysis.tables import statistics_tables
from servobench.harness.batch import results
from servobench.harness.batch.integrity import examine
from servobench.harness.batch.lock import LOCK, current_holder, locked
from servobench.harness.run.result import RunResult
from servobench.harness.studies.tuning.objective import Ledger
from servobench.plant.contract import cache as entries
from servobench.plant.contract.checksums import SUMS
from servobench.plant.contract.faults import ConfigurationError

SCORES = {"objective": 3, "robots": 2}
LEDGER = json.dumps(SCORES) + '\n{"settings": {"law": {"gain": 1.5}}, "costs": [0.5, 2]}\n'
ENTRY_SUMS = "2c26b46b68ffc68ff99b453c1d30413413422d706483bfa0f98a5e886266e7ae  files/a/b.txt\n"  # of the text foo
HOLDER = '{"owner": "ann", "host": "bench", "pid": 4, "begun": "2026-11-22T01:00:00+00:00", "started": "17"}'
MANIFEST = {
    "run_count": 2, "campaign": "c", "created": "2026-11-22T01:00:00+00:00", "python": "3.11.7", "seeds": "0:2",
    "plants": ["kinematic"], "controllers": ["rls"], "robots": [{"name": "ur5"}], "packages": {"numpy": "2.0"},
    "configuration": {"run": {"period": 0.05}}, "side_by_side": {},
}  # fmt: skip


def of_runs(name: str, *, parts: bool = False) -> Callable[[str | bytes, Path], None]:
    """Return a reader of a results folder in which one file is the input.

    Args:
        name: of the file.
        parts: the batch is under way.
    """

    def read(given: str | bytes, folder: Path) -> None:
        whole = files(parts=parts)
        vouched = whole if name == SUMS else {each: text for each, text in whole.items() if each != SUMS}
        _read_folder(_write(folder / "out", {**vouched, name: _bytes(given)}))

    return read


def part_name(name: str, folder: Path) -> None:
    """Read a folder with a stray file among the parts."""
    place = _write(folder / "out", files(parts=True))
    if name and not set(name) & set("/\0") and len(name.encode(errors="surrogatepass")) < 200 and name.strip("."):
        content = (place / results.part_name(0, results.RUNS)).read_bytes()
        (place / results.PARTS / name).write_bytes(content)
    _read_folder(place)


def other_table(text: str, folder: Path) -> None:
    """Read a folder with a table of somebody beside those of the batch."""
    place = _write(folder / "out", {**files(), "mine.csv": _bytes(text)})
    for _ in results.other_tables(place):
        pass


def lock(text: str, folder: Path) -> None:
    """Take a folder over that another process holds, or held."""
    place = _write(folder / "out", {LOCK: _bytes(text)})
    assert len(str(current_holder(place)).splitlines()) == 1
    with locked(place) as taken:
        taken.check()


def journal(text: str, folder: Path) -> None:
    """Read the scores of a study, and go on."""
    (folder / "study.jsonl").write_bytes(_bytes(text))
    ledger = Ledger(folder / "study.jsonl", SCORES)
    assert ledger.best() is None or len(ledger)
    ledger.add({"law": {"gain": 2.0}}, [0.25])
    again = Ledger(folder / "study.jsonl", SCORES)
    assert (again.best(), len(again)) == (ledger.best(), len(ledger))


def cache_entry(text: str, folder: Path) -> None:
    """Check an entry of the cache with any checksums: it is whole or made anew."""
    files_of_entry = {f"{entries.FILES}/a/b.txt": b"foo", SUMS: _bytes(text)}
    assert entries.is_whole(_write(folder / "entry", files_of_entry)) in (True, False)


@cache
def files(*, parts: bool = False) -> dict[str, bytes]:
    """Return the files of a results folder by name; those of a batch under way, or at its end."""
    keys = {"plant": "kinematic", "controller": "rls", "task": "random", "task_kind": "point_to_point"}
    row = {"run_id": "a", **keys, "mismatch": "moderate", "seed": 0, "status": "completed", "settling_time_s": 0.5}
    steps = pd.DataFrame({"run_id": ["a", "a"], "time_s": [0.0, 0.05], "error_norm": [0.2, 0.1]})
    lost = {"run_id": "b", "seed": 1, "status": "feature_lost", "settling_time_s": None, "reason": "é\n"}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "out"
        results.create_folder(folder, MANIFEST)
        results.write_part(folder, 0, [RunResult(row, steps)], "c")
        results.write_part(folder, 1, [RunResult(row | lost, None, trace="here")], "c")
        if not parts:
            results.collect(folder)
        return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _read_folder(folder: Path) -> None:
    """Read a folder by everything that reads one, and raise the first refusal at the end."""
    refusals = []
    readers: tuple[Callable[[Path], object], ...] = (
        results.read_manifest, results.load_runs, results.load_steps, results.finished_runs, examine,
        describe_settings, _judged, results.collect,
    )  # fmt: skip
    for read in readers:
        try:
            read(folder)
        except ConfigurationError as error:
            refusals.append(error)
    if refusals:
        raise ConfigurationError(str(refusals[0]))


def _judged(folder: Path) -> None:
    runs = results.load_runs(folder)
    describe_folder(folder, runs)
    list(statistics_tables(runs))


def _write(folder: Path, content: Mapping[str, bytes]) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    for name, text in content.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(text)
    return folder


def _bytes(given: str | bytes) -> bytes:
    return given if isinstance(given, bytes) else given.encode(errors="surrogatepass")
