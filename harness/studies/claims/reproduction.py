"""The reproduction as a whole: carry out the runs, answer the claims, and leave tables and figures behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from servobench.harness.batch import results
from servobench.harness.batch.campaign import Campaign, Execution, carry_out
from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.studies.claims.answers import answer_all
from servobench.harness.studies.claims.figures import draw_answers
from servobench.harness.studies.claims.measurements import Answer
from servobench.harness.studies.claims.studies import DIVISIONS, MAIN, studies
from servobench.harness.studies.claims.table import markdown_table, write_tables

MIN_ROBOTS: Final = 6  # with fewer pairs, Wilcoxon's test cannot reach significance
FIGURES: Final = "figures"


def reproduce(
    out: Path, plants: Sequence[str], robots: int, how: Execution, divisions: Sequence[str] = tuple(DIVISIONS)
) -> list[Answer]:
    """Carry out the runs and answer the claims.

    Args:
        out: folder for runs, tables and figures.
        plants: names.
        robots: number of robots for each move; two fifths of them for the circle.
        how: how the runs are carried out.
        divisions: how the methods are equipped, keys of `DIVISIONS`.

    Returns:
        The answers of all plants and divisions, by claim.

    Raises:
        ConfigurationError: too few robots, or a plant that is no UR5.
    """
    if robots < MIN_ROBOTS:
        raise ConfigurationError(f"--seeds must be at least {MIN_ROBOTS} to tell methods apart, got {robots}")
    if any(find_plant(name).own_robot for name in plants):
        raise ConfigurationError("the claims are about a UR5; --plants names a plant with a robot of its own")
    answers, main = [], {}
    for division in divisions:
        tables = {}
        for study in studies(plants, robots, division):
            folder = out / division.replace(" ", "_") / study.name
            own = replace(how.of_part(folder), block=1 if study.timed else how.block)
            carry_out(Campaign(study.cells, study.settings), folder, own)
            tables[study.name] = results.load_runs(folder)
        answers += [answer for plant in plants for answer in answer_all(tables, plant, division)]
        main[division] = tables[MAIN]
        manifest = results.read_manifest(folder.parent / MAIN)
    answers.sort(key=lambda answer: (not answer.claim.isdigit(), answer.claim))
    results.write_summary(out, main, manifest)
    write_tables(answers, out)
    (out / "answers.md").write_text(markdown_table(answers), encoding="utf-8")
    draw_answers(answers, out / FIGURES)
    return answers
