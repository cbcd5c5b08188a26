"""A folder of results: `runs.parquet` (a row a run), `steps.parquet` (a row a period), `manifest.json`, `failures.log`.

While runs are under way, finished ones lie below `parts/`: a group of files for each run or block of runs, each written
atomically, rows last, so that a part counts once its rows are there. At the end the parts are put together. If the
process was killed, `load_runs` and `load_steps` read the parts, and `collect` puts the finished ones together. A file
that was changed since is refused by name: `SHA256SUMS` has the checksums of all of them.
"""

import contextlib
import json
import os
import re
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds

from servobench.harness.batch import tables
from servobench.harness.batch.lock import LOCK, PARTS, check_empty, refuse_links
from servobench.harness.batch.tables import (
    DamagedFile,
    refuse_lacking,
    refuse_nameless,
    sums_of,
    writing,
)
from servobench.harness.config.description import plain
from servobench.harness.run.result import NETWORKS, RunResult, log_entry
from servobench.plant.contract.checksums import (
    SUMS,
    append_sums,
    digest,
    fault,
    keep_sums,
    write_vouched,
)
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import PARTIAL, accessing, write_atomically

PICTURES = "pictures"
RUNS = "runs.parquet"
STEPS = "steps.parquet"
FAILURES = "failures.log"
MANIFEST = "manifest.json"
PART: Final = re.compile(
    rf"(\d{{8}})\.({re.escape(RUNS)}|{re.escape(STEPS)}|{re.escape(FAILURES)})"
)


def create_folder(folder: Path, manifest: dict[str, Any]) -> None:
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


def write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    """Write `manifest.json`."""
    write_vouched(folder, {MANIFEST: _text(encode(manifest))})


def part_name(index: int, kind: str) -> str:
    """Return the name within a results folder of a file of the part that begins with the run `index`."""
    return f"{PARTS}/{index:08d}.{kind}"


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
    files: dict[str, Callable[[Path], object]] = {}
    if steps:
        frame = pa.Table.from_pandas(pd.concat(steps, ignore_index=True), preserve_index=False)
        files[part_name(index, STEPS)] = partial(
            tables.write_table, frame.replace_schema_metadata()
        )
    if failures:
        files[part_name(index, FAILURES)] = _text(failures)
    rows = tables.as_table([result.row for result in outcome])
    files[part_name(index, RUNS)] = partial(tables.write_table, rows, batch=f"{campaign}@{index}")
    with writing(folder):
        for result in outcome:
            _write_picture(folder / PICTURES / f"{result.row['run_id']}.png", result)
        write_vouched(folder, files)


