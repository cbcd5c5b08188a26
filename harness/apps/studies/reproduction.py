"""The reproduction of the paper: carry out its runs, answer its claims, write tables."""

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd

from servobench.harness.apps.studies.claims import (
    MAIN,
    UNDECIDED,
    Answer,
    answer_all,
    studies,
)
from servobench.harness.batch import store
from servobench.harness.batch.campaign import Execution, carry_out_parts
from servobench.harness.batch.lock import locked
from servobench.harness.batch.plan import MAX_SEEDS
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.registry import find_plant
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import read_text, write_atomically

MIN_ROBOTS = 6  # with fewer pairs, Wilcoxon's test cannot reach significance
ANSWERS = "answers.csv"
MEASUREMENTS = "measurements.csv"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.])")
# Tolerances of the numbers in the evidence: a tenth, and a period
RELATIVE = 0.1  # [1]
ABSOLUTE = 0.051  # [s] for times
# Claim, plant, division -> verdict, evidence
Answers: TypeAlias = Mapping[tuple[str, ...], tuple[str, str]]


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
        divisions: how the methods are equipped, keys of `servobench.harness.apps.studies.claims.DIVISIONS`.
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
        store.write_summary(out, main, manifest)
        write_tables(answers, out)
        write = partial(Path.write_text, data=markdown_table(answers), encoding="utf-8")
        write_atomically(out / "answers.md", write)
    return answers


def write_tables(answers: Sequence[Answer], folder: Path) -> None:
    """Write a row for each claim, plant and division, and a row for each number behind the answers."""
    table = pd.DataFrame(answers).drop(columns="measurements")
    write_atomically(folder / ANSWERS, partial(table.to_csv, index=False))
    rows = []
    for answer in answers:
        about = {"claim": answer.claim, "plant": answer.plant, "division": answer.division}
        for m in answer.measurements:
            measured = {"measured": m.panel, "place": m.place, "label": m.label}
            rows.append({**about, **measured, **asdict(m.estimate), "holds": m.holds})
    measurements = pd.DataFrame(rows)
    write_atomically(folder / MEASUREMENTS, partial(measurements.to_csv, index=False))


def read_answers(path: Path) -> Answers:
    """Return verdict and evidence by claim, plant and division from a table of answers.

    Lines that begin with `#` are left out: the tables of docs/tables begin with how they were made.

    Raises:
        ConfigurationError: the file is not a table of answers.
    """
    text = read_text("table of answers", path)
    columns = ["claim", "plant", "division", "verdict", "evidence"]
    try:
        table = pd.read_csv(
            io.StringIO(text),
            dtype=str,
            keep_default_na=False,
            comment="#",
            usecols=columns,
        )
    except ValueError as error:
        raise ConfigurationError(
            f"{path} is not a table of answers: wanted one with the columns {', '.join(columns)}, such as "
            f"{ANSWERS} of a folder of claims"
        ) from error
    answers: dict[tuple[str, ...], tuple[str, str]] = {}
    for claim, plant, division, verdict, evidence in table[columns].itertuples(index=False):
        answers[claim, plant, division] = (verdict, evidence)
    return answers


def differences(answers: Sequence[Answer], wanted: Answers) -> list[str]:
    """Return a line for each answer that differs from the stored one.

    Verdicts and words must be the same. Numbers of the evidence may differ by a tenth and a period: networks that are
    fitted on another processor differ by rounding, which loops amplify.
    """
    lines = []
    for answer in answers:
        name = f"claim {answer.claim} on {answer.plant}, {answer.division}"
        key = answer.claim, answer.plant, answer.division
        if key not in wanted:
            lines.append(f"{name}: not in the table")
            continue
        verdict, evidence = wanted[key]
        if verdict != answer.verdict or not _agree(answer.evidence, evidence):
            lines.append(f"{name}: now {answer.verdict}: {answer.evidence}")
    return lines


def _agree(found: str, wanted: str) -> bool:
    """Return whether two lines of evidence have the same words and nearly the same numbers."""
    if NUMBER.sub("", found) != NUMBER.sub("", wanted):
        return False
    ours = [float(number) for number in NUMBER.findall(found)]
    theirs = [float(number) for number in NUMBER.findall(wanted)]
    return bool(np.allclose(ours, theirs, rtol=RELATIVE, atol=ABSOLUTE))


def markdown_table(answers: Sequence[Answer]) -> str:
    """Return the answers as a table in Markdown."""
    lines = ["| claim | plant | division | verdict | evidence |", "|---|---|---|---|---|"]
    lines += (
        f"| {a.title} | {a.plant} | {a.division} | **{a.verdict}**{elsewhere(a, answers)} | {a.evidence} |"
        for a in answers
    )
    return "\n".join(lines) + "\n"


def elsewhere(answer: Answer, answers: Sequence[Answer]) -> str:
    """Return a remark about the plants with another verdict on the same claim; empty if there is none.

    In how many comparisons a claim holds is not compared, nor a verdict for which robots were too few.
    """
    own = _kind_of_verdict(answer)
    if own == UNDECIDED:
        return ""
    verdicts = {
        other.plant: _kind_of_verdict(other)
        for other in answers
        if other.claim == answer.claim and other.division == answer.division
    }
    others = [plant for plant, each in verdicts.items() if each not in (own, UNDECIDED)]
    if not others:
        return ""
    return f" (otherwise on {', '.join(others)})"


def _kind_of_verdict(answer: Answer) -> str:
    """Return a verdict without the number of cases in which it holds."""
    return answer.verdict.partition(":")[0]
