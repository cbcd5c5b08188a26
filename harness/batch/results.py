"""A folder of results: `runs.parquet` (a row a run), `steps.parquet` (a row a period), `manifest.json`, `failures.log`.

While runs are under way, finished ones lie below `parts/`: a group of files for each run or block of runs, each written
atomically, rows last, so that a part counts once its rows are there. At the end the parts are put together; the module
`store` writes all of it. If the process was killed, a `ResultsFolder` reads the parts. A file that was changed since is
refused by name: `SHA256SUMS` has the checksums of all of them.
"""

import contextlib
import os
import re
from collections.abc import Collection, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias, final

import pandas as pd
import pyarrow.compute as pc

from servobench.harness.batch import schema, tables
from servobench.harness.batch.lock import LOCK, PARTS, refuse_links
from servobench.harness.batch.schema import MANIFEST, read_manifest
from servobench.harness.batch.tables import (
    DamagedFile,
    refuse_lacking,
    refuse_nameless,
    sums_of,
    writing,
)
from servobench.plant.contract.checksums import SUMS, Sums, append_sums, digest, fault
from servobench.plant.contract.faults import ConfigurationError, one_line
from servobench.plant.contract.files import PARTIAL

Manifest: TypeAlias = schema.Manifest
PICTURES = "pictures"
RUNS = "runs.parquet"
STEPS = "steps.parquet"
FAILURES = "failures.log"
STOPPED = (
    "runs ended when they were decided: intervals and p-values are for a fixed number of seeds"
)
PART = re.compile(rf"(\d{{8}})\.({re.escape(RUNS)}|{re.escape(STEPS)}|{re.escape(FAILURES)})")


def part_name(index: int, kind: str) -> str:
    """Return the name within a results folder of a file of the part that begins with the run `index`."""
    return f"{PARTS}/{index:08d}.{kind}"


def wanted_runs(manifest: Manifest) -> int:
    """Return the number of runs of a batch, or of those that decided it; 0 where its manifest does not tell."""
    decided = manifest.get("until_decided", {}).get("runs")
    return int(decided or manifest.get("run_count", 0))


def missing_line(count: int, wanted: int) -> str:
    """Return a line for the user that other than the `wanted` runs are finished; an empty text if these are."""
    if 0 < wanted < count:
        return f"{count} runs are there, and the manifest is of {wanted}: a file of another folder is among them"
    if count < wanted:
        return f"{count} of {wanted} runs are there: --resume carries out the others"
    return ""


