"""Settings from TOML files and `--set section.key=value`, mapped onto the frozen dataclasses beside each class.

A section is the name of a plant, a controller or a task, or `run`; keys below it are the fields of its dataclass,
nested with dots. Nothing else is read from the files, and an unknown section or key is refused. A file may serve many
commands, so it may have sections that do not run; an assignment is meant for one, and must have an effect there.

The defaults of a controller are those of its class with the tuned values on top, the table `[settings]` of a file
`controllers/tuned/NAME.toml` that `servobench tune` wrote, with a dot for a colon in the name. Those of a class `Mine`
of a user's `mine.py` lie beside it, in `mine.Mine.tuned.toml`, and are taken while the code is that which was tuned.
Ours are tuned for arms of which a nominal model is known, where an estimator learns the difference from it. On an arm
without one the estimator has the whole Jacobian to learn, and to find the first one by probing moves.
"""

import contextlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from servobench.controllers.controller import ControllerEntry
from servobench.harness.config.source import show
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import Record, is_file, parse_toml, read_toml
from servobench.plant.contract.settings import Section, override, remark

Config = TypeVar("Config")
TUNING = range(10_000, 20_000)  # seeds of `servobench tune`; all others are for judging
TUNING_WORDS = f"{TUNING.start}:{TUNING.stop}"
# Assignment to a plant called as its file
MAPPED = re.compile(r"\s*(fmu:.+?\.(?i:toml))\.(.+)", re.DOTALL)


class Assignment(NamedTuple):
    """The argument of an option --set."""

    section: str
    key: str  # with dots
    text: str  # as it was written


@dataclass(frozen=True)
class Settings:
    """Overrides of defaults, by section.

    Attributes:
        sections: section -> nested or dotted keys, which become nested ones -> plain values as TOML gives them.
        assigned: those of `sections` that came as single assignments.
        filed: section and dotted key of those that came from a file, which may hold every setting with its default.

    Raises:
        ConfigurationError: something else than sections with keys.
    """

    sections: Mapping[str, Section] = field(default_factory=dict)
    assigned: tuple[Assignment, ...] = ()
    filed: frozenset[tuple[str, str]] = frozenset()

    def __post_init__(self) -> None:
        """Check that there are sections, and keys in them."""
        given: object = self.sections
        if not _is_section(given) or not all(_is_section(each) for each in self.sections.values()):
            wanted = "sections with keys, such as {'kinematic': {'lag': 0.1}}"
            raise ConfigurationError(f"settings must be {wanted}, got {given!r}")
        object.__setattr__(
            self, "sections", {name: _undotted(each) for name, each in self.sections.items()}
        )

    @configuration_errors()
    def resolve(self, section: str, default: Config) -> Config:
        """Return the configuration `default` with the overrides of `section` applied.

        Raises:
            ConfigurationError: an unknown key, a value of the wrong type, or one that the dataclass refuses.
        """
        return override(section, default, self.sections.get(section, {}))


def _is_section(given: object) -> bool:
    """Return whether this is a mapping from texts, at any depth."""
    return isinstance(given, Mapping) and all(
        isinstance(key, str) and (not isinstance(value, Mapping) or _is_section(value))
        for key, value in given.items()
    )


def _undotted(section: Section) -> Section:
    """Return a section with nested keys in place of dotted ones."""
    dotted = [key for key in section if "." in key]
    for key in dotted:
        whole = next((each for each in section if key.startswith(f"{each}.")), None)
        if whole is not None:
            raise ConfigurationError(
                f"settings give {whole!r} and also {key!r}, a part of it; write one of them"
            )
    nested = {key: value for key, value in section.items() if key not in dotted}
    for key in dotted:
        _put(nested, key, section[key])
    return nested


def read_settings(path: Path | None, assignments: Iterable[str]) -> Settings:
    """Read a TOML file and apply `section.key=value` assignments on top of it.

    Raises:
        ConfigurationError: an unreadable or malformed file, a malformed assignment, or two of one setting.
    """
    sections = {}
    if path is not None:
        sections = read_toml("configuration file", path)
        for name, section in sections.items():
            if not isinstance(section, dict):
                raise ConfigurationError(
                    f"configuration file {path}: {name!r} stands outside a [section]"
                )
    filed = {(name, key) for name, section in sections.items() for key in flatten(section)}
    assigned: dict[tuple[str, str], Assignment] = {}
    for text in assignments:
        new = _assign(sections, text)
        if old := assigned.get((new.section, new.key)):
            raise ConfigurationError(
                f"--set gives {new.section}.{new.key} twice: {old.text} and {new.text}"
            )
        assigned[new.section, new.key] = new
    return Settings(sections, tuple(assigned.values()), frozenset(filed - assigned.keys()))


def flatten(config: Any, prefix: str = "") -> Record:  # noqa: ANN401 - any configuration dataclass
    """Return the fields of a configuration dataclass, or settings by nested keys, by dotted key."""
    flat = {}
    values = (
        {each.name: getattr(config, each.name) for each in fields(config)}
        if is_dataclass(config)
        else config
    )
    for name, value in values.items():
        if is_dataclass(value) or (config is values and isinstance(value, Mapping)):
            flat.update(flatten(value, f"{prefix}{name}."))
        else:
            flat[prefix + name] = value
    return flat


