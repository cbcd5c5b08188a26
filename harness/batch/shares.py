"""A work that copies of this process share among themselves, such as drawing the figures of a folder."""

import pickle
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from multiprocessing import current_process
from typing import Any, NamedTuple, TypeVar

from servobench.harness.batch.isolation import Pool, Task, Tell
from servobench.harness.batch.processes import Limits, available_processors

MAX_COPIES = 8  # that share a work
Piece = TypeVar("Piece")


class Share(NamedTuple):
    """Every n-th piece of a work."""

    first: int = 0
    step: int = 1

    def of(self, pieces: Iterable[Piece]) -> Iterator[tuple[int, Piece]]:
        """Return the pieces of this share with their numbers."""
        return islice(enumerate(pieces), self.first, None, self.step)


WHOLE = Share()


def in_shares(work: Callable[[Any, Share], Iterable[Any]], argument: object) -> list[Any]:
    """Return the answers to a work, which copies of this process share among themselves, in its order.

    Args:
        work: takes the argument and a share; yields JSON values that begin with the number of their piece.
        argument: of the work; it can be pickled.

    Raises:
        Exception: the work raises it in this process, which does alone what the copies could not do.
    """
    count = min(MAX_COPIES, available_processors())
    if count > 1 and not current_process().daemon:
        pool = Pool(count, Limits(), (), copied=True)
        try:
            given = [pickle.dumps((work, argument, Share(k, count))) for k in range(count)]
            futures = [pool.submit(Task(_tell_share, each)) for each in given]
            answers = [future.result() for future in futures]
        finally:
            pool.stop(0.0)
        if not any(answer.end for answer in answers):
            return sorted(item for answer in answers for item in answer.items)
    return list(work(argument, WHOLE))


def _tell_share(packed: tuple[Callable[..., Iterable[Any]], object, Share], tell: Tell) -> None:
    work, argument, share = packed
    for answer in work(argument, share):
        tell(answer)
