"""The installation: version and commit of servobench, and the extras that bring missing packages."""

import subprocess
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from servobench.plant.contract.faults import ConfigurationError

EXTRAS: Final = {  # top-level module -> extra
    "pybullet": "bullet",
    "mujoco": "mujoco",
    "jinja2": "report",
    "optuna": "tune",
    "distributed": "cluster",
    "gymnasium": "gym",
    "mcap": "mcap",
    "imageio_ffmpeg": "animation",
    "yourdfpy": "urdf",
}
NO_WHEELS: Final = (3, 12)  # first version of Python for which PyBullet 3.2 offers none


def has_no_wheel() -> bool:
    """Return whether PyBullet would have to be compiled on this version of Python."""
    return sys.version_info >= NO_WHEELS


def missing_extra(error: ImportError, user: str) -> str | None:
    """Return the line for the user about an import that failed; None where no extra brings the module.

    Args:
        error: of the import.
        user: the feature that needs the module, such as "a film".
    """
    module = (error.name or "").partition(".")[0]
    return _line(module, user) if module in EXTRAS else None


def check_installed(modules: tuple[str, ...], user: str) -> None:
    """Check that the modules of extras are there, without importing them.

    Args:
        modules: top-level names.
        user: the feature that needs them, such as "plant 'bullet'".

    Raises:
        ConfigurationError: one is missing; the message says the remedy.
    """
    for module in modules:
        if find_spec(module) is None:
            raise ConfigurationError(_line(module, user))


def _line(module: str, user: str) -> str:
    line = f"{user} needs {module}: pip install " + (f"'servobench[{EXTRAS[module]}]'" if module in EXTRAS else module)
    if module == "pybullet" and has_no_wheel():
        version = ".".join(map(str, sys.version_info[:2]))
        line += f" (no wheel for Python {version}: this compiles it for about ten minutes and needs a C++ compiler)"
    return line


CODE_FOLDERS = ("plant", "controllers", "fmus", "harness")  # whose changes change results
COMMIT_DIGITS = 12  # that a reader is shown


@cache  # to read it takes milliseconds, and a manifest has eleven
def installed_version(name: str = "servobench") -> str | None:
    """Return the version of a distribution; None where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


@cache
def git_commit() -> str | None:
    """Return the commit of the checkout this code lies in, marked where code differs from it; None outside one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    commit, changed = _git(root, "rev-parse", "HEAD"), _git(root, "status", "--porcelain", "--", *CODE_FOLDERS)
    return f"{commit}-dirty" if commit and changed else commit


def version_line() -> str:
    """Return the line that `servobench --version` prints."""
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
