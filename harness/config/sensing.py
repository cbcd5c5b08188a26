"""Sensing set-ups by name or by file: `pixel`, `stereo:hand`, `./polar.py:hand`."""

from functools import lru_cache

from servobench.harness.config.source import SourceFile, describe_at, find_place
from servobench.plant.cameras.registry import FIXED, HAND, SETUPS, Sensing
from servobench.plant.cameras.setups import SensingSetup
from servobench.plant.contract.faults import ConfigurationError, configuration_errors


def sensing_names() -> list[str]:
    """Return the words of all sensing set-ups of this package, each with fixed cameras and with cameras on the hand."""
    return [str(Sensing(setup, mount)) for setup in SETUPS.values() for mount in (FIXED, HAND)]


def find_sensing(word: str) -> Sensing:
    """Return the sensing that a word stands for, such as `pixel`, `stereo:hand` or `./polar.py:hand`.

    Raises:
        ConfigurationError: an unknown word, or a file that cannot be used.
    """
    return _find(word, sensing_file(word))


@lru_cache(maxsize=64)
def _find(word: str, file: SourceFile | None) -> Sensing:
    place = sensing_place(word)
    found = find_place(place)
    own = {}
    if file is not None and found is not None:
        own[place] = _pick(file, found["file"], found["name"])
        try:
            own[place].check()
        except ConfigurationError:
            raise
        except Exception as error:
            raise ConfigurationError(describe_at(error)) from error
    with configuration_errors():
        return Sensing.parse(word, {**SETUPS, **own})


def sensing_file(word: str) -> SourceFile | None:
    """Return the file of a user's own set-up; None for one of this package."""
    found = find_place(sensing_place(word))
    if found is not None and found["file"]:
        return SourceFile.read(found["file"])
    return None


def sensing_place(word: str) -> str:
    """Return a word without its mount."""
    place, _, mount = word.rpartition(":")
    if mount in (FIXED, HAND):
        return place
    return word


def _pick(source: SourceFile, file: str, name: str | None) -> SensingSetup:
    """Return the set-up called `name` that a file defines, or without a name its only one."""
    setups = {
        key: value for key, value in vars(source.load()).items() if isinstance(value, SensingSetup)
    }
    found = {key: value for key, value in setups.items() if value not in SETUPS.values()}
    if not found:
        raise ConfigurationError(
            f"{file} defines no sensing set-up: no object of servobench.plant.cameras.setups.SensingSetup"
        )
    first, *others = found
    if name in found or (name is None and not others):
        return found[name or first]
    wrong = f"has no sensing set-up {name!r}" if name else "has several sensing set-ups"
    raise ConfigurationError(
        f"{file} {wrong}: it defines {', '.join(found)}; name one, such as {file}:{first}"
    )