def nest(flat: Section) -> Record:
    """Return settings by nested keys, given those by dotted key; None, a setting without a value, is left out."""
    nested: Record = {}
    for key, value in flat.items():
        if value is not None:
            _put(nested, key, value)
    return nested


def _put(nested: Record, key: str, value: object) -> None:
    """Write a value under a dotted key."""
    *path, name = key.split(".")
    for part in path:
        nested = nested.setdefault(part, {})
    nested[name] = value


def _assign(sections: Record, assignment: str) -> Assignment:
    mapped = MAPPED.fullmatch(assignment)
    rest = mapped[2] if mapped else assignment
    key, equals, text = rest.partition("=")
    path = key.strip().split(".")
    if mapped:
        path.insert(0, mapped[1])
    if not equals or len(path) < 2 or not all(path):
        raise ConfigurationError(
            f"--set needs section.key=value, such as kinematic.lag=0.1; got {assignment!r}"
        )
    # Three numbers or more, without brackets
    bare = text.count(",") > 1 and text.lstrip()[0] not in "[{'\""
    value = text.strip()  # a bare word is a string
    if not is_file(value) or "#" not in value:  # which would begin a comment
        with contextlib.suppress(ValueError, RecursionError):
            value = parse_toml(f"value = [{text}]" if bare else f"value = {text}")["value"]
    target = sections
    for name in path[:-1]:
        target = target.setdefault(name, {})
        if not isinstance(target, dict):
            raise ConfigurationError(f"--set {assignment}: {name!r} is a value, not a section")
    target[path[-1]] = value
    return Assignment(path[0], ".".join(path[1:]), assignment)


def file_stem(name: str) -> str:
    """Return a controller's name as part of a file's name; some systems refuse the colon of a division's name."""
    return name.replace(":", ".")


def tuned_file(name: str) -> Traversable:
    """Return where the tuned values of the controller called `name` lie, if it has any."""
    return files("servobench.controllers") / "tuned" / f"{file_stem(name)}.toml"


@cache
def default_config(entry: ControllerEntry, *, model_known: bool = True) -> Any:  # noqa: ANN401 - any configuration dataclass
    """Return the configuration of a controller for which nothing is set.

    Args:
        entry: of the controller.
        model_known: whether a nominal model of the arm is known.

    Raises:
        ConfigurationError: a file of tuned values that is malformed or does not fit the configuration.
    """
    tuned = entry.tuned or tuned_settings(entry.name)
    return apply_settings(entry, tuned if model_known else _without_model(entry, tuned))


def _without_model(entry: ControllerEntry, tuned: Section) -> Section:
    """Return the tuned values that hold where no model is known; those of a published method never counted on one."""
    if entry.needs_truth or not hasattr(entry.config(), "initial"):
        return tuned
    kept = {key: value for key, value in tuned.items() if key != "estimator" or ":" in entry.name}
    return kept | {"initial": {"source": "probe"}}


def apply_settings(entry: ControllerEntry, values: Section) -> Any:  # noqa: ANN401 - as default_config
    """Return the configuration of `entry`'s class with nested `values` on top.

    Raises:
        ConfigurationError: an unknown key, or a value that the configuration refuses.
    """
    return Settings({entry.name: values}).resolve(entry.name, entry.config())


@cache
def tuned_settings(name: str) -> Section:
    """Return the tuned values of the controller called `name`, nested; empty where there are none.

    Raises:
        ConfigurationError: a file that cannot be read as tuned values.
    """
    file = tuned_file(name)
    if not file.is_file():
        return {}
    try:
        values = parse_toml(file.read_text(encoding="utf-8"))["settings"]
    except (OSError, ValueError, KeyError) as error:
        raise ConfigurationError(
            f"tuned values {file} cannot be read: {error}; make them with tune"
        ) from error
    if not isinstance(values, dict):
        raise ConfigurationError(f"tuned values {file}: [settings] must be a table, got {values!r}")
    return values


def read_tuned(path: Path, entry: ControllerEntry, place: str, code: str) -> Section:
    """Return the content of a file of tuned values; empty where there is none, or where the code was edited since.

    Args:
        path: of the file.
        entry: of the controller.
        place: of its code, for messages.
        code: digest of its code.

    Raises:
        ConfigurationError: it cannot be read, its values do not fit, or its robots are not those kept for tuning.
    """
    if not path.is_file():
        return {}
    values = read_toml("tuned values", path)
    if values.get("sha256") != code:
        remark(
            f"{place} was edited after {show(path)} was made: it is not tuned and has its default values"
        )
        return {}
    place = f"tuned values {show(path)}, which servobench tune makes: "
    with configuration_errors(place, AttributeError, KeyError, TypeError):
        for seeds in values["seeds"]:
            begin, end = map(int, seeds.split(":"))
            if begin not in TUNING or end - 1 not in TUNING:
                raise ValueError(f"robots {seeds} may judge, only {TUNING_WORDS} are for tuning")
        apply_settings(entry, values["settings"])
    return values
