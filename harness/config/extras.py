"""What to install where a package is missing that only an extra brings."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Final

from servobench.harness.config.settings import ConfigurationError

EXTRAS: Final = {  # top-level module -> extra
    "pybullet": "bullet",
    "cv2": "bullet",
    "fmpy": "fmu",
    "casadi": "mpc",
    "jinja2": "report",
    "plotly": "report",
    "itables": "report",
    "optuna": "tune",
    "distributed": "cluster",
    "imageio_ffmpeg": "animation",
}
LATE_IMPORTS: Final = {  # plant, controller or law -> module that a run imports
    "bullet": "pybullet",
    "fmu": "fmpy",
    "ukf_mpc": "casadi",
    "mpc": "casadi",
    "nmpc_calibrated": "casadi",
}


def missing_extra(error: ImportError, what: str) -> str | None:
    """Return the line for the user about an import that failed; None where no extra brings the module.

    Args:
        error: of the import.
        what: what needs the module, such as "plant 'bullet'".
    """
    module = (error.name or "").partition(".")[0]
    return _line(module, what) if module in EXTRAS else None


def check_late_imports(kind: str, name: str) -> None:
    """Refuse a plant or controller whose simulator or solver is not installed, before any run is built.

    Args:
        kind: "plant" or "controller".
        name: such as `bullet`, `fmu:PATH.toml` or `mpc+rls`.

    Raises:
        ConfigurationError: names the extra to install.
    """
    module = LATE_IMPORTS.get(name.split(":", maxsplit=1)[0].split("+", maxsplit=1)[0])
    if module is not None and find_spec(module) is None:
        raise ConfigurationError(_line(module, f"{kind} {name!r}"))


def _line(module: str, what: str) -> str:
    return f"{what} needs {module}: pip install 'servobench[{EXTRAS[module]}]'"
