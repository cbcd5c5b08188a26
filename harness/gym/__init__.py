"""Runs as environments of Gymnasium: `servobench/Servo-v0`. Needs the extra `gym`."""

from typing import Final

import gymnasium

ENVIRONMENT: Final = "servobench/Servo-v0"


def register() -> None:
    """Make the environment known to `gymnasium.make` and `make_vec`; once is enough."""
    if ENVIRONMENT not in gymnasium.registry:
        place = "servobench.harness.gym.environment"
        gymnasium.register(ENVIRONMENT, entry_point=f"{place}:ServoEnv", vector_entry_point=f"{place}:ServoVectorEnv")


register()
