"""Repeats the paper's moves and its circle with new robots and answers its seven claims with statistics.

    python docs/reproduction.py --out DIR                                # kinematic and fmu, 500 robots
    python docs/reproduction.py --plants bullet --seeds 10 --out DIR     # rendered images
    python docs/reproduction.py --check docs/tables/claims.csv --out DIR

The rules are in `page_studies/reproduction/rules.py`. The folder gets `answers.csv` and `answers.md`, a verdict and its
evidence for each claim, plant and division, and `measurements.csv`, every number behind them with its interval.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as servobench; read by numpy's import

import pandas as pd
import pyarrow as pa
import typer

from page_studies.reproduction.answers import (
    ANSWERS,
    differences,
    elsewhere,
    markdown_table,
    read_answers,
    write_tables,
)
from page_studies.reproduction.rules import DIVISIONS, MAIN, MIN_ROBOTS, Answer, answer_all, studies
from servobench.harness.batch import store
from servobench.harness.batch.campaign import Execution, carry_out_parts
from servobench.harness.batch.lock import locked
from servobench.harness.batch.plan import MAX_SEEDS
from servobench.harness.batch.results import RUNS, Manifest, ResultsFolder
from servobench.harness.batch.tables import UnwritableFolder, write_table, writing
from servobench.harness.cli import options, selection
from servobench.harness.cli.options import option
from servobench.harness.cli.progress import watching
from servobench.harness.cli.terminal import FAILED, INPUT_ERROR, console, ending_alike, say
from servobench.harness.config.registry import find_plant
from servobench.plant.contract.checksums import write_vouched
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import harmless, write_atomically


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; a bad input is one line on standard error and exit code 2."""
    program = typer.Typer(
        add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None
    )
    program.command()(options.command(answer_claims))
    with ending_alike():
        try:
            program(arguments)
        except ConfigurationError as error:
            sys.stderr.write(f"reproduction: {harmless(str(error))}\n")
            sys.exit(INPUT_ERROR)
        except UnwritableFolder as error:
            sys.stderr.write(f"reproduction: {error.strerror}; --resume continues\n")
            sys.exit(FAILED)


def answer_claims(
    *,
    out: options.FolderOption,
    plants: options.PlantsOption = "kinematic,fmu",
    seeds: Annotated[
        int, option("COUNT", "Robots for each move; two fifths of them for the circle.")
    ] = 500,
    division: Annotated[
        Literal["equipped", "published", "both"],
        option(
            "NAME",
            "Form of the methods: equipped (all aids), published (the law as printed) or both.",
        ),
    ] = "both",
    mismatch: options.MismatchOption = "moderate",
    running: options.Running,
    check: Annotated[
        Path | None,
        option(
            "FILE",
            "Table of answers that must come out the same; the exit code is 1 if they differ.",
        ),
    ] = None,
) -> None:
    """Repeat the paper's moves and its circle with new robots and answer its seven claims with statistics."""
    names = selection.split("plants", plants)
    divisions = [name for name in DIVISIONS if division in ("both", name.split()[-1])]
    wanted = None if check is None else read_answers(check)
    with watching(console, out, running.execution()) as how:
        answers = reproduce(out, names, seeds, how, divisions, mismatch)
    for answer in answers:
        verdict = answer.verdict + elsewhere(answer, answers)
        console.print(
            f"[bold]{answer.title} on {answer.plant}, {answer.division}: {verdict}[/bold]",
            soft_wrap=True,
            highlight=False,
        )
        console.print(answer.evidence, markup=False, highlight=False)
    say(f"answers in {out / ANSWERS}")
    if wanted is not None:
        lines = differences(answers, wanted)
        say("\n".join(lines) or f"the same answers as in {check}")
        if lines:
            sys.exit(FAILED)


def reproduce(
    out: Path,
    plants: Sequence[str],
    robots: int,
    how: Execution,
    divisions: Sequence[str],
    mismatch: str,
) -> list[Answer]:
    """Carry out the runs and answer the claims.

    Args:
        out: folder for runs and tables.
        plants: names.
        robots: number of robots for each move; two fifths of them for the circle.
        how: how the runs are carried out.
        divisions: how the methods are equipped, keys of `DIVISIONS`.
        mismatch: of all robots.

    Returns:
        The answers of all plants and divisions, by claim.

    Raises:
        ConfigurationError: too few or too many robots, a plant that is no UR5, or a folder that cannot be written.
    """
    if not MIN_ROBOTS <= robots <= MAX_SEEDS:
        raise ConfigurationError(
            f"--seeds must be at least {MIN_ROBOTS} to tell methods apart, and at most {MAX_SEEDS:,}, got {robots}"
        )
    if any(find_plant(name).own_robot for name in plants):
        raise ConfigurationError(
            "the claims are about a UR5; --plants names a plant with a robot of its own"
        )
    made = {division: studies(plants, robots, division, mismatch) for division in divisions}
    answers: list[Answer] = []
    main = {}
    with locked(out):
        for division, parts in made.items():
            folder = out / division.replace(" ", "_")
            tables = carry_out_parts(parts, folder, how)
            for plant in plants:
                answers += answer_all(tables, plant, division)
            main[division] = tables[MAIN]
            manifest = ResultsFolder(folder / MAIN).manifest
        answers.sort(key=lambda answer: (not answer.claim.isdigit(), answer.claim))
        write_summary(out, main, manifest)
        write_tables(answers, out)
        write = partial(Path.write_text, data=markdown_table(answers), encoding="utf-8")
        write_atomically(out / "answers.md", write)
    return answers


def write_summary(folder: Path, sweeps: Mapping[str, pd.DataFrame], manifest: Manifest) -> None:
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
        write_vouched(folder, {RUNS: partial(write_table, rows)})
        store.write_manifest(folder, manifest)


if __name__ == "__main__":
    main()
