"""How often comparisons that end when decided are false, how much they tell, and how many robots they take.

    servobench suite --challenges severe,wide,gears50 --controllers regression_mfac,rbfnn_mfac,rbf_pid,constant \
        --seeds 140428:140628 --reference-seeds 1 --out DIR
    python benchmarks/until_decided.py --folder DIR

Batches of 200 robots are drawn from the runs of each challenge, with replacement. In equal ones the two methods change
places on each robot at random, so that neither is better. Planted are normal differences, in margins, and lost runs.
The fixed test is that of `statistics` on all 200 robots.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from measuring import options, table
from servobench.harness.analysis.comparison import margin, paired_difference
from servobench.harness.analysis.sequential import decide
from servobench.harness.apps.studies.challenge import MEASURES, find_challenge
from servobench.harness.apps.studies.suite import judge
from servobench.harness.batch.results import load_runs
from servobench.plant.contract.checks import FloatArray

LEVEL: Final = 0.05
BUDGET: Final = 200  # [robots]
LOOKS: Final = [*range(16, BUDGET, 16), BUDGET]
QUARTER: Final = [each for each in LOOKS if each <= BUDGET // 4]

Draw = Callable[[np.random.Generator], tuple[FloatArray, FloatArray]]


class Case(NamedTuple):
    """Batches of a kind."""

    name: str
    false: tuple[str, ...]  # verdicts that are wrong; none where the truth is not known
    draw: Draw  # returns values of two methods, in margins


def stored(
    folder: Path, names: Sequence[str]
) -> Iterator[tuple[str, str, str, FloatArray, FloatArray]]:
    """Yield challenge, two methods and their values [margins] on the robots of a folder; +∞ of a lost run."""
    for path in sorted(each.parent for each in folder.glob("*/runs.parquet")):
        challenge = find_challenge(path.name)
        runs = load_runs(path)
        measure = MEASURES[challenge.measure]
        small = measure.factor * margin(measure.column, runs)
        values = judge(challenge, runs).pivot_table("value", "seed", "controller", dropna=False)
        values = values.fillna(np.inf) / small
        for first, second in combinations(names, 2):
            yield path.name, first, second, values[first].to_numpy(), values[second].to_numpy()


def drawn_again(first: FloatArray, second: FloatArray) -> Draw:
    """Return batches of robots that are drawn anew."""

    def draw(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        chosen = rng.integers(len(first), size=BUDGET)
        return first[chosen], second[chosen]

    return draw


def exchanged(first: FloatArray, second: FloatArray) -> Draw:
    """Return batches in which the two change places on each robot at random, so that they are equal."""

    def draw(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        chosen = rng.integers(len(first), size=BUDGET)
        swap = rng.random(BUDGET) < 0.5
        one = np.where(swap, second[chosen], first[chosen])
        other = np.where(swap, first[chosen], second[chosen])
        return one, other

    return draw


def planted(difference: float, deviation: float, lost: float) -> Draw:
    """Return batches whose differences have a mean and a deviation [margins]; the second loses a share of its runs."""

    def draw(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        second = rng.uniform(10.0, 20.0, BUDGET)
        first = second + rng.normal(difference, deviation, BUDGET)
        return first, np.where(rng.random(BUDGET) < lost, np.inf, second)

    return draw


def share(verdicts: list[str], words: tuple[str, ...]) -> str:
    """Return the percentage of some verdicts."""
    return f"{100.0 * np.mean([each in words for each in verdicts]):.1f}"


def row(case: Case, batches: int) -> list[str]:
    """Return what is said of batches of a kind: decided, false and mean robots, and the fixed test beside it."""
    rng = np.random.default_rng(0)
    quarter: list[str] = []
    found: list[str] = []
    fixed: list[str] = []
    robots: list[int] = []
    for _ in range(batches):
        first, second = case.draw(rng)
        quarter.append(decide(first, second, 1.0, LEVEL, QUARTER).verdict)
        decision = decide(first, second, 1.0, LEVEL, LOOKS)
        found.append(decision.verdict)
        robots.append(decision.robots)
        fixed.append(paired_difference(first, second, 1.0).verdict)
    told = ("better", "worse")
    return [
        case.name,
        *(share(found, words) for words in (told, ("equivalent",), case.false)),
        share(quarter, (*told, "equivalent")),
        f"{np.mean(robots):.0f}",
        *(share(fixed, words) for words in (told, ("equivalent",), case.false)),
    ]


def cases(folder: Path, names: Sequence[str]) -> Iterator[Case]:
    """Yield all kinds of batches."""
    told = ("better", "worse")
    for challenge, first, second, one, other in stored(folder, names):
        words = f"`{challenge}`: `{first}`, `{second}`"
        yield Case(f"equal by exchange, {words}", told, exchanged(one, other))
        yield Case(words, (), drawn_again(one, other))
    for deviation in (1.0, 3.0):
        yield Case(f"planted equal, deviation {deviation:g}", told, planted(0.0, deviation, 0.0))
        both = (*told, "equivalent")
        yield Case(
            f"planted one margin, deviation {deviation:g}", both, planted(1.0, deviation, 0.0)
        )
        wrong = ("better", "equivalent")
        yield Case(
            f"planted two margins, deviation {deviation:g}", wrong, planted(2.0, deviation, 0.0)
        )
    for lost in (0.05, 0.1, 0.2):
        wrong = ("worse", "equivalent")
        yield Case(f"planted lost runs, {100 * lost:.0f} %", wrong, planted(0.0, 0.5, lost))


def main() -> None:
    """Print a row for each kind of batches."""
    chosen = options(
        __doc__,
        folder=("", "of the suite"),
        controllers=("regression_mfac,rbfnn_mfac,rbf_pid", "with commas between them"),
        batches=(1000, "of each kind"),
    )
    names = chosen.controllers.split(",")
    rows = [row(case, chosen.batches) for case in cases(Path(chosen.folder), names)]
    header = (
        "batches", "told [%]", "equivalent [%]", "false [%]", "decided on a quarter [%]", "robots",
        "fixed: told [%]", "equivalent [%]", "false [%]",
    )  # fmt: skip
    print(table(header, rows))


if __name__ == "__main__":
    main()
