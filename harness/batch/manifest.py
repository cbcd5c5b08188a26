"""What a results folder says about how it was made: resolved configuration, versions, seeds, git commit."""

from __future__ import annotations

import hashlib
import json
import platform
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from servobench.harness.config.settings import flatten
from servobench.harness.run.request import RunRequest

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


def describe_batch(
    requests: Sequence[RunRequest], sections: Mapping[str, Any], *, steps: bool = False
) -> dict[str, Any]:
    """Return the manifest of a batch; by the digest `campaign`, `resume` recognises the same runs and settings.

    Args:
        requests: the runs asked for.
        sections: their typed settings by section, as `servobench.harness.run.resolved.resolve_sections` returns them.
        steps: the table of steps is kept, too.
    """
    configuration = {name: flatten(config) for name, config in sections.items()}
    identity = {"runs": [request.run_id for request in requests], "configuration": configuration}
    text = json.dumps({**identity, **({"steps": True} if steps else {})}, sort_keys=True, default=str)

    def used(kind: str) -> list[str]:
        return list(dict.fromkeys(str(getattr(request, kind)) for request in requests))

    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "plants": used("plant"),
        "controllers": used("controller"),
        "tasks": used("task"),
        "mismatches": used("mismatch"),
        "seeds": sorted({request.seed for request in requests}),
        "configuration": configuration,
        "packages": {name: _version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "git_commit": _git_commit(),
        "run_count": len(requests),
        "campaign": hashlib.sha256(text.encode()).hexdigest(),
    }


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