def _write_picture(path: Path, result: RunResult) -> None:
    if result.picture is None:
        return
    import cv2  # noqa: PLC0415 - only pictures of cameras need it

    path.parent.mkdir(exist_ok=True)
    large = cv2.resize(result.picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    content = cv2.imencode(".png", cv2.cvtColor(large, cv2.COLOR_RGB2BGR))[1].tobytes()
    write_atomically(path, lambda file: file.write_bytes(content))


def write_summary(folder: Path, sweeps: dict[str, pd.DataFrame], manifest: dict[str, Any]) -> None:
    """Make a folder that holds several sweeps a results folder itself: one table of all their runs.

    Args:
        folder: the folder.
        sweeps: tables of runs by the name of the sweep; it becomes the column `part`.
        manifest: of the whole.

    Raises:
        UnwritableFolder: the folder takes no more files.
    """
    runs = pd.concat([table.assign(part=name) for name, table in sweeps.items()], ignore_index=True)
    rows = pa.Table.from_pandas(runs, preserve_index=False).replace_schema_metadata()
    with writing(folder):
        write_vouched(folder, {RUNS: partial(tables.write_table, rows)})
        write_manifest(folder, manifest)


def part_indices(folder: Path) -> list[int]:
    """Return the first run of each part that counts, in order."""
    matches = (PART.fullmatch(path.name) for path in (folder / PARTS).glob(f"*.{RUNS}"))
    return sorted(int(match[1]) for match in matches if match)


def part_names(folder: Path, kind: str) -> list[str]:
    """Return the names of the files of one kind that the parts have, or should have, in order."""
    names = (part_name(index, kind) for index in part_indices(folder))
    return [name for name in names if is_expected(folder, name)]


def copy_parts(parts: Iterable[tuple[Path, int]], other: Path) -> None:
    """Copy parts, each of a folder and beginning with a run, with pictures of their runs and networks into another one.

    Raises:
        ConfigurationError: a file of them is damaged.
        UnwritableFolder: the other folder takes no more files.
    """
    files: dict[str, Callable[[Path], object]] = {}
    for folder, index in parts:
        names = [part_name(index, kind) for kind in (STEPS, FAILURES, RUNS)]
        names = [name for name in names if is_expected(folder, name)]
        _refuse_damaged(folder, names)
        if (folder / PICTURES).is_dir():
            runs = tables.read_tables(folder, [part_name(index, RUNS)], columns=("run_id",))[
                "run_id"
            ]
            names = [
                name for run in runs if (folder / (name := f"{PICTURES}/{run}.png")).is_file()
            ] + names
        names += [f"{NETWORKS}/{path.name}" for path in sorted((folder / NETWORKS).glob("*.npz"))]
        files |= {name: partial(shutil.copyfile, folder / name) for name in names}
    with writing(other):
        for name in (PICTURES, NETWORKS):
            if any(file.startswith(name) for file in files):
                (other / name).mkdir(exist_ok=True)
        write_vouched(other, files)


def finished_runs(folder: Path) -> list[range]:
    """Return the indices of the runs whose part is there, in order."""
    return [
        range(own, own + tables.row_count(folder, part_name(own, RUNS)))
        for own in part_indices(folder)
    ]


def is_whole(folder: Path, wanted: int) -> bool:
    """Return whether the tables of a folder are undamaged, and have at least as many runs as are wanted."""
    if any(
        file_fault(folder, name)
        for name in (RUNS, STEPS)
        if name == RUNS or is_expected(folder, name)
    ):
        return False
    with contextlib.suppress(DamagedFile):
        return tables.row_count(folder, RUNS) >= wanted
    return False


def collect(folder: Path) -> int:
    """Put the parts together into the two tables and the log and, unless runs are missing, remove them.

    Returns:
        Number of runs.

    Raises:
        ConfigurationError: there are no parts and no tables, or a file is damaged.
        UnwritableFolder: the folder takes no more files.
    """
    load_runs(folder)  # refuses a table of anything else
    return put_together(folder, read_manifest(folder))


def put_together(folder: Path, manifest: Mapping[str, Any]) -> int:
    """Put the parts of a folder with this manifest together; result and errors are those of `collect`."""
    wanted, campaign = manifest.get("run_count", 0), manifest.get("campaign", "")
    if is_whole(folder, wanted):  # at most the clean-up is left
        shutil.rmtree(folder / PARTS, ignore_errors=True)
        return tables.row_count(folder, RUNS)
    if not part_indices(folder):
        _refuse_damaged(folder, [name for name in (RUNS, STEPS) if is_expected(folder, name)])
        raise ConfigurationError(f"{folder} holds no finished run")
    files: dict[str, Callable[[Path], object]] = {}
    for kind in (STEPS, FAILURES, RUNS):
        names = part_names(folder, kind)
        _refuse_damaged(folder, names)
        if names and kind == FAILURES:
            files[kind] = _text(
                "".join((folder / name).read_text(encoding="utf-8") for name in names)
            )
        elif names:
            files[kind] = partial(tables.join, folder, names, campaign)
    with writing(folder):
        write_vouched(folder, files)
        vouch(folder, [folder / name for name in unlisted(folder) if not name.endswith("/")])
        count = tables.row_count(folder, RUNS)
        if count >= wanted:
            kept = {name: frozenset([digest(folder / name)]) for name in [MANIFEST, *files]}
            keep_sums(folder, kept | accompanying(folder))
            shutil.rmtree(folder / PARTS)
    return count


def vouch(folder: Path, paths: Sequence[Path]) -> None:
    """Write down the checksums of files that accompany the tables, such as figures, where the folder has checksums."""
    if (sums := sums_of(folder)) is not None:
        digests = {
            f"{path.relative_to(folder)}": digest(path)
            for path in paths
            if path.is_relative_to(folder)
        }
        with writing(folder):
            append_sums(
                folder,
                {name: each for name, each in digests.items() if each not in sums.get(name, ())},
            )


def accompanying(folder: Path) -> dict[str, frozenset[str]]:
    """Return the checksums of the files that accompany the tables: networks, pictures, figures, the report."""
    tabled = (MANIFEST, RUNS, STEPS, FAILURES)
    sums = sums_of(folder) or {}
    return {
        name: each
        for name, each in sums.items()
        if name not in tabled and not name.startswith(f"{PARTS}/")
    }


def unlisted(folder: Path) -> list[str]:
    """Return the names of the files of a folder that have no checksum, and of results folders within it, with a `/`."""
    names, sums = list[str](), sums_of(folder) or {}
    for place, inside, files in os.walk(folder):
        for each in [each for each in inside if (Path(place) / each / MANIFEST).exists()]:
            names.append(f"{(Path(place) / each).relative_to(folder)}/")
            inside.remove(each)
        if Path(place) != folder / PARTS:
            names += [
                f"{(Path(place) / each).relative_to(folder)}"
                for each in files
                if not PARTIAL.fullmatch(each)
            ]
    return sorted(name for name in names if name not in sums and name not in (SUMS, LOCK))


def load_runs(folder: Path) -> pd.DataFrame:
    """Return the table of runs of a results folder, also of one whose batch was killed.

    Raises:
        ConfigurationError: not a results folder, one of another schema, a file of it is damaged, or the
            table lacks a column that says which run a row is, or a run's identifier is unfit for the name of a file.
    """
    manifest, names = check_folder(folder), _intact(folder, RUNS)
    runs = tables.read_tables(folder, names)
    refuse_lacking(folder / names[0], "runs", tables.common_schema(folder, names))
    empty = {
        name: float
        for name, kind in runs.dtypes.items()
        if name in tables.NUMBERS and kind.kind == "O"
    }
    runs = runs.astype(empty) if empty else runs
    period = (manifest.get("changed") or {}).get("run.period")
    if isinstance(period, float):  # the period of all runs where no sweep varies it
        runs["period_s"] = runs["period_s"].fillna(period) if "period_s" in runs else period
    refuse_nameless(folder / names[0], runs)
    return runs


def describe_missing(folder: Path) -> str:
    """Return a line for the user that a batch is unfinished, or has no checksums; else an empty text.

    Raises:
        ConfigurationError: as for `load_runs`.
    """
    check_folder(folder)
    count = sum(tables.row_count(folder, name) for name in _intact(folder, RUNS))
    unvouched = (
        f"{SUMS} is missing, so that nothing vouches for the tables"
        if sums_of(folder) is None
        else ""
    )
    return "; ".join(
        filter(None, (missing_line(count, read_manifest(folder).get("run_count", 0)), unvouched))
    )


def missing_line(count: int, wanted: int) -> str:
    """Return a line for the user that other than the `wanted` runs are finished; an empty text if these are."""
    if 0 < wanted < count:
        return f"{count} runs are there, and the manifest is of {wanted}: a file of another folder is among them"
    if count < wanted:
        return f"{count} of {wanted} runs are there: --resume carries out the others"
    return ""


def iterate_runs(folder: Path, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
    """Yield the table of runs of a finished batch, some thousand rows at a time and those of `columns` it has."""
    _refuse_damaged(folder, [RUNS])
    refuse_lacking(folder / RUNS, "runs", tables.common_schema(folder, [RUNS]))
    return tables.row_groups(folder, RUNS, columns)


def load_steps(
    folder: Path, run_ids: list[str] | None = None, columns: Collection[str] | None = None
) -> pd.DataFrame:
    """Return the table of steps, of all runs or of those named.

    Args:
        folder: a results folder.
        run_ids: of these runs only.
        columns: these only, as far as there are such; None for all.

    Raises:
        ConfigurationError: as for `load_runs`.
    """
    check_folder(folder)
    check_steps(folder)
    names = _intact(folder, STEPS)
    for name in names:
        refuse_lacking(folder / name, "steps", tables.common_schema(folder, [name]))
    steps = tables.read_tables(
        folder, names, None if run_ids is None else ds.field("run_id").isin(run_ids), columns
    )
    if steps.empty:
        raise ConfigurationError(
            f"{folder} holds no steps: every run ended before its first period"
        )
    if "time_s" in steps and not steps["time_s"].between(0.0, tables.MAX_TIME).all():
        raise ConfigurationError(f"{folder} holds steps at no time")
    return steps


def other_tables(folder: Path) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield name and content of each further table of a folder, without runs and steps, such as answered claims.

    Raises:
        ConfigurationError: one of them cannot be read.
    """
    for path in sorted(folder.iterdir()):
        own = path.name in (RUNS, STEPS) or path.name.startswith(".")
        if own or path.suffix not in (".parquet", ".csv"):
            continue
        try:
            table = (
                pd.read_csv(path)
                if path.suffix == ".csv"
                else tables.read_tables(folder, [path.name])
            )
        except (OSError, ValueError, OverflowError) as error:
            why = error.fault if isinstance(error, DamagedFile) else " ".join(str(error).split())
            raise ConfigurationError(f"{path} is no table: {why}; move it elsewhere") from error
        yield path.stem, table


def has_steps(folder: Path) -> bool:
    """Return whether a results folder has a table of steps."""
    return is_expected(folder, STEPS) or bool(part_names(folder, STEPS))


def check_steps(folder: Path) -> None:
    """Refuse a folder without a table of steps.

    Raises:
        ConfigurationError: none was kept.
    """
    if not has_steps(folder):
        raise ConfigurationError(f"{folder} holds no steps: a sweep keeps none; use run or compare")


def check_runs(folder: Path, runs: pd.DataFrame) -> None:
    """Refuse a folder whose table of runs is empty.

    Raises:
        ConfigurationError: it is.
    """
    if runs.empty:
        raise ConfigurationError(f"{folder} holds no finished run")


def check_folder(folder: Path) -> dict[str, Any]:
    """Return the manifest of a folder with results of this schema.

    Raises:
        ConfigurationError: there are none; names the missing file or the other schema.
    """
    manifest = read_manifest(folder)
    if not (folder / RUNS).is_file() and not part_indices(folder):
        _refuse_damaged(folder, [RUNS] if is_expected(folder, RUNS) else [])
        raise ConfigurationError(f"{folder} holds no finished run")
    return manifest


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a results folder.

    Raises:
        ConfigurationError: not a results folder, or one with a link in it.
        OtherSchema: one of another schema.
        DamagedFile: the manifest was changed, or an entry has another type than it should.
    """
    if os.path.lexists(folder / MANIFEST):
        refuse_links(folder)
    if is_expected(folder, MANIFEST):
        _refuse_damaged(folder, [MANIFEST])
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        why = f"its {MANIFEST} cannot be read" if folder.exists() else "it does not exist"
        there = [] if (folder / MANIFEST).exists() else sorted(folder.glob(f"*/{MANIFEST}"))
        inside = (f"take one that is in it, such as {each.parent}" for each in there)
        raise ConfigurationError(
            f"{folder} is not a results folder: {next(inside, why)}"
        ) from error
    version = manifest.get("schema_version") if isinstance(manifest, dict) else None
    if version != SCHEMA_VERSION:
        raise OtherSchema(
            f"{folder} has results of schema {version!r}; this servobench reads {SCHEMA_VERSION!r}"
            f"{CHANGES.get(str(version), '')}; read it with the servobench that wrote it"
        )
    for key, types in ENTRIES.items():
        if key in manifest and not _has_type(manifest[key], *types):
            wanted, came = " of ".join(WORDS[each] for each in types), str(manifest[key])[:SHOWN]
            raise DamagedFile(folder, MANIFEST, f"is damaged: {key} must be {wanted}, got {came!r}")
    return dict(manifest)


def is_expected(folder: Path, name: str) -> bool:
    """Return whether a folder has a file, or should have it."""
    return (folder / name).exists() or name in (sums_of(folder) or {})


def file_fault(folder: Path, name: str) -> str | None:
    """Return the fault of a file by the checksums of its folder, as a predicate; None if there is none."""
    return fault(folder, name, sums_of(folder))


def _intact(folder: Path, kind: str) -> list[str]:
    """Return the names of the table of one kind, or of its parts, all of them undamaged."""
    names = [] if (folder / kind).is_file() else part_names(folder, kind)
    names = names or [kind] * is_expected(folder, kind)
    _refuse_damaged(folder, names)
    return names


def _refuse_damaged(folder: Path, names: Sequence[str]) -> None:
    """Raise a `DamagedFile` that names the first damaged one of some files."""
    for name in names:
        if (wrong := file_fault(folder, name)) is not None:
            raise DamagedFile(folder, name, wrong)


def _text(text: str) -> Callable[[Path], object]:
    return lambda file: file.write_text(text, encoding="utf-8", errors="backslashreplace")


SCHEMA_VERSION = "4"
# Since an earlier schema
CHANGES: Final = {"3": "; the column latency_periods [periods] is now latency_s [s]"}
ENTRIES: Final[dict[str, tuple[type, ...]]] = {  # of a manifest: its type, and that of its elements
    "created": (str,), "python": (str,), "platform": (str,), "campaign": (str,), "seeds": (str,), "run_count": (int,),
    "plants": (list, str), "controllers": (list, str), "tasks": (list, str), "mismatches": (list, str),
    "robots": (list, dict), "configuration": (dict, dict), "changed": (dict,), "own_controllers": (dict, dict),
    "own_plants": (dict, dict), "own_tasks": (dict, dict), "plugins": (dict, dict), "packages": (dict,),
    "engines": (dict,), "blas": (list, dict), "files": (dict, str), "side_by_side": (dict, list),
}  # fmt: skip
WORDS: Final = {str: "text", int: "a whole number", list: "a list", dict: "an object"}
SHOWN: Final = 60  # letters of a wrong value that a message holds


class OtherSchema(ConfigurationError):
    """A results folder is of another version of this package."""


def encode(manifest: Mapping[str, Any]) -> str:
    """Return a manifest as text; JSON has no infinity, so a setting without limit reads "inf"."""
    return json.dumps(plain({"schema_version": SCHEMA_VERSION, **manifest}), indent=2) + "\n"


def _has_type(value: Any, kind: type, inner: type | None = None) -> bool:  # noqa: ANN401 - any JSON
    elements = value.values() if isinstance(value, dict) else value
    return type(value) is kind and (inner is None or all(type(each) is inner for each in elements))
