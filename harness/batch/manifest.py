"""What a results folder says about how it was made: resolved configuration, versions, seeds, git commit."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Iterable
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from servobench.harness.config.defaults import default_config
from servobench.harness.config.registry import find_controller, find_plant
from servobench.harness.config.settings import Settings, flatten
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.tasks import find_task

PACKAGES = (
    "servobench",
    "numpy",
    "scipy",
    "pandas",
    "pyarrow",
    "pybullet",
    "control",
    "casadi",
    "fmpy",
    "opencv-python-headless",
    "pebble",
)


def describe_batch(requests: list[RunRequest], settings: Settings) -> dict[str, Any]:
    """Return the manifest of a batch.

    Args:
        requests: the runs asked for.
        settings: overrides; the manifest holds the resolved values.
    """
    configuration: dict[str, Any] = {"run": asdict(settings.resolve("run", RunSettings()))}
    for name in _unique(request.plant for request in requests):
        configuration[name] = flatten(settings.resolve(name, find_plant(name).config()))
    for name in _unique(request.controller for request in requests):
        configuration[name] = flatten(settings.resolve(name, default_config(find_controller(name))))
    for name in _unique(request.task for request in requests):
        configuration[name] = flatten(settings.resolve(name, find_task(name).default))
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "plants": _unique(request.plant for request in requests),
        "controllers": _unique(request.controller for request in requests),
        "tasks": _unique(request.task for request in requests),
        "mismatches": _unique(str(request.mismatch) for request in requests),
        "seeds": sorted({request.seed for request in requests}),
        "configuration": configuration,
        "packages": {name: _version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "git_commit": _git_commit(),
    }


def _unique(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    """Return the commit of the checkout this code lies in, marked where files differ from it; None outside one."""
    here = Path(__file__).resolve().parents[1]
    if not (here.parent / ".git").exists():
        return None
    try:
        command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
        answer = subprocess.run(command, cwd=here, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip() or None
