"""The installation: version and commit of servobench, and the extras that bring missing packages."""

import os
import subprocess
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from servobench.plant.contract.faults import ConfigurationError

EXTRAS = {  # top-level module -> extra
    "pybullet": "bullet",
    "mujoco": "mujoco",
    "jinja2": "report",
    "optuna": "tune",
    "distributed": "cluster",
    "gymnasium": "gym",
    "onnxruntime": "onnx",
    "rosbags": "bag",
    "mcap_ros2": "bag",
    "imageio_ffmpeg": "animation",
    "yourdfpy": "urdf",
    "viser": "play",
}
NO_WHEELS = (3, 12)  # first version of Python for which PyBullet 3.2 offers none


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
    if module in EXTRAS:
        return _line(module, user)
    return None


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
    wanted = module
    if module in EXTRAS:
        wanted = f"'servobench[{EXTRAS[module]}]'"
    line = f"{user} needs {module}: pip install {wanted}"
    if module == "pybullet" and has_no_wheel():
        version = ".".join(map(str, sys.version_info[:2]))
        line += f" (no wheel for Python {version}: this compiles it for about ten minutes and needs a C++ compiler)"
    return line


CODE_FOLDERS = ("plant", "controllers", "fmus", "harness")  # whose changes change results
COMMIT_DIGITS = 12  # that a reader is shown
DIRTY = "-dirty"  # mark of a commit where code differs from it
# File beside the code of a built distribution that holds the commit; .ci/commit_hook.py writes it
COMMIT_FILE = "commit.txt"
# Folder of the checkout, if this code lies in one
CHECKOUT = Path(__file__).resolve().parents[2]
GIT_TIME = 10.0  # [s] for an answer of git
OTHER_CHECKOUT = frozenset(  # variables by which a hook of git names a checkout, maybe another one
    (
        "GIT_DIR",
        "GIT_WORK_TREE",
        "GIT_INDEX_FILE",
        "GIT_COMMON_DIR",
        "GIT_OBJECT_DIRECTORY",
        "GIT_NAMESPACE",
        "GIT_PREFIX",
    )
)


@cache  # to read it takes milliseconds, and a manifest has eleven
def installed_version(name: str = "servobench") -> str | None:
    """Return the version of a distribution; None where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


class CommitUnknown(Exception):
    """The commit of a checkout cannot be told; the message is the reason."""


@cache
def read_checkout() -> tuple[str | None, str | None]:
    """Return the commit of the checkout this code lies in, and why it is unknown; None where one does not apply.

    The commit is marked where code differs from it.
    """
    try:
        return read_commit(CHECKOUT), None
    except CommitUnknown as error:
        return None, str(error)


def version_line() -> str:
    """Return the line that `servobench --version` prints."""
    line = f"servobench {installed_version() or 'not installed'}"
    commit, reason = read_checkout()
    if commit is not None:
        return f"{line} (commit {short_commit(commit)})"
    if reason is None:
        return line
    return f"{line} (commit unknown: {reason})"


def short_commit(commit: str) -> str:
    """Return a commit as a reader is shown it."""
    hash_, dirty, _ = commit.partition(DIRTY)
    short = hash_[:COMMIT_DIGITS]
    if dirty:
        return f"{short}, with changes"
    return short


def blas_libraries() -> list[dict[str, Any]]:
    """Return the loaded libraries of linear algebra (BLAS): name, version, kernel and number of threads of each.

    A library that threadpoolctl does not know has the name and the version with which numpy was built.
    """
    import numpy as np  # noqa: PLC0415 - the version is printed without it

    from servobench.plant.contract.lanes import find_libraries  # noqa: PLC0415 - likewise

    found = [
        {
            "name": each["internal_api"],
            "version": each["version"],
            "kernel": each.get("architecture"),
            "threads": each["num_threads"],
        }
        for each in find_libraries().info()
        if each["user_api"] == "blas"
    ]
    if not found:
        blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
        found.append(
            {
                "name": blas.get("name"),
                "version": blas.get("version"),
                "threads": None,
                "kernel": None,
            }
        )
    return found


def read_commit(root: Path) -> str | None:
    """Return the commit of a checkout, marked where code differs from it, or of an installed distribution.

    None where a folder is neither.

    Raises:
        CommitUnknown: git is not there, or refuses to answer.
    """
    if not (root / ".git").exists():
        built = root / COMMIT_FILE
        if not built.is_file():
            return None
        return built.read_text(encoding="ascii").strip()
    # One call tells the commit, a line "# branch.oid COMMIT", and a line without "#" for each file that differs.
    lines = _git(root, "status", "--porcelain=v2", "--branch", "--", *CODE_FOLDERS).splitlines()
    commit = lines[0].removeprefix("# branch.oid ")
    if commit == "(initial)":
        raise CommitUnknown("the checkout has no commit yet")
    changed = not lines[-1].startswith("#")
    return f"{commit}{DIRTY}" if changed else commit


def _git(root: Path, *words: str) -> str:
    environment = {name: value for name, value in os.environ.items() if name not in OTHER_CHECKOUT}
    environment["LC_ALL"] = "C"
    try:
        answer = subprocess.run(
            ["git", *words],
            cwd=root,
            env=environment,
            capture_output=True,
            text=True,
            timeout=GIT_TIME,
            check=True,
        )
    except subprocess.CalledProcessError as error:
        said = str(error.stderr).strip().partition("\n")[0].removeprefix("fatal: ")
        if "dubious ownership" in said:
            raise CommitUnknown(
                f"the checkout belongs to another user; git config --global --add safe.directory {root}"
            ) from error
        raise CommitUnknown(f"git says: {said}") from error
    except subprocess.TimeoutExpired as error:
        raise CommitUnknown(f"git took longer than {GIT_TIME:g} s") from error
    except OSError as error:
        raise CommitUnknown(f"git cannot be run: {error.strerror}") from error
    return answer.stdout.strip()