@final
class ResultsFolder:
    """A results folder, opened once and then asked: for its manifest, its tables and the state of its files.

    The manifest is read once. Names of files and checksums are those of the moment, as the batch may still be under
    way; `SHA256SUMS` is read again only if it was written meanwhile. Errors come with the first question: a damaged
    folder can be opened, examined and mended.

    Attributes:
        path: of the folder.
        added: columns that the table of runs gets when it is read, as name -> run_id -> value.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.added: dict[str, dict[str, float]] = {}

    @cached_property
    def manifest(self) -> Manifest:
        """The manifest, read and checked with the first question.

        Raises:
            ConfigurationError: not a results folder, or one with a link in it.
            OtherSchema: one of another schema.
            DamagedFile: the manifest was changed, or an entry has another type than it should.
        """
        if os.path.lexists(self.path / MANIFEST):
            refuse_links(self.path)
        if self.expects(MANIFEST):
            self.refuse_damaged([MANIFEST])
        return read_manifest(self.path)

    @property
    def run_count(self) -> int:
        """The number of runs of the batch, or of those that decided it; 0 where the manifest does not tell."""
        return wanted_runs(self.manifest)

    @property
    def configuration(self) -> dict[str, dict[str, Any]]:
        """The settings of the runs by section and name; empty where the manifest has none."""
        return dict(self.manifest.get("configuration", {}))

    def runs(self, *, parts: bool = False) -> pd.DataFrame:
        """Return the table of runs, also of a batch that was killed.

        Args:
            parts: read the parts, of which there may be more than an earlier table holds.

        Raises:
            ConfigurationError: not a results folder, one of another schema, a file of it is damaged, the table lacks
                a column that says which run a row is, or a run's identifier is unfit for the name of a file.
        """
        self.check_finished()
        names = self.part_names(RUNS)
        if not parts:
            names = self._intact(RUNS)
        runs = tables.read_tables(self.path, names)
        first = self.path / names[0]
        refuse_lacking(first, "runs", tables.common_schema(self.path, names))
        empty = {
            name: float
            for name, kind in runs.dtypes.items()
            if name in tables.NUMBERS and kind.kind == "O"
        }
        if empty:
            runs = runs.astype(empty)
        period = (self.manifest.get("changed") or {}).get("run.period")
        if isinstance(period, float):  # the period of all runs where no sweep varies it
            runs["period_s"] = runs["period_s"].fillna(period) if "period_s" in runs else period
        refuse_nameless(first, runs)
        return runs.assign(**{name: runs["run_id"].map(own) for name, own in self.added.items()})

    def iterate_runs(self, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
        """Yield the table of runs of a finished batch, some thousand rows at a time and those of `columns` it has."""
        self.refuse_damaged([RUNS])
        refuse_lacking(self.path / RUNS, "runs", tables.common_schema(self.path, [RUNS]))
        return tables.row_groups(self.path, RUNS, columns)

    def steps(
        self, run_ids: list[str] | None = None, columns: Collection[str] | None = None
    ) -> pd.DataFrame:
        """Return the table of steps, of all runs or of those named.

        Args:
            run_ids: of these runs only.
            columns: these only, as far as there are such; None for all.

        Raises:
            ConfigurationError: as for `runs`.
        """
        self.check_finished()
        self.check_steps()
        names = self._intact(STEPS)
        for name in names:
            refuse_lacking(self.path / name, "steps", tables.common_schema(self.path, [name]))
        only = None if run_ids is None else pc.field("run_id").isin(run_ids)
        steps = tables.read_tables(self.path, names, only, columns)
        if steps.empty:
            raise ConfigurationError(
                f"{self.path} holds no steps: every run ended before its first period"
            )
        if "time_s" in steps and not steps["time_s"].between(0.0, tables.MAX_TIME).all():
            raise ConfigurationError(f"{self.path} holds steps at no time")
        if len(run_ids or ()) == 1:
            return of_one_run(steps)
        return steps

    def other_tables(self) -> Iterator[tuple[str, pd.DataFrame]]:
        """Yield name and content of each further table, without runs and steps, such as the scores of a suite.

        Raises:
            ConfigurationError: one of them cannot be read.
        """
        for path in sorted(self.path.iterdir()):
            own = path.name in (RUNS, STEPS) or path.name.startswith(".")
            if own or path.suffix not in (".parquet", ".csv"):
                continue
            try:
                table = self._read_other(path)
            except (OSError, ValueError, OverflowError) as error:
                why = one_line(error)
                if isinstance(error, DamagedFile):
                    why = error.fault
                raise ConfigurationError(f"{path} is no table: {why}; move it elsewhere") from error
            yield path.stem, table

    def _read_other(self, path: Path) -> pd.DataFrame:
        if path.suffix == ".csv":
            return pd.read_csv(path)
        return tables.read_tables(self.path, [path.name])

    def describe_missing(self) -> str:
        """Return a line for the user that a batch is unfinished, or has no checksums; else an empty text.

        Raises:
            ConfigurationError: as for `runs`.
        """
        self.check_finished()
        count = sum(tables.row_count(self.path, name) for name in self._intact(RUNS))
        lines = [missing_line(count, self.run_count)]
        if self.manifest.get("until_decided"):
            lines.append(STOPPED)
        if self.sums is None:
            lines.append(f"{SUMS} is missing, so that nothing vouches for the tables")
        return "; ".join(filter(None, lines))

    def check_finished(self) -> None:
        """Refuse a folder without results of this schema.

        Raises:
            ConfigurationError: there are none; names the missing file or the other schema.
        """
        _ = self.manifest  # Whatever else is wrong, a wrong manifest is named first.
        if not (self.path / RUNS).is_file() and not self.part_indices():
            if self.expects(RUNS):
                self.refuse_damaged([RUNS])
            raise ConfigurationError(f"{self.path} holds no finished run")

    def check_runs(self, runs: pd.DataFrame) -> None:
        """Refuse a table of runs that is empty.

        Raises:
            ConfigurationError: it is.
        """
        if runs.empty:
            raise ConfigurationError(f"{self.path} holds no finished run")

    def has_steps(self) -> bool:
        """Return whether a table of steps was kept."""
        return self.expects(STEPS) or bool(self.part_names(STEPS))

    def check_steps(self) -> None:
        """Refuse a folder without a table of steps.

        Raises:
            ConfigurationError: none was kept.
        """
        if not self.has_steps():
            raise ConfigurationError(
                f"{self.path} holds no steps: a sweep keeps none; use run or compare"
            )

    def part_indices(self) -> list[int]:
        """Return the first run of each part that counts, in order."""
        matches = (PART.fullmatch(path.name) for path in (self.path / PARTS).glob(f"*.{RUNS}"))
        return sorted(int(match[1]) for match in matches if match)

    def part_names(self, kind: str) -> list[str]:
        """Return the names of the files of one kind that the parts have, or should have, in order."""
        names = (part_name(index, kind) for index in self.part_indices())
        return [name for name in names if self.expects(name)]

    def files_of_part(self, index: int) -> list[str]:
        """Return the names of the files that a part has, or should have, its rows last."""
        names = [part_name(index, kind) for kind in (STEPS, FAILURES, RUNS)]
        return [name for name in names if self.expects(name)]

    def finished_runs(self) -> list[range]:
        """Return the indices of the runs whose part is there, in order."""
        found = []
        for first in self.part_indices():
            count = tables.row_count(self.path, part_name(first, RUNS))
            found.append(range(first, first + count))
        return found

    def is_whole(self, wanted: int) -> bool:
        """Return whether the tables are undamaged, and have at least as many runs as are wanted."""
        if self.fault_of(RUNS) or (self.expects(STEPS) and self.fault_of(STEPS)):
            return False
        with contextlib.suppress(DamagedFile):
            return tables.row_count(self.path, RUNS) >= wanted
        return False

    @property
    def sums(self) -> Sums | None:
        """The checksums; None where the folder has none, as one of an earlier version.

        Raises:
            ConfigurationError: they cannot be read.
        """
        return sums_of(self.path)

    def expects(self, name: str) -> bool:
        """Return whether the folder has a file, or should have it."""
        return (self.path / name).exists() or name in (self.sums or {})

    def fault_of(self, name: str) -> str | None:
        """Return the fault of a file by the checksums, as a predicate; None if there is none."""
        return fault(self.path, name, self.sums)

    def refuse_damaged(self, names: Sequence[str]) -> None:
        """Refuse damaged files.

        Raises:
            DamagedFile: names the first one of some files.
        """
        for name in names:
            wrong = self.fault_of(name)
            if wrong is not None:
                raise DamagedFile(self.path, name, wrong)

    def vouch(self, paths: Sequence[Path]) -> None:
        """Write down the checksums of files that accompany the tables, such as figures, where there are checksums."""
        sums = self.sums
        if sums is None:
            return
        digests = {}
        for path in paths:
            if path.is_relative_to(self.path):
                digests[str(path.relative_to(self.path))] = digest(path)
        new = {name: each for name, each in digests.items() if each not in sums.get(name, ())}
        with writing(self.path):
            append_sums(self.path, new)

    def accompanying(self) -> dict[str, frozenset[str]]:
        """Return the checksums of the files that accompany the tables: networks, pictures, figures, the report."""
        tabled = (MANIFEST, RUNS, STEPS, FAILURES)
        return {
            name: each
            for name, each in (self.sums or {}).items()
            if name not in tabled and not name.startswith(f"{PARTS}/")
        }

    def unlisted(self) -> list[str]:
        """Return the names of the files that have no checksum, and of results folders within this one, with a `/`."""
        names = []
        for place, inside, files in os.walk(self.path):
            own = Path(place).relative_to(self.path)
            for each in list(inside):
                if (self.path / own / each / MANIFEST).exists():
                    names.append(f"{own / each}/")
                    inside.remove(each)
            if own != Path(PARTS):
                names += [str(own / each) for each in files if not PARTIAL.fullmatch(each)]
        listed = {SUMS, LOCK, *(self.sums or {})}
        return sorted(name for name in names if name not in listed)

    def _intact(self, kind: str) -> list[str]:
        """Return the names of the table of one kind, or of its parts, all of them undamaged."""
        names = [] if (self.path / kind).is_file() else self.part_names(kind)
        if not names and self.expects(kind):
            names = [kind]
        self.refuse_damaged(names)
        return names


def of_one_run(steps: pd.DataFrame) -> pd.DataFrame:
    """Return the steps of one run without the columns of other runs in its folder, with other features or joints."""
    known = steps.filter(regex="^(reference|joint_position|joint_velocity_command)_")
    absent = known.columns[known.isna().all()]
    features = absent.str.removeprefix("reference_")
    foreign = [*absent, *("feature_" + features), *("true_feature_" + features)]
    return steps.drop(columns=foreign, errors="ignore")


def load_runs(folder: Path) -> pd.DataFrame:
    """Return the table of runs of a results folder; see `ResultsFolder.runs`."""
    return ResultsFolder(folder).runs()


def load_steps(
    folder: Path, run_ids: list[str] | None = None, columns: Collection[str] | None = None
) -> pd.DataFrame:
    """Return the table of steps of a results folder; see `ResultsFolder.steps`."""
    return ResultsFolder(folder).steps(run_ids, columns)
