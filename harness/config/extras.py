"""What to install where a package is missing that only an extra brings."""

from __future__ import annotations

from typing import Final

EXTRAS: Final = {  # top-level module -> extra
    "jinja2": "report",
    "plotly": "report",
    "itables": "report",
    "optuna": "tune",
    "distributed": "cluster",
    "imageio_ffmpeg": "animation",
}


def missing_extra(error: ImportError, what: str) -> str | None:
    """Return the line for the user about an import that failed; None where no extra brings the module.

    Args:
        error: of the import.
        what: what needs the module, such as "a film".
    """
    module = (error.name or "").partition(".")[0]
    return f"{what} needs {module}: pip install 'servobench[{EXTRAS[module]}]'" if module in EXTRAS else None
