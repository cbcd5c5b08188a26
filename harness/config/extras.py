"""What to install where a package is missing that only an extra brings."""

from __future__ import annotations

from typing import Final

EXTRAS: Final = {  # top-level module -> extra
    "pybullet": "bullet",
    "cv2": "bullet",
    "fmpy": "fmu",
    "casadi": "mpc",
    "jinja2": "report",
    "plotly": "report",
    "itables": "report",
    "PIL": "report",
    "optuna": "tune",
    "distributed": "cluster",
    "imageio_ffmpeg": "animation",
}


def missing_extra(error: ImportError, what: str) -> str | None:
    """Return the line for the user about an import that failed; None where no extra brings the module.

    Args:
        error: of the import.
        what: what needs the module, such as "plant 'bullet'".
    """
    module = (error.name or "").partition(".")[0]
    extra = EXTRAS.get(module)
    return None if extra is None else f"{what} needs {module}: pip install 'servobench[{extra}]'"
