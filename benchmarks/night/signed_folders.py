"""Results folders of strangers: good ones, changed and mostly signed again, given to the commands that read folders.

    PYTHONPATH=tests:benchmarks python -m night.signed_folders --folders 10000

Each folder meets its commands in a child of a process that has all modules in memory. Counted are traces, refusals of
more than one line, hangs, files written outside of the places that the user named, and values that are wrong in
silence: of a folder that was not signed again, an output that is not the one of the good folder; of one that was, an
exported table that is not the table within. `--first N --folders 1` repeats the folder of one number.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import matplotlib.font_manager  # noqa: F401 - fills its cache before anything is noted
import pandas as pd
import pyarrow as pa
import pyarrow.parquet

from kit.writes import noting
from measuring import options
from night.children import answered
from night.fuzzing import drawn
from night.parsers import Parser
from servobench.harness.batch import results
from servobench.harness.cli.main import main as servobench
from servobench.plant.contract.checksums import SUMS, digest

RUN: Final = "kinematic-constant-exp1-moderate-0"
PAYLOADS: Final = (
    "../../escaped", "/tmp/escaped", "..", "=cmd|'/C calc'!A1", "$(touch escaped)", "<script>x</script>", "x\n## y",
    "%s{0}", "\x1b]0;b\x07", "\u202e", "", "a" * 300, r"\input{x}", "evil.py:Mine", "-rf", "é\0",
)  # fmt: skip
VALUES: Final = (
    None, float("nan"), float("inf"), -float("inf"), -1, 0, 2**63 - 1, 1e308, -1e-300, 0.5, True, b"\xff", [1, [2]],
    {"a": 1}, [], "1", *PAYLOADS,
)  # fmt: skip
BATCH: Final = "--controllers constant,calibrated --plants kinematic --tasks exp1,circle --seeds 0:2 --workers 1"
SHORT: Final = "--set exp1.duration=1 --set circle.laps=1 --no-report --no-figures"
COMMANDS: Final = {  # and how often, relative to the others
    "statistics {}": 6, "statistics {} --json": 6, "statistics {} --latex": 3, "verify {}": 8, "collect {}": 4,
    "export {} --out out/csv": 8, "export {} --out out/mcap --format mcap": 4, "figures {} --kind errors": 3,
    f"shadow {{}} --run {RUN} --controller constant --out out/seen.csv": 2, "merge {} other --out out/merged": 2,
    f"compare {BATCH} {SHORT} --resume --out {{}}": 2, "report {}": 0.15,
    f"record {{}} --run {RUN} --kinds snapshots": 0.1,
}  # fmt: skip
EXPORT: Final = "export {} --out out/csv"
UNCHANGED: Final = ("statistics {}", "statistics {} --json", "statistics {} --latex", EXPORT)
"""Commands whose output of an unsigned folder is as before; or they refuse it."""
HANG: Final = 90.0  # [s] for the commands of a folder
CPU: Final = 40  # [s] of the processor, likewise
SHOWN: Final = 200  # faults that are printed at most
MEMORY: Final = 4 * 10**9  # [bytes] more addresses than the parent has


def good_folders(place: Path) -> list[Path]:
    """Return a finished comparison, one that was left behind half-way, and a part of a batch."""
    batch = ["compare", *BATCH.split(), *SHORT.split(), "--out"]
    for name, further in (
        ("whole", []),
        ("half", []),
        ("part", ["--part", "1/2"]),
        ("other", ["--part", "2/2"]),
    ):
        assert call([*batch, str(place / name), *further]) == 0, name
    half = place / "half"
    runs, steps = pd.read_parquet(half / results.RUNS), pd.read_parquet(half / results.STEPS)
    (half / results.PARTS).mkdir()
    for index, run_id in enumerate(runs["run_id"][:5]):
        runs[runs["run_id"] == run_id].to_parquet(half / results.part_name(index, results.RUNS))
        steps[steps["run_id"] == run_id].to_parquet(half / results.part_name(index, results.STEPS))
    (half / results.RUNS).unlink()
    (half / results.STEPS).unlink()
    sign(half)
    return [place / name for name in ("whole", "whole", "half", "part")]


def sign(folder: Path) -> None:
    """Write checksums of all files as they are."""
    names = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
    lines = (
        f"{digest(path)}  {path.relative_to(folder)}\n"
        for path in names
        if path.name not in (SUMS, ".lock")
    )
    if (folder / SUMS).is_file() and not (folder / SUMS).is_symlink():
        (folder / SUMS).write_text("".join(lines), encoding="utf-8", errors="surrogateescape")


def change_table(folder: Path, source: random.Random) -> None:
    """Put an odd value, column, type or row into a table."""
    path = source.choice([each for each in sorted(folder.rglob("*.parquet")) if not each.is_fifo()])
    table = pa.parquet.read_table(path)
    name = source.choice(table.column_names)
    index, value, kind = table.column_names.index(name), source.choice(VALUES), source.randrange(8)
    cells = table[name].to_pylist()
    if kind < 3:
        cells = (
            [value] * len(cells)
            if kind
            else [value if k == 0 else cell for k, cell in enumerate(cells)]
        )
        table = table.set_column(index, name, pa.array(cells))
    elif kind == 3:
        table = table.drop_columns(name)
    elif kind == 4:
        table = table.rename_columns(
            [source.choice(PAYLOADS) if each == name else each for each in table.column_names]
        )
    elif kind == 5:
        table = table.append_column(
            source.choice([*PAYLOADS, name]), pa.array([value] * len(cells))
        )
    elif kind == 6:
        other = (
            table.slice(0, 0),
            table.slice(1),
            pa.concat_tables([table, table]),
            table.take([0] * 9),
        )
        table = source.choice(other)
    else:
        swapped = source.choice(cells)
        table = table.set_column(index, name, pa.array([swapped] * len(cells), table[name].type))
    pa.parquet.write_table(table, path)


def change_manifest(folder: Path, source: random.Random) -> None:
    """Replace, remove, rename or deepen a value of the manifest."""
    if (folder / results.MANIFEST).is_fifo():  # of an earlier change
        return
    root = json.loads((folder / results.MANIFEST).read_text())
    node: Any = root
    while True:
        key: Any = source.choice(list(node) if isinstance(node, dict) else range(len(node)))
        if not isinstance(node[key], dict | list) or not node[key] or source.random() < 0.2:
            break
        node = node[key]
    value = source.choice([each for each in VALUES if not isinstance(each, bytes)])
    kind = source.randrange(5)
    if kind == 0:
        del node[key]
    elif kind == 1 and isinstance(node, dict):
        node[source.choice(PAYLOADS)] = node.pop(key)
    elif kind == 2:
        node[key] = [node[key], {"a": node[key]}]
    else:
        node[key] = value
    (folder / results.MANIFEST).write_text(json.dumps(root))


def change_bytes(folder: Path, source: random.Random) -> None:
    """Change a file a little or much."""
    path = source.choice(
        [each for each in sorted(folder.rglob("*")) if each.is_file() and not each.is_symlink()]
    )
    path.write_bytes(bytes(drawn(Parser(print, (path.read_bytes(),), PAYLOADS[:4]), source)))


def change_names(folder: Path, source: random.Random) -> None:
    """Add, exchange or remove files, or put something else in the place of one."""
    paths = [each for each in sorted(folder.rglob("*")) if each.is_file() and not each.is_symlink()]
    path, other, kind = source.choice(paths), source.choice(paths), source.randrange(8)
    word = source.choice(PAYLOADS).replace("/", "").replace("\0", "")[:200] or "x"
    if kind in (0, 5, 6):
        path.unlink()
    if kind == 1:
        path.write_bytes(other.read_bytes())
    elif kind == 2:
        (folder / f"{word}{path.suffix}").write_bytes(path.read_bytes())
    elif kind == 3:
        (folder / source.choice((".lock", "more.csv", "report.html", "x.parquet"))).write_text(
            source.choice(PAYLOADS)
        )
    elif kind == 4:
        place = folder / source.choice(
            (".lock", "report.html", "figures", "more.csv", "recordings")
        )
        place.symlink_to(source.choice((folder.parent / "victim.csv", folder.parent)))
    elif kind == 5:
        path.symlink_to(folder.parent / "victim.csv")
    elif kind == 6:
        source.choice((path.mkdir, lambda: os.mkfifo(path)))()
    elif kind == 7:
        path.rename(path.with_name(word + source.choice((path.name, path.suffix))))


CHANGES: Final[tuple[Callable[[Path, random.Random], None], ...]] = (
    change_table, change_table, change_table, change_manifest, change_manifest, change_bytes, change_names,
)  # fmt: skip


def call(arguments: list[str]) -> int | str:
    """Return the exit code of a command in this process, or the last lines of its trace."""
    sys.argv = ["servobench", *arguments]
    try:
        servobench()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:  # noqa: BLE001 - it is what is looked for
        return "trace: " + " | ".join(traceback.format_exc().splitlines()[-5:])
    return 0


def attempt(
    number: int, goods: list[Path], place: Path, wanted: dict[str, object]
) -> list[tuple[str, str]]:
    """Change a folder, give it to commands, and return the faults; in a child."""
    source = random.Random(number)
    good = source.choice(goods)
    folder = laid_out(good, place)
    (place / "home" / "victim.csv").write_text("precious")
    shutil.copytree(good.parent / "other", place / "other")
    for change in source.choices(CHANGES, k=source.choice((1, 1, 2, 3))):
        try:
            change(folder, source)
        except (
            pa.ArrowException,
            OSError,
            ValueError,
            TypeError,
            IndexError,
        ):  # no such file, or none
            continue
    signed = source.random() < 0.8
    if signed:
        sign(folder)
    tempfile.tempdir = str(place / "temporary")
    os.environ["XDG_CACHE_HOME"] = str(place / "cache")
    faults, changed = [], not (signed or _same_files(folder, good))
    drawn_commands = source.choices(list(COMMANDS), list(COMMANDS.values()), k=2)
    for command in sorted(
        drawn_commands, key=lambda each: "--resume" in each or "collect" in each
    ):  # which mend it
        faults += [
            (command, fault) for fault in _faults(command, folder, good, wanted, changed=changed)
        ]
    if (place / "home" / "victim.csv").read_text() != "precious" or len(
        list((place / "home").iterdir())
    ) > 2:
        faults.append(("", "outside: the home of the folder was changed"))
    return faults


def laid_out(good: Path, place: Path) -> Path:
    """Copy a good folder among folders for what commands write, go there, and return the copy."""
    shutil.rmtree(place, ignore_errors=True)
    for name in ("home", "out", "temporary", "cache"):
        (place / name).mkdir(parents=True)
    os.chdir(place)
    return Path(shutil.copytree(good, place / "home" / "folder"))


def _faults(
    command: str, folder: Path, good: Path, wanted: dict[str, object], *, changed: bool
) -> list[str]:
    place = folder.parents[1]
    shutil.rmtree(place / "out" / "csv", ignore_errors=True)
    with noting() as noted:
        code, out, error = _captured(command.format(folder).split(), place)
    allowed = [
        os.path.realpath(place / name) for name in ("home/folder", "temporary", "cache", "out")
    ]
    outside = [
        each for each in noted if not any(f"{each[1]}/".startswith(f"{root}/") for root in allowed)
    ]
    faults = [f"outside: {each}" for each in outside if each[1] != os.devnull]
    if isinstance(code, str) or "Traceback" in error:
        faults.append(code if isinstance(code, str) else f"trace: {error[-300:]}")
    elif code == 2:
        if (
            error.count("servobench: ") != 1 or error.count("\n") > 2
        ):  # a word of an unfinished batch first
            faults.append(f"lines: {error[-300:]!r}")
    elif code == 0 and changed and command.startswith("verify"):
        faults.append("silent: verify takes changed files")
    elif code == 0:
        vouched = changed and command in UNCHANGED and f"{SUMS} is missing" not in out + error
        if vouched and _output(command, out, place) != wanted[f"{good}{command}"]:
            faults.append("silent: another output of a changed folder")
        elif command == EXPORT and not _equal_tables(folder, place / "out" / "csv"):
            faults.append("silent: an exported table is not that of the folder")
    return faults


def _captured(arguments: list[str], place: Path) -> tuple[int | str, str, str]:
    streams = [place / "temporary" / f"stream{number}" for number in (1, 2)]
    for number, stream in enumerate(streams, 1):
        with stream.open("wb") as file:
            os.dup2(file.fileno(), number)
    code = call(arguments)
    sys.stdout.flush()
    sys.stderr.flush()
    out, error = (stream.read_text(encoding="utf-8", errors="replace") for stream in streams)
    return code, out, error


def _same_files(folder: Path, good: Path) -> bool:
    """Return whether all files that the good folder vouches for are as they were; a lost part is one that never was."""
    vouched = [line.split("  ", 1)[1] for line in (good / SUMS).read_text().splitlines()]
    lost = [
        name
        for name in vouched
        if name.endswith(f".{results.RUNS}") and not os.path.lexists(folder / name)
    ]
    names = [name for name in (*vouched, SUMS) if (good / name).is_file() and name not in lost]
    return all(_content(folder / name) == _content(good / name) for name in names)


def _content(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _output(command: str, out: str, place: Path) -> object:
    if command != EXPORT:
        return out
    return {path.name: digest(path) for path in sorted((place / "out" / "csv").iterdir())}


def _equal_tables(folder: Path, exported: Path) -> bool:
    """Return whether the numbers of runs.csv are those of the table, row by row."""
    if not (folder / results.RUNS).is_file():
        return True
    table, csv = (
        pd.read_parquet(folder / results.RUNS),
        pd.read_csv(exported / "runs.csv", low_memory=False),
    )
    numbers = [name for name in table.select_dtypes("number") if name in csv]
    if len(table) != len(csv):
        return False
    written = csv[numbers].apply(pd.to_numeric, errors="coerce")
    return all(
        ((written[name] == table[name]) | (written[name].isna() & table[name].isna())).all()
        for name in numbers
    )


def in_child(work: Callable[[], object]) -> list[tuple[str, str]]:
    """Return what a function of a child of this process returns, or how the child ended."""

    def limited() -> object:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (CPU, CPU))
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        try:
            return work()
        except BaseException:  # noqa: BLE001 - a fault of this tool, which must be seen
            return [("", f"tool: {traceback.format_exc()}")]

    found, status = answered(limited, HANG)
    return (
        [("", f"hang: {HANG:g} s or {CPU} s of the processor; status {status}")]
        if found is None
        else found
    )


def main() -> None:
    """Carry everything out and print counts; exit code 1 if there was a fault."""
    given = options(__doc__, folders=10_000, first=(0, "number of the first one"))
    began, counts, shown = time.monotonic(), Counter[str](), 0
    with tempfile.TemporaryDirectory(prefix="servobench-signed-") as scratch:
        place = Path(scratch)
        os.environ["XDG_CACHE_HOME"] = str(place / "cache")
        goods = good_folders(place)
        wanted: dict[str, object] = {}
        for good in goods:
            for command in UNCHANGED:
                found = in_child(
                    lambda: [(command, _good_output(command, good, place / "undisturbed"))]  # noqa: B023
                )
                wanted[f"{good}{command}"] = found[0][1]
        for number in range(given.first, given.first + given.folders):
            for command, fault in in_child(lambda: attempt(number, goods, place / "point", wanted)):  # noqa: B023
                counts[fault.partition(":")[0]] += 1
                if (shown := shown + 1) <= SHOWN:
                    print(f"{number}: {command}: {fault}", flush=True)
            if number % 500 == 0:
                print(f"{number}: {time.monotonic() - began:.0f} s", flush=True)
    print(
        f"{given.folders} folders, {2 * given.folders} commands, {time.monotonic() - began:.0f} s: {dict(counts)}"
    )
    sys.exit(bool(counts))


def _good_output(command: str, good: Path, place: Path) -> object:
    code, out, error = _captured(command.format(laid_out(good, place)).split(), place)
    assert code == 0, error
    return _output(command, out, place)


if __name__ == "__main__":
    main()
