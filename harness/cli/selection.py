"""Names of plants, controllers, tasks, robots, sensing and mismatches: completed by shells, looked up and split."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from servobench.harness.cli.terminal import say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import split_words

if TYPE_CHECKING:
    import pandas as pd

    from servobench.harness.batch.results import ResultsFolder
    from servobench.harness.batch.trials import Word

ALL = "all"
Complete: TypeAlias = Callable[[str], list[str]]  # returns the names that a word may become
# Returns the name for which a word stands; refuses a wrong word
Choose: TypeAlias = Callable[[str], str]


class Names(NamedTuple):
    """The names of a kind."""

    known: Callable[[], Sequence[str]]  # returns all of them
    choose: Choose
    # Plants or controllers, of which those of third parties are tried if `all` is meant
    tried: Word | None = None
    # Returns the offers for a word, where names have parts
    begun: Callable[[str], Iterable[str]] | None = None


Kind: TypeAlias = str | Callable[[], Names]  # a word of `names_of`, or names of an application


@cache
def names_of(kind: Kind) -> Names:
    """Return the names of a kind: plants, controllers, estimators, tasks and so on.

    It imports no more than its kind needs, as shells wait for completions.
    """
    if not isinstance(kind, str):
        return kind()
    match kind:
        case "plants":
            return _tried("plant")
        case "controllers":
            return _tried("controller")._replace(begun=_begun_controllers)
        case "estimators":
            from servobench.controllers.methods import ESTIMATORS

            return Names(lambda: list(ESTIMATORS), str)
        case "tasks":
            from servobench.harness.run.tasks import choose_task, task_names

            return Names(task_names, choose_task)
        case "mismatch":
            from servobench.plant.robot.mismatch import PROFILES, Mismatch

            return Names(lambda: list(PROFILES), accepted(Mismatch.parse), begun=_begun_mismatches)
        case "robot":
            from servobench.plant.robot.catalogue import ROBOTS

            return Names(lambda: list(ROBOTS), _choose_robot)
        case "sensing":
            from servobench.harness.config.sensing import find_sensing, sensing_names

            return Names(sensing_names, accepted(find_sensing))
    raise ValueError(f"kind must be plants, controllers or another kind of names, got {kind!r}")


def _tried(word: Word) -> Names:
    from servobench.harness.batch import trials
    from servobench.harness.config.registry import REGISTRIES

    return Names(REGISTRIES[word].names, partial(trials.choose, word), word)


def _begun_controllers(word: str) -> Iterable[str]:
    from servobench.controllers.methods import ESTIMATORS
    from servobench.harness.config.registry import controller_names

    law, plus, _ = word.partition("+")
    if plus:
        return [f"{law}+{name}" for name in ESTIMATORS]
    return controller_names()


def _begun_mismatches(word: str) -> Iterable[str]:
    from servobench.plant.robot.mismatch import AXES, PROFILES

    before, plus, _ = word.rpartition("+")
    axes = [f"{before}{plus}{axis}=" for axis in AXES]
    return axes if plus else [*PROFILES, *axes]


def _choose_robot(word: str) -> str:
    from servobench.plant.robot.catalogue import find_robot

    say(find_robot(word).note)
    return word


def accepted(find: Callable[[str], object]) -> Choose:
    """Return a function that returns a word as the name if `find`, which refuses a wrong one, accepts it."""

    def choose_word(word: str) -> str:
        find(word)
        return word

    return choose_word


def completing(kind: Kind) -> Complete:
    """Return a function that completes a name of a kind."""

    def complete(incomplete: str) -> list[str]:
        names = names_of(kind)
        offered = names.known() if names.begun is None else names.begun(incomplete)
        return _matching(incomplete, offered)

    return complete


def completing_lists(complete: Complete) -> Complete:
    """Return a function that completes the last name of a comma-separated list."""

    def complete_last(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        words = complete(last)
        if not comma:
            words += _matching(last, [ALL])
        return [before + comma + word for word in words]

    return complete_last


def _matching(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]


def choose(kind: Kind, word: str) -> str:
    """Return the name of a kind that a user named, or whose place was given; a wrong one is refused."""
    names = names_of(kind)
    if len(split_words(word, names.known())) > 1:
        raise ConfigurationError(
            f"{word!r} names several, where one is wanted; compare takes several"
        )
    name = names.choose(word)
    _tell_unused(names, [name])
    return name


def split(kind: Kind, text: str, *, option: str = "", robot: str = "ur5") -> tuple[str, ...]:
    """Return the names of a kind in a comma-separated list, each looked up.

    Args:
        kind: see `names_of`.
        text: the list; `all` in it stands for all names that can be used.
        option: by which it was given, if not by one called as the kind.
        robot: for which plants and controllers of third parties are tried.
    """
    names = names_of(kind)
    known = names.known()
    usable = partial(_usable, names, robot)
    chosen = split_names(option or str(kind), text, known, names.choose, usable)
    _tell_unused(names, split_words(text, known))
    return chosen


def _usable(names: Names, robot: str) -> Sequence[str]:
    """Return the names that can be used for a robot, and print why others cannot."""
    if names.tried is None:
        return names.known()
    from servobench.harness.batch import trials

    usable = []
    for each in trials.try_all(names.tried, robot):
        if each.fault:
            sys.stderr.write(f"servobench: left out: {each.fault}\n")
        else:
            usable.append(each.name)
    return usable


def _tell_unused(names: Names, named: Sequence[str]) -> None:
    """Print a line for each entry point that is not used though a user named it, or all."""
    from servobench.harness.config.registry import REGISTRIES

    for name, line in REGISTRIES[names.tried].unused_points() if names.tried else ():
        if name in named or ALL in named:
            sys.stderr.write(f"servobench: note: {line}\n")


def split_names(
    option: str,
    text: str,
    known: Sequence[str],
    choose_one: Choose | None = None,
    usable: Callable[[], Iterable[str]] | None = None,
) -> tuple[str, ...]:
    """Split a comma-separated list of names, and refuse an empty one and a name that stands in it twice.

    Args:
        option: by which it was given, without dashes.
        text: the list.
        known: all names.
        choose_one: see `Names.choose`; None if only known words are names: another one gets a suggestion.
        usable: returns the names that `all` stands for; None for those that are known.
    """
    from servobench.plant.contract.settings import suggest

    names: list[str] = []
    for word in split_words(text, known):
        if word == ALL:
            names += known if usable is None else usable()
        elif choose_one is not None:
            names.append(choose_one(word))
        elif word in known:
            names.append(word)
        else:
            raise ConfigurationError(f"--{option}: unknown {word!r}: {suggest(word, known)}")
    if not names:
        raise ConfigurationError(f"--{option} is empty; valid: {', '.join(known)}")
    for name in names:
        if names.count(name) > 1:
            raise ConfigurationError(f"--{option} names {name} twice")
    return tuple(names)


def split_shown(text: str, runs: pd.DataFrame) -> tuple[str, ...]:
    """Return the controllers of a table of runs that a comma-separated list names."""
    return split_names("controllers", text, list(runs["controller"].unique()))


def choose_metrics(places: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of metrics of the user's, each named by its place once."""
    from servobench.harness.batch import trials

    return tuple(dict.fromkeys(trials.choose("metric", place) for place in places or ()))


