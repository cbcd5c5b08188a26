"""What to install where a package is missing that only an extra brings."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Final

from servobench.harness.config.settings import ConfigurationError

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


def missing_extra(error: ImportError, what: str) -> str | None:
    """Return the line for the user about an import that failed; None where no extra brings the module.

    Args:
        error: of the import.
        what: what needs the module, such as "a film".
    """
    module = (error.name or "").partition(".")[0]
    return _line(module, what) if module in EXTRAS else None


def check_installed(modules: tuple[str, ...], what: str) -> None:
    """Check that the modules of extras are there, without importing them.

    Args:
        modules: top-level names.
        what: what needs them, such as "plant 'bullet'".

    Raises:
        ConfigurationError: one is missing; the message says what to install.
    """
    for module in modules:
        if find_spec(module) is None:
            raise ConfigurationError(_line(module, what))


def _line(module: str, what: str) -> str:
    line = f"{what} needs {module}: pip install " + (f"'servobench[{EXTRAS[module]}]'" if module in EXTRAS else module)
    if module == "pybullet" and has_no_wheel():
        version = ".".join(map(str, sys.version_info[:2]))
        line += f" (no wheel for Python {version}: this compiles it for about ten minutes and needs a C++ compiler)"
    return line
