"""The messages and status words of an FMU."""

from __future__ import annotations

import logging
from collections import deque
from typing import Final

from servobench.plant.faults import FmuError

logger = logging.getLogger("servobench.fmu")

STATUS_WORDS: Final = ("ok", "warning", "discard", "error", "fatal", "pending")
STATUS_LEVELS: Final = (logging.DEBUG, logging.WARNING, logging.WARNING, logging.ERROR, logging.ERROR, logging.DEBUG)
REMEMBERED_MESSAGES: Final = 5


class MessageLog:
    """Forwards an FMU's messages to the log and keeps the last ones for errors."""

    def __init__(self, name: str) -> None:
        """Start empty."""
        self._name = name
        self._last: deque[str] = deque(maxlen=REMEMBERED_MESSAGES)

    def add(self, status: int, message: str) -> None:
        """Take a message with its status."""
        text = " ".join(message.split())
        self._last.append(text)
        level = STATUS_LEVELS[status] if 0 <= status < len(STATUS_LEVELS) else logging.ERROR
        logger.log(level, "%s: %s", self._name, text)

    def failure(self, function: str, outcome: int | str) -> FmuError:
        """Return the error of a call that returned a bad status, or what else the words say, with the last messages.

        The messages are forgotten.
        """
        word = outcome
        if isinstance(outcome, int):
            word = STATUS_WORDS[outcome] if 0 <= outcome < len(STATUS_WORDS) else "nothing usable"
        said = f"; the FMU said: {' | '.join(self._last)}" if self._last else ""
        self._last.clear()
        return FmuError(f"{self._name}: {function} returned {word}{said}")
