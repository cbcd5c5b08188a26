"""Worker processes: how many there are, and who hears Ctrl-C."""

from __future__ import annotations

import os
import signal

MAX_DEFAULT_WORKERS = 8


def default_workers() -> int:
    """Return how many worker processes there are unless the user says otherwise."""
    return min(MAX_DEFAULT_WORKERS, len(os.sched_getaffinity(0)))


def leave_interrupts_to_parent() -> None:
    """Let Ctrl-C be the parent's to handle; called in a worker, by each of its jobs."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # a cluster's worker runs its jobs in a thread; it is not stopped from this terminal
        return
