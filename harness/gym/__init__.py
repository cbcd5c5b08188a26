"""Runs as environments of Gymnasium: `servobench/Servo-v0`. Needs the extra `gym`."""

from typing import Final

import gymnasium

ENVIRONMENT: Final = "servobench/Servo-v0"


def register() -> None:
    """Make the environment known to `gymnasium.make` and `make_vec`; once is enough."""
    if ENVIRONMENT not in gymnasium.registry:
        gymnasium.register(
            ENVIRONMENT,
            entry_point="servobench.harness.gym.environment:ServoEnv",
            vector_entry_point="servobench.harness.gym.environment:ServoVectorEnv",
        )


register()
