"""Renews every measured number and picture of the pages: runs, then docs/tables and docs/pictures, then the pages.

    make results                  # every study, hours; the same call goes on after an interruption
    make results ONLY=held_out    # one study, or several with commas between them
    make nightly                  # writes nothing: a line for each stored figure that does not come out again

    python docs/renewal.py held_out --robots 2                  # tries a study with few robots, beside the pages
    python docs/renewal.py long --robots 1 --set endurance.laps=3  # further options go to every command

Runs of other code are made anew, unless `--keep` says that they still count.
"""

from __future__ import annotations

import argparse
import hashlib
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pandas as pd

import generated_tables
import stored_tables
from page_studies import STUDIES
from page_studies.reproduction.rules import MIN_ROBOTS
from page_studies.study import REPRODUCTION, Study
from servobench.harness.batch import results
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.installation import CODE_FOLDERS
from servobench.harness.run.result import CRASHED

ROOT: Final = Path(__file__).parents[1]
CODE: Final = (*CODE_FOLDERS, "docs/page_studies/reproduction")
DIGEST: Final = "code.sha256"  # in the folder of a study: of the code that its runs were made with
DONE: Final = ".done"  # suffix of a file beside a part that is complete; it holds the command


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the studies that are named, or all; return how many stored figures do not hold with `--check`."""
    options, further = parse(arguments)
    chosen = options.only.split(",") if options.only else list(STUDIES)
    if unknown := [name for name in chosen if name not in STUDIES]:
        sys.exit(f"no study is called {', '.join(unknown)}; there are {', '.join(STUDIES)}")
    problems = []
    for name in chosen:
        folder = carry_out(STUDIES[name], options.runs, options.robots, further, keep=options.keep)
        if options.check:
            problems += check(STUDIES[name], folder)
        else:
            refuse_crashes(folder)
            store(STUDIES[name], folder, options.into)
    if options.check:
        print("\n".join(problems) or "every stored figure comes out again")  # noqa: T201 - the output of the command
    elif options.into == ROOT / "docs":
        generated_tables.main()
    return len(problems)


def parse(arguments: Sequence[str] | None) -> tuple[argparse.Namespace, list[str]]:
    """Return the options, and those that go to every command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "only", nargs="?", help="names of studies with commas between them; default: all"
    )
    parser.add_argument("--runs", type=Path, help="folder of the runs; default results/pages")
    parser.add_argument(
        "--into", type=Path, help="folder that gets tables and pictures; default docs"
    )
    parser.add_argument(
        "--robots", type=int, help="at most so many seeds a command; tables go beside the runs"
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="compare with the stored tables instead of writing them",
    )
    parser.add_argument("--keep", action="store_true", help="keep finished runs of other code")
    options, further = parser.parse_known_args(arguments)
    tried = options.robots is not None or bool(further)
    options.runs = options.runs or ROOT / "results" / ("tried" if tried else "pages")
    options.into = options.into or (options.runs / "docs" if tried else ROOT / "docs")
    return options, further


def carry_out(
    study: Study, runs: Path, robots: int | None, further: Sequence[str], *, keep: bool
) -> Path:
    """Carry out what is missing of a study and return its folder.

    Raises:
        SystemExit: a command failed or was interrupted.
    """
    folder = runs / study.name
    digest, known = code_digest(), folder / DIGEST
    if folder.exists() and not keep and (not known.exists() or known.read_text() != digest):
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    known.write_text(digest)
    for part, command in study.commands.items():
        done = folder / f"{part}{DONE}"
        if done.exists():
            continue
        words = command(folder) if callable(command) else command
        line = run([*fewer(words, robots), *further], folder / part) if words else ""
        done.write_text(line, encoding="utf-8")
    return folder


def run(words: Sequence[str], out: Path) -> str:
    """Carry out a command of `servobench`, or a script, that writes into a folder; one that was begun goes on.

    Returns:
        The command as a user would type it, without the folder.

    Raises:
        SystemExit: it failed or was interrupted.
    """
    script = words[0].endswith(".py")
    line = shlex.join(["python" if script else "servobench", *words])
    sys.stderr.write(f"{line} --out {out}\n")
    start = [str(ROOT / words[0])] if script else ["-m", "servobench", words[0]]
    resumes = not script or words[0] == REPRODUCTION
    going_on = ["--resume"] if out.exists() and resumes else []
    ended = subprocess.run(
        [sys.executable, *start, *words[1:], "--out", str(out), *going_on], check=False
    )
    if ended.returncode:
        sys.exit(f"{out} ended with exit code {ended.returncode}; the same call goes on")
    return line


def fewer(command: Sequence[str], robots: int | None) -> list[str]:
    """Return a command with at most `robots` of its seeds."""
    words = list(command)
    if robots is not None and "--seeds" in words:
        at = words.index("--seeds") + 1
        begin, colon, end = words[at].partition(":")
        count = max(robots, MIN_ROBOTS) if words[0] == REPRODUCTION else robots
        words[at] = (
            f"{begin}:{min(int(end), int(begin) + count)}" if colon else str(min(int(begin), count))
        )
    return words


def code_digest() -> str:
    """Return a digest of the code that results depend on."""
    digest = hashlib.sha256()
    for top in CODE:
        for path in sorted((ROOT / top).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".md":
                digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def refuse_crashes(folder: Path) -> None:
    """Stop before numbers and pictures are stored that hold runs which never were: of a method or of the machine.

    Raises:
        SystemExit: a run of the study crashed.
    """
    for path in sorted(folder.rglob(results.RUNS)):
        runs = pd.read_parquet(path, columns=["status", "reason"])
        crashed = runs[runs["status"] == CRASHED]
        if len(crashed):
            sys.exit(f"{len(crashed)} of {len(runs)} runs in {path.parent} crashed, nothing is stored: "
                     f"{crashed['reason'].iloc[0]}")  # fmt: skip


def store(study: Study, folder: Path, into: Path) -> None:
    """Write tables and files of a study."""
    for name, table in study.tables(folder).items():
        stored_tables.write(
            into / "tables" / f"{name}.csv", stored_tables.Stored(stamp(study, folder), table)
        )
    for name, content in study.files(folder).items():
        path = into / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def stamp(study: Study, folder: Path) -> dict[str, str]:
    """Return how the runs of a study were made."""
    commands = {
        part: (folder / f"{part}{DONE}").read_text(encoding="utf-8") for part in study.commands
    }
    carried_out = [part for part, command in commands.items() if command]
    first = next(folder / part for part in carried_out if (folder / part).is_dir())
    # A suite's, one for each challenge
    parts = sorted(path.parent for path in first.glob(f"*/{results.MANIFEST}"))
    manifest = ResultsFolder(parts[0] if parts else first).manifest
    return {
        "study": study.name,
        "commit": str(manifest["git_commit"]),
        "date": str(manifest["created"])[:10],
        "version": str(manifest["packages"]["servobench"]),
        "command": "\n".join(commands[part] for part in carried_out),
    }


def check(study: Study, folder: Path) -> list[str]:
    """Return a line for each stored figure of a study that is not the one in `folder`."""
    lines = []
    for name, table in study.tables(folder).items():
        path = stored_tables.FOLDER / f"{name}.csv"
        if path.exists():
            lines += [
                f"{name}: {line}"
                for line in stored_tables.differences(table, stored_tables.read(path).table)
            ]
        else:
            lines.append(f"{name}: not stored; call make results ONLY={study.name}")
    return lines


if __name__ == "__main__":
    sys.exit(1 if main() else 0)
