"""The messages and status words of an FMU."""

from __future__ import annotations

import logging
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Final

from servobench.plant.contract.faults import FmuError

logger = logging.getLogger("servobench.fmu")

STATUS_WORDS: Final = ("ok", "warning", "discard", "error", "fatal", "pending")
STATUS_LEVELS: Final = (logging.DEBUG, logging.WARNING, logging.WARNING, logging.ERROR, logging.ERROR, logging.DEBUG)
REMEMBERED_MESSAGES: Final = 5


class MessageLog:
    """Forwards an FMU's messages to the log and keeps the last ones for errors."""

    def __init__(self, name: str, file: Path | None = None) -> None:
        """Start empty; messages are also appended to `file`, if one is given.

        Raises:
            ValueError: the file cannot be written.
        """
        self._name, self._file = name, file
        try:
            self._append(f"an instance of {name}")
        except OSError as error:
            raise ValueError(f"debug_log {file} cannot be written: {error.strerror}") from error
        self._last: deque[str] = deque(maxlen=REMEMBERED_MESSAGES)

    def add(self, status: int, message: str) -> None:
        """Take a message with its status."""
        text = " ".join(message.split())
        self._last.append(text)
        level = STATUS_LEVELS[status] if 0 <= status < len(STATUS_LEVELS) else logging.ERROR
        logger.log(level, "%s: %s", self._name, text)
        word = STATUS_WORDS[status] if 0 <= status < len(STATUS_WORDS) else f"status {status}"
        with suppress(OSError):  # no exception passes through the FMU that calls this
            self._append(f"{word}: {text}")

    def _append(self, line: str) -> None:
        """Write a line to the file, if there is one."""
        if self._file is not None:
            with self._file.open("a", encoding="utf-8") as file:
                file.write(f"{line}\n")

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
