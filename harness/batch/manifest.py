"""What a results folder says about how it was made: resolved configuration, versions, seeds, git commit."""

from __future__ import annotations

import hashlib
import json
import platform
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from servobench.harness.batch.survey import Survey
from servobench.harness.config.settings import flatten

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


CODE_FOLDERS = ("plant", "controllers", "fmus", "harness")  # whose changes change results


def describe_batch(
    runs: Survey, sections: Mapping[str, Any], side_by_side: Mapping[str, list[str]], *, steps: bool = False
) -> dict[str, Any]:
    """Return the manifest of a batch; by the digest `campaign`, `resume` recognises the same runs and settings.

    Args:
        runs: what was asked for.
        sections: their typed settings by section, as `servobench.harness.run.resolved.resolve_sections` returns them.
        side_by_side: by plant, the controllers whose runs advance together, without the times of their steps.
        steps: the table of steps is kept, too.
    """
    configuration = {name: flatten(config) for name, config in sections.items()}
    identity = json.dumps([runs.digest, configuration, steps], sort_keys=True, default=str)
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "plants": list(runs.plants),
        "controllers": list(runs.controllers),
        "tasks": list(runs.tasks),
        "mismatches": list(runs.mismatches),
        "seeds": ",".join(f"{own.start}:{own.stop}" if len(own) > 1 else f"{own.start}" for own in runs.seeds),
        "configuration": configuration,
        "packages": {name: _version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "git_commit": _git_commit(),
        "side_by_side": dict(side_by_side),
        "run_count": runs.count,
        "campaign": hashlib.sha256(identity.encode()).hexdigest(),
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    """Return the commit of the checkout this code lies in, marked where code differs from it; None outside one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    commit, changed = _git(root, "rev-parse", "HEAD"), _git(root, "status", "--porcelain", "--", *CODE_FOLDERS)
    return f"{commit}-dirty" if commit and changed else commit


def _git(root: Path, *words: str) -> str | None:
    try:
        answer = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip() or None
