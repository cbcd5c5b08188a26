"""Where the runs of a sweep happen: processes of this machine, or a Dask cluster. The one module that imports Dask."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from typing import Any

from servobench.harness.config.settings import ConfigurationError

ANSWER_WITHIN = 10.0  # s, for the scheduler and for its first worker


@dataclass(frozen=True)
class Backend:
    """A place to run at.

    Attributes:
        arguments: of `joblib.parallel_config`.
        workers: runs at once; -1 for all that a cluster offers.
        lost: what is raised when a run has killed its worker.
    """

    workers: int
    arguments: Mapping[str, Any] = field(default_factory=dict)
    lost: tuple[type[BaseException], ...] = (BrokenProcessPool,)


@contextlib.contextmanager
def open_backend(scheduler: str | None, workers: int) -> Iterator[Backend]:
    """Yield the backend: local processes, or the Dask cluster behind the address `scheduler`.

    Args:
        scheduler: such as "tcp://127.0.0.1:8786"; None for local processes.
        workers: number of local processes.

    Raises:
        ConfigurationError: no Dask installed, or a scheduler that does not answer or has no workers.
    """
    if scheduler is None:
        yield Backend(workers)
        return
    if not re.fullmatch(r"(?:[a-z]+://)?\S+:\d+", scheduler):
        raise ConfigurationError(f"--scheduler needs an address such as tcp://127.0.0.1:8786, got {scheduler!r}")
    from distributed import Client, KilledWorker  # noqa: PLC0415 - only the extra cluster brings it

    try:
        client = Client(scheduler, timeout=ANSWER_WITHIN, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"the scheduler {scheduler} does not answer; start one with `dask scheduler` and name its address"
        ) from error
    try:
        try:
            client.wait_for_workers(1, timeout=ANSWER_WITHIN)
        except TimeoutError as error:
            raise ConfigurationError(
                f"the scheduler {scheduler} has no workers; start some with `dask worker {scheduler} --nthreads 1`"
            ) from error
        yield Backend(-1, {"backend": "dask", "client": client}, (KilledWorker,))
    finally:
        client.close()
