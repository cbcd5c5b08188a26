"""The command `servobench`, also as `python -m servobench`."""

import atexit
import contextlib
import gc
import os
import sys


def main() -> None:
    """Run the command, which is imported late: a worker process imports this module before it can end with it."""
    # Imports make lasting objects only: the collector would visit them again and again
    gc.set_threshold(200_000)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Pydantic would look for plug-ins of its own in every installed distribution
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    succeeded: list[bool] = []
    # The function that is registered first is called last, after all others
    atexit.register(_leave, succeeded)
    from servobench.harness.cli.main import main as command

    try:
        command()
    except SystemExit as ending:
        if not ending.code:
            succeeded.append(True)
        raise
    finally:
        # The collector would visit every object several times while the process ends
        gc.freeze()


def _leave(succeeded: list[bool]) -> None:
    """End the process of a command that succeeded without freeing its modules, which takes 2 % of a short run.

    Nothing is done under a profiler or debugger, whose own functions for the end are called after this one.
    """
    if not succeeded or sys.gettrace() or sys.getprofile():
        return
    import ctypes

    # Where the output cannot be written, Python goes on to its usual end, and says so there.
    with contextlib.suppress(OSError, ValueError):
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        ctypes.CDLL(None).fflush(None)  # what a library has written by itself
        os._exit(0)


if __name__ == "__main__":
    main()
