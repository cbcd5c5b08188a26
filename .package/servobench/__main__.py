"""The command `servobench`, also as `python -m servobench`."""

import gc
import os


def main() -> None:
    """Run the command, which is imported late: a worker process imports this module before it can end with it."""
    # Imports make lasting objects only: the collector would visit them again and again
    gc.set_threshold(200_000)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Pydantic would look for plug-ins of its own in every installed distribution
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    from servobench.harness.cli.main import main as command

    try:
        command()
    finally:
        # The collector would visit every object several times while the process ends
        gc.freeze()


if __name__ == "__main__":
    main()
