"""The damage of a results folder, and its repair by `--resume`: only runs of damaged files are carried out again."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass

from servobench.harness.batch import tables
from servobench.harness.batch.lock import PARTS, refuse_links
from servobench.harness.batch.results import (
    FAILURES,
    PART,
    RUNS,
    STEPS,
    Manifest,
    ResultsFolder,
    part_name,
    wanted_runs,
)
from servobench.harness.batch.schema import MANIFEST, OtherSchema
from servobench.harness.batch.store import write_manifest
from servobench.harness.batch.tables import DamagedFile, lacking, writing
from servobench.harness.run.result import log_entry
from servobench.plant.contract.checksums import SUMS, digest, keep_sums, write_vouched
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import PARTIAL

AGAIN = "repeat the command that made the folder with --resume"
REMADE = (
    "servobench report makes the page anew; the rest comes with the runs, "
    "from the same command in a new folder"
)


@dataclass(frozen=True)
class Finding:
    """A damaged file of a results folder."""

    name: str  # name of the file within the folder
    fault: str  # a predicate of the file
    remedy: str  # for the user


@dataclass(frozen=True)
class Examination:
    """The result of an examination of a results folder."""

    findings: list[Finding]  # damaged files
    files: int  # number of examined files
    runs: int  # number of intact runs
    wanted: int  # number of runs of the batch; 0 where the folder does not tell
    # files without a checksum, and results folders within the folder, which are examined one by one
    left_out: list[str]


def examine(folder: ResultsFolder) -> Examination:
    """Read all files of a results folder and list the damaged ones.

    Raises:
        ConfigurationError: there is no such folder, nothing of a batch or a link is in it, or its table has wrong
            columns or identifiers.
    """
    check_resumable(folder)
    refuse_links(folder.path)
    findings = []
    manifest = {}
    try:
        manifest = folder.manifest
    except OtherSchema:
        raise
    except ConfigurationError as error:
        unread = error.fault if isinstance(error, DamagedFile) else "cannot be read"
        findings.append(
            Finding(
                MANIFEST, unread, f"{AGAIN}; it is written anew if the runs are of that command"
            )
        )
    if folder.sums is None:
        remedy = f"if you trust the files as they are: cd {folder.path} && sha256sum {MANIFEST} *.parquet > {SUMS}"
        findings.append(
            Finding(SUMS, "is missing, so that nothing vouches for the other files", remedy)
        )
    names = [name for name in (RUNS, STEPS, FAILURES) if folder.expects(name)]
    faults = {name: wrong for name in names if (wrong := _fault(folder, name))}
    for name, wrong in faults.items():
        remedy = (
            "it is written anew, without traces"
            if name == FAILURES
            else "runs that are in no part are repeated"
        )
        findings.append(Finding(name, wrong, f"{AGAIN}; {remedy}"))
    count = 0
    for part in _parts(folder, manifest):
        names += part.names
        count += part.count
        if part.fault:
            findings.append(
                Finding(part.wrong, part.fault, f"{AGAIN}; only the runs of this part are repeated")
            )
    strays = [
        path.name
        for path in sorted((folder.path / PARTS).glob("[!.]*"))
        if not PART.fullmatch(path.name)
    ]
    findings += [
        Finding(f"{PARTS}/{name}", "is no file of a batch", "move it elsewhere") for name in strays
    ]
    if RUNS in names and not faults.keys() & {RUNS, STEPS}:
        count = max(count, tables.row_count(folder.path, RUNS))
    if count and not findings:
        folder.runs()  # refuses wrong columns and identifiers
    beside = folder.accompanying()
    for name in beside:
        if wrong := folder.fault_of(name):
            findings.append(Finding(name, wrong, REMADE))
    left_out = [name for name in folder.unlisted() if name not in names and name != MANIFEST]
    return Examination(
        findings, len(names) + 1 + len(beside), count, wanted_runs(manifest), left_out
    )


def check_resumable(folder: ResultsFolder) -> None:
    """Refuse a folder in which nothing of a batch is left.

    Raises:
        ConfigurationError: names it.
    """
    if not any((folder.path / name).exists() for name in (MANIFEST, RUNS, SUMS, PARTS)):
        _ = folder.manifest  # The error says why there is none.


def mend(folder: ResultsFolder, manifest: Manifest) -> Iterator[str]:
    """Remove the damaged files of a folder whose batch is to go on, so that their runs count as missing.

    Args:
        folder: a results folder that is locked.
        manifest: of the batch.

    Yields:
        A line for each damaged file.
    """
    path = folder.path
    sums = folder.sums or {}
    kept: dict[str, frozenset[str]] = {}
    with writing(path):
        for part in _parts(folder, manifest):
            if part.fault:
                yield f"{path / part.wrong} {part.fault}: its runs are carried out again"
                for name in reversed(
                    part.names
                ):  # the rows first: without them the part does not count
                    (path / name).unlink(missing_ok=True)
            else:
                kept |= {name: frozenset([digest(path / name)]) for name in part.names}
        for name in (MANIFEST, RUNS, STEPS, FAILURES):
            wrong = _fault(folder, name) if folder.expects(name) else None
            if name in sums:
                kept[name] = sums[name]
            elif (wrong is None or name == MANIFEST) and (path / name).exists():
                kept[name] = frozenset([digest(path / name)])
            if wrong and name in (RUNS, STEPS):
                yield f"{path / name} {wrong}: runs that are in no part are carried out again"
        keep_sums(path, kept | folder.accompanying())
        for left in (*path.glob(".*"), *(path / PARTS).glob(".*")):
            if PARTIAL.fullmatch(left.name):  # by a process that was killed
                left.unlink()
        if not folder.is_whole(wanted_runs(manifest)):
            (path / PARTS).mkdir(exist_ok=True)
            return
        if FAILURES in kept and (wrong := folder.fault_of(FAILURES)):
            yield f"{path / FAILURES} {wrong}: it is written anew, without traces"
            write_vouched(
                path, {FAILURES: lambda file: file.write_text(_log(folder), encoding="utf-8")}
            )


def restore_manifest(folder: ResultsFolder, manifest: Manifest) -> str:
    """Write a manifest anew that is damaged or missing, if all intact tables say that they are of that batch.

    Args:
        folder: a folder that is locked.
        manifest: of the batch that is asked for.

    Returns:
        A line that says so; empty where nothing was to be done.

    Raises:
        ConfigurationError: tables are of another batch or do not say of which, or the folder is of another schema.
    """
    path = folder.path
    try:
        _ = folder.manifest
    except DamagedFile as error:
        damage = error
    except ConfigurationError:
        if (path / MANIFEST).exists():
            raise
        damage = DamagedFile(path, MANIFEST, "is missing")
    else:
        return ""
    names = [part_name(index, RUNS) for index in folder.part_indices()]
    if (path / RUNS).exists():
        names.append(RUNS)
    owners = set()
    for name in names:
        with contextlib.suppress(DamagedFile):  # which is made again in any case
            owners.add(tables.owner(path, name).partition("@")[0])
    if owners != {manifest["campaign"]}:
        raise ConfigurationError(
            f"{path / MANIFEST} {damage.fault}, and the tables are not of this batch or do not say so; "
            "restore the file from a copy, or give another folder as `out`"
        ) from damage
    with writing(path):
        write_manifest(path, manifest)
    return f"{path / MANIFEST} {damage.fault}: it is written anew"


@dataclass(frozen=True)
class _Part:
    names: list[str]  # names of its files within the folder, rows last
    count: int  # number of its runs that are intact
    wrong: str  # name of its damaged file, or of its rows
    fault: str  # fault of that file; empty if there is none


def _parts(folder: ResultsFolder, manifest: Manifest) -> Iterator[_Part]:
    """Yield the parts of a folder, in order; where the manifest does not tell the batch, parts may be of any."""
    campaign = manifest.get("campaign")
    end = 0
    for index in folder.part_indices():
        names = folder.files_of_part(index)
        rows = part_name(index, RUNS)
        count = 0
        faults = {name: wrong for name in names if (wrong := _fault(folder, name))}
        name, wrong = next(iter(faults.items()), (rows, ""))
        if not wrong:
            count = tables.row_count(folder.path, rows)
            batch, _, first = tables.owner(folder.path, rows).rpartition("@")
            if batch not in ("", campaign or batch):
                wrong = "holds the rows of another batch"
            elif first not in ("", f"{index}"):
                wrong = "holds the rows of other runs"
            elif index < end:
                wrong = "holds runs that the part before it has, too"
            elif index + count > manifest.get("run_count", math.inf):
                wrong = "holds more runs than the batch has"
            else:
                end = index + count
        yield _Part(names, 0 if wrong else count, name, wrong)


def _fault(folder: ResultsFolder, name: str) -> str | None:
    """Return the fault of a file; a table without a checksum is read as a whole."""
    wrong = folder.fault_of(name)
    if wrong is None and folder.sums is None and name.endswith(".parquet"):
        try:
            schema = tables.common_schema(folder.path, [name])
            for _ in tables.row_groups(folder.path, name, schema.names):
                pass
            wrong = lacking("runs" if name.endswith(RUNS) else "steps", schema) or None
        except DamagedFile as error:
            return error.fault
    return wrong


def _log(folder: ResultsFolder) -> str:
    """Return the log of failures as far as it can be made from the table of runs."""
    groups = tables.row_groups(folder.path, RUNS, ("run_id", "status", "reason"))
    rows = (
        dict(zip(group.columns, row, strict=True)) for group in groups for row in group.to_numpy()
    )
    return "".join(log_entry(row, "") for row in rows)
