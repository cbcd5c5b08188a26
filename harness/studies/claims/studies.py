"""The runs behind the answers: the four methods on the paper's tasks, and the proposed one in other readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from servobench.controllers.methods import PUBLISHED
from servobench.harness.batch.plan import Batch, Cell
from servobench.harness.config.registry import RENDERED
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.plant.contract.settings import did_you_mean

PROPOSED: Final = "rbfnn_mfac"
MPC: Final = "ukf_mpc"
OTHERS: Final = ("rbf_pid", "ukf_mfac", MPC)
MOVES: Final = ("exp1", "exp2", "exp3", "exp4")
LEAVING: Final = ("exp1", "exp4")  # start or target lie outside the region in which networks are trained
STAYING: Final = ("exp2", "exp3")
CIRCLE: Final = "circle"
MISMATCH: Final = "moderate"
DIVISIONS: Final[Mapping[str, str]] = {  # how the methods are equipped -> what follows their names
    "best equipped": "",
    "as published": PUBLISHED,
}
FIRST_SEED: Final = 30_000  # far from the seeds that methods are tuned on

MAIN: Final = "main"
FROZEN: Final = "frozen"  # the Jacobian network as it was trained
NO_EPSILON: Final = "no_epsilon"  # the paper as printed: no ε in either step size
ENTRIES: Final = "entries"  # the paper's fit of the entries of ψ
TIMED: Final = "timed"  # few runs, each by itself: how long steps take
TIMED_ROBOTS: Final = 5  # 20 moves and 5 circles a method

READINGS: Final[Mapping[str, Mapping[str, Any]]] = {
    FROZEN: {"estimator": {"k2": 1e-9}},
    NO_EPSILON: {"law": {"epsilon": 0.0}, "estimator": {"epsilon": 0.0}},
    ENTRIES: {"training": {"controller": {"fit": "entries"}}},
}


def find_divisions(text: str) -> tuple[str, ...]:
    """Return the divisions that a user named: `equipped`, `published` or `both`.

    Raises:
        ConfigurationError: none of these.
    """
    words = {"both": tuple(DIVISIONS)} | {name.split()[-1]: (name,) for name in DIVISIONS}
    if text not in words:
        raise ConfigurationError(
            f"--division must be one of {', '.join(sorted(words))}, got {text!r}{did_you_mean(text, words)}"
        )
    return words[text]


def plain_names(division: str) -> dict[str, str]:
    """Return the four methods without their division, by the names that they have in it."""
    return {name + DIVISIONS[division]: name for name in (PROPOSED, *OTHERS)}


class Study(NamedTuple):
    """Runs with common settings."""

    name: str  # of its folder
    settings: Settings  # overrides of the defaults
    cells: tuple[Cell, ...]  # the runs
    timed: bool = False  # each run goes by itself, so that its steps have times


def studies(plants: Sequence[str], seeds: int, division: str = "best equipped") -> list[Study]:
    """Return the studies on `plants`: `seeds` robots for each move, two fifths of them for the circle.

    Args:
        plants: names.
        seeds: number of robots.
        division: a key of `DIVISIONS`.
    """
    suffix = DIVISIONS[division]
    rendered = {name: {"scenery": False} for name in RENDERED}  # the same observations, bit for bit, in less time
    robots = tuple(range(FIRST_SEED, FIRST_SEED + seeds))
    some = robots[: max(2, 2 * seeds // 5)]

    def cells(controllers: tuple[str, ...], tasks: tuple[str, ...], chosen: tuple[int, ...]) -> tuple[Cell, ...]:
        names = tuple(name + suffix for name in controllers)
        batch = Batch(tuple(plants), names, tasks, (MISMATCH,), chosen)
        return tuple(Cell(request) for request in batch.requests())

    four = (PROPOSED, *OTHERS)
    main = Study(MAIN, Settings(rendered), cells(four, MOVES, robots) + cells(four, (CIRCLE,), some))
    own = cells((PROPOSED,), (*MOVES, CIRCLE), some)
    both = cells((PROPOSED, MPC), (*MOVES, CIRCLE), robots[:TIMED_ROBOTS])
    return [
        main,
        Study(TIMED, Settings(rendered), both, timed=True),
        *(Study(name, Settings({**rendered, PROPOSED + suffix: reading}), own) for name, reading in READINGS.items()),
    ]
