"""Runs as environments of Gymnasium: `servobench/Servo-v0`. Needs the extra `gym`.

Gymnasium 1 has no entry points by which a process could find names that it has not imported. So a process that imports
this module also hands the name to processes that it starts by multiprocessing, by every start method.
"""

from multiprocessing import current_process
from typing import final

import gymnasium

ENVIRONMENT = "servobench/Servo-v0"


def register() -> None:
    """Make the environment known to `gymnasium.make` and `make_vec`; once is enough."""
    if ENVIRONMENT not in gymnasium.registry:
        place = "servobench.harness.gym.environment"
        gymnasium.register(
            ENVIRONMENT,
            entry_point=f"{place}:ServoEnv",
            vector_entry_point=f"{place}:ServoVectorEnv",
        )


@final
class Inherited:
    """A mark in the configuration that a process pickles for its children: to unpickle it imports this module there."""

    def __reduce__(self) -> tuple[type["Inherited"], tuple[()]]:
        """Return how it is made anew."""
        return Inherited, ()


register()
vars(current_process()).get("_config", {})[ENVIRONMENT] = Inherited()
