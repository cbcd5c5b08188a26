"""What a shell completes: names of plants, controllers, tasks, robots, estimators and mismatches, also within lists."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Final

ASKED_BY: Final = "_SERVOBENCH_COMPLETE"  # set by a shell that wants completions
BASH: Final = "complete_bash"
WORD_BREAKS: Final = frozenset(":=")  # at which bash splits a word, though names of methods and settings have them


@contextlib.contextmanager
def rejoining_words() -> Iterator[None]:
    """Let bash complete within a word that it splits at a colon or an equals sign; it wants what follows the last."""
    if os.environ.get(ASKED_BY) != BASH:
        yield
        return
    words, index = os.environ["COMP_WORDS"].split("\n"), int(os.environ["COMP_CWORD"])
    joined, before = join_words(words, index)
    os.environ.update(COMP_WORDS="\n".join(joined), COMP_CWORD=str(len(joined) - 1))
    answer = io.StringIO()
    try:
        with contextlib.redirect_stdout(answer):
            yield
    finally:
        for line in answer.getvalue().splitlines():
            sys.stdout.write(line.removeprefix(before) + "\n")


def join_words(words: list[str], index: int) -> tuple[list[str], str]:
    """Return the words up to that of `index` as they were typed, and what the last one begins with before it."""
    joined, before, after_break = list[str](), "", False
    for word in words[: index + 1]:
        is_break = bool(word) and WORD_BREAKS.issuperset(word)
        if len(joined) > 1 and (is_break or after_break):
            before = joined[-1] + (word if is_break else "")
            joined[-1] += word
        else:
            before = ""
            joined.append(word)
        after_break = is_break
    return joined, before


def plants(incomplete: str) -> list[str]:
    """Return the plants whose names begin so."""
    from servobench.harness.config.registry import plant_names

    return _matching(incomplete, plant_names())


def controllers(incomplete: str) -> list[str]:
    """Return the controllers whose names begin so; after `law+` the pairs with this law."""
    from servobench.controllers.parts import ESTIMATORS
    from servobench.harness.config.registry import controller_names

    law, plus, _ = incomplete.partition("+")
    return _matching(incomplete, [f"{law}+{name}" for name in ESTIMATORS] if plus else controller_names())


def tasks(incomplete: str) -> list[str]:
    """Return the tasks whose names begin so."""
    from servobench.harness.run.tasks import TASKS

    return _matching(incomplete, TASKS)


def sensings(incomplete: str) -> list[str]:
    """Return the sensing set-ups whose names begin so."""
    from servobench.harness.config.robots import sensing_names

    return _matching(incomplete, sensing_names())


def estimators(incomplete: str) -> list[str]:
    """Return the estimators whose names begin so."""
    from servobench.controllers.parts import ESTIMATORS

    return _matching(incomplete, ESTIMATORS)


def mismatches(incomplete: str) -> list[str]:
    """Return the profiles and axes of mismatch whose names begin so; after a `+` the axes."""
    from servobench.plant.robot.mismatch_axes import AXES, PROFILES

    before, plus, last = incomplete.rpartition("+")
    axes = [f"{axis}=" for axis in AXES]
    return [before + plus + name for name in _matching(last, axes if plus else [*PROFILES, *axes])]


def robots(incomplete: str) -> list[str]:
    """Return the robots whose names begin so."""
    from servobench.harness.config.robots import robot_names

    return _matching(incomplete, robot_names())


def listed(complete: Callable[[str], list[str]]) -> Callable[[str], list[str]]:
    """Return what completes the last name of a comma-separated list."""

    def complete_last(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        words = complete(last) + _matching(last, ["all"] * (not comma))
        return [before + comma + word for word in words]

    return complete_last


def _matching(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