def add_metrics(folder: ResultsFolder, places: Sequence[str] | None) -> None:
    """Add metrics of the user's to the runs of a folder."""
    if places:
        from servobench.harness.batch.measuring import add_metric

        for place in places:
            add_metric(folder, place)


def split_labels(text: str, shown: Sequence[str]) -> dict[str, str]:
    """Return the name in figures and tables of each controller that is shown.

    Args:
        text: of the option --names: a name for each controller in their order, or `CONTROLLER=NAME` for some of them;
            if empty, they keep their names.
        shown: the controllers.

    Raises:
        ConfigurationError: a name for an unknown controller, too few or too many, or one for several controllers.
    """
    from servobench.plant.contract.settings import suggest

    labels = {name: name for name in shown}
    words = [word.strip() for word in text.split(",") if text]
    if all("=" in word for word in words):
        for word in words:
            named = [name for name in shown if word.startswith(f"{name}=")]
            if not named:
                unknown = word.partition("=")[0]
                raise ConfigurationError(f"--names: unknown {unknown!r}: {suggest(unknown, shown)}")
            labels[named[0]] = word.removeprefix(f"{named[0]}=")
    elif len(words) == len(shown):
        labels = dict(zip(shown, words, strict=True))
    else:
        raise ConfigurationError(
            f"--names has {len(words)} names for {len(shown)} controllers: {', '.join(shown)}"
        )
    if len(set(labels.values())) < len(labels):
        raise ConfigurationError(
            f"--names has one name for several controllers: {', '.join(labels.values())}"
        )
    return labels
