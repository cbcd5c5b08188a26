"""Which servobench this is: the distribution's version, and the commit of a checkout."""

from __future__ import annotations

import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

CODE_FOLDERS = ("plant", "controllers", "fmus", "harness")  # whose changes change results
COMMIT_DIGITS = 12  # that a reader is shown


def installed_version(name: str = "servobench") -> str | None:
    """Return the version of a distribution; None where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def git_commit() -> str | None:
    """Return the commit of the checkout this code lies in, marked where code differs from it; None outside one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    commit, changed = _git(root, "rev-parse", "HEAD"), _git(root, "status", "--porcelain", "--", *CODE_FOLDERS)
    return f"{commit}-dirty" if commit and changed else commit


def version_line() -> str:
    """Return what `servobench --version` prints."""
    commit = git_commit()
    hash_, dirty, _ = (commit or "").partition("-dirty")
    where = f" (commit {hash_[:COMMIT_DIGITS]}{', with changes' if dirty else ''})" if commit else ""
    return f"servobench {installed_version() or 'not installed'}{where}"


def _git(root: Path, *words: str) -> str | None:
    try:
        answer = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip() or None
