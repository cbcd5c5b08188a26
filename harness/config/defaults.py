"""The defaults of a controller: those of its configuration class with the tuned values on top.

Tuned values are files `controllers/tuned/NAME.toml` that `servobench tune` wrote, with a dot for a colon in the name;
their table `[settings]` holds nested fields of the configuration. A controller without a file keeps the defaults of its
class. Values are tuned for arms of which a nominal model is known, where an estimator learns the difference from it. On
an arm without one the estimator has the whole Jacobian to learn, and to find the first one by probing moves.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

from servobench.controllers.controller import ControllerEntry
from servobench.harness.config.settings import Settings
from servobench.plant.contract.faults import ConfigurationError


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
    tuned = tuned_settings(entry.name)
    return apply_settings(entry, tuned if model_known else _without_model(entry, tuned))


def _without_model(entry: ControllerEntry, tuned: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the tuned values that hold where no model is known; those of a published method never counted on one."""
    if entry.needs_truth or not hasattr(entry.config(), "initial"):
        return tuned
    kept = {key: value for key, value in tuned.items() if key != "estimator" or ":" in entry.name}
    return kept | {"initial": {"source": "probe"}}


def apply_settings(entry: ControllerEntry, values: Mapping[str, Any]) -> Any:  # noqa: ANN401 - as default_config
    """Return the configuration of `entry`'s class with nested `values` on top.

    Raises:
        ConfigurationError: an unknown key, or a value that the configuration refuses.
    """
    return Settings({entry.name: values}).resolve(entry.name, entry.config())


@cache
def tuned_settings(name: str) -> Mapping[str, Any]:
    """Return the tuned values of the controller called `name`, nested; empty where there are none.

    Raises:
        ConfigurationError: a file that cannot be read as tuned values.
    """
    file = tuned_file(name)
    if not file.is_file():
        return {}
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))["settings"]
    except (OSError, ValueError, KeyError) as error:
        raise ConfigurationError(f"tuned values {file} cannot be read: {error}; make them with tune") from error
    if not isinstance(values, dict):
        raise ConfigurationError(f"tuned values {file}: [settings] must be a table, got {values!r}")
    return values
