"""The commands `servobench selftest | verify | submit | leaderboard`: results that others can check."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.harness.cli import selection
from servobench.harness.cli.options import FolderOption, Running, named_option, option
from servobench.harness.cli.terminal import FAILED, console, say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import split_words

if TYPE_CHECKING:
    from servobench.harness.apps.board.protocol import Finding, Hear
    from servobench.harness.batch.results import ResultsFolder

MAX_LEFT_OUT = 10  # files without a checksum that are named
SUBMITTED_RERUNS = 6  # runs of a submission that are repeated where no number is given
COLOURS = {"ok": "green", "failed": "bold red", "unknown": "yellow"}


def selftest(
    plants: Annotated[
        str, option("NAMES", "Comma-separated: kinematic, bullet, mujoco; default: kinematic.")
    ] = "kinematic",
) -> None:
    """Say whether this machine computes as the pages' did.

    Elementary functions, linear algebra and short runs are held against stored numbers. The exit code is 1 if a bit
    differs.
    """
    from servobench.harness.apps.board import selftest as test
    from servobench.harness.batch.fingerprint import numbers
    from servobench.plant.contract.settings import suggest

    machine, wanted = test.read_reference()
    names = selection.split("plants", plants)
    for name in names:
        if name not in wanted:
            raise ConfigurationError(f"--plants: {name} has no reference: {suggest(name, wanted)}")
    parts = list(test.compare(numbers(names, test.METHODS), wanted))
    say(f"here: {test.describe_machine()}")
    say(f"reference: {machine}")
    say("\n".join(map(str, parts)))
    different = sum(part.difference > 0.0 for part in parts)
    if different:
        say(f"{different} of {len(parts)} parts differ from the reference")
        sys.exit(FAILED)
    say("this machine computes bit for bit as the reference did")


def verify(
    folder: Annotated[Path, typer.Argument(help="Results folder, or a submission.")],
    rerun: Annotated[
        int | None,
        option(
            "COUNT",
            "Carry out so many of its runs again, drawn by its hash; all: a larger number.",
            min=1,
        ),
    ] = None,
    controller: Annotated[
        list[str] | None,
        option(
            "NAME=FILE",
            "Code of a controller of the folder, a file or a wheel that you trust to be run; may be repeated.",
        ),
    ] = None,
) -> None:
    """Check a results folder, and carry some of its runs out again.

    Damaged files are named with their remedy. Runs go without network, and with the limits of foreign code. The exit
    code is 1 if something is wrong.
    """
    from servobench.harness.apps.board.code import find_code
    from servobench.harness.apps.board.submission import HEAD
    from servobench.harness.apps.board.verification import Given, draw, recheck
    from servobench.harness.batch.lock import current_holder
    from servobench.harness.batch.results import ResultsFolder
    from servobench.plant.contract.settings import suggest

    if (holder := current_holder(folder)) is not None:
        say(f"{folder} is being written by {holder}")
    if controller and rerun is None:
        raise ConfigurationError("--controller is the code that --rerun carries out; give both")
    if (folder / HEAD).exists():
        from servobench.harness.apps.board.examination import check_submission

        if controller:
            raise ConfigurationError(
                f"{folder} is a submission, which brings its code: leave --controller out"
            )
        _print_findings(partial(check_submission, folder, rerun or SUBMITTED_RERUNS))
        return
    codes = {}
    for word in controller or []:
        name, equals, place = word.partition("=")
        if not equals:
            raise ConfigurationError(f"--controller {word}: wanted NAME=FILE")
        codes[name] = find_code(place)
    opened = ResultsFolder(folder)
    _check_files(opened)
    if rerun is None:
        return
    runs = opened.runs()
    known = set(runs["controller"])
    for name in codes:
        if name not in known:
            raise ConfigurationError(
                f"--controller: no run of {folder} is of {name!r}: {suggest(name, sorted(known))}"
            )
    _print_findings(partial(recheck, opened, draw(runs, rerun), Given(codes)))


def _check_files(folder: ResultsFolder) -> None:
    """Print the damaged files of a folder, and end with exit code 1 if there are some."""
    from servobench.harness.batch.integrity import examine
    from servobench.harness.batch.results import missing_line
    from servobench.plant.contract.settings import listed

    found = examine(folder)
    for finding in found.findings:
        say(f"{folder.path / finding.name} {finding.fault}: {finding.remedy}")
    say(missing_line(found.runs, found.wanted))
    if found.left_out:
        names = listed(found.left_out, MAX_LEFT_OUT)
        say(f"not checked, as SHA256SUMS does not list it: {names}")
    if found.findings:
        sys.exit(FAILED)
    say(f"{found.files} files are as they were written, {found.runs} runs")


def _print_findings(check: Callable[[Hear], None]) -> None:
    """Carry checks out without network, print a line a finding, and end with exit code 1 if one of them is wrong."""
    from rich.text import Text

    from servobench.harness.apps.board.network import close_network
    from servobench.harness.apps.board.protocol import CLAUSES

    if not close_network():
        say("the network stays open: this system cannot close it")
    verdicts = []

    def hear(finding: Finding) -> None:
        verdicts.append(finding.verdict)
        verdict = f"{finding.verdict:8s}", COLOURS[finding.verdict]
        clause = f"{finding.clause} {CLAUSES[finding.clause]}: "
        console.print(Text.assemble(verdict, clause, finding.text), soft_wrap=True)

    check(hear)
    wrong = verdicts.count("failed")
    say(f"{len(verdicts)} findings: {wrong} wrong, {verdicts.count('unknown')} unknown")
    if wrong:
        sys.exit(FAILED)


def submit(
    subject: Annotated[
        str,
        typer.Argument(
            metavar="CONTROLLER",
            help="./mine.py, ./mine.py:Mine, a wheel, or a method of servobench.",
        ),
    ],
    *,
    out: FolderOption,
    author: Annotated[str, option("NAME", "Who submits it, for the board.")] = "",
    kinds: Annotated[
        str,
        option(
            "NAMES",
            "Comma-separated kinds of worlds: mounting, camera, arm, timing, drive, everything; default: all.",
        ),
    ] = selection.ALL,
    running: Running,
) -> None:
    """Pack a controller and judge it on robots that its hash draws.

    The folder is a submission, which verify checks clause by clause and leaderboard shows.
    """
    from servobench.harness.apps.board.protocol import KINDS
    from servobench.harness.apps.board.submission import submit as make
    from servobench.harness.cli.progress import watching

    chosen = split_words(kinds)
    if kinds == selection.ALL:
        chosen = tuple(KINDS)
    with watching(console, out, running.execution()) as how:
        judged = make(subject, out, author, chosen, how)
    means = judged.groupby(["challenge", "controller"], sort=False)["score"].mean()
    for _, world, name, score in means.reset_index().itertuples():
        say(f"{world:20s} {name:20s} {score:.2f}")
    say(f"mean scores; next: servobench verify {out}")


def leaderboard(
    folders: Annotated[list[Path], typer.Argument(help="Submissions.")],
    *,
    out: Annotated[
        Path, named_option("--out", "FOLDER", "Folder for the site; files in it are replaced.")
    ],
) -> None:
    """Write a static page that ranks submissions.

    A table for each kind of world and division, with intervals, shared ranks, reports and pictures.
    """
    from servobench.harness.apps.board.site import write_site

    say(f"the board is {write_site(folders, out)}")
