"""What a user asks of an FMU in addition to the values of its variables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Asked:
    """Wishes with which an instance is made and begun.

    Attributes:
        tolerance: relative one of its own solver, or of CVode in model exchange; None: what it takes by itself.
        debug_log: file to which all of its messages are appended, with its debug log turned on; None: it is off.
    """

    tolerance: float | None = None
    debug_log: Path | None = None


NOTHING = Asked()
