"""The command line in forks of a process that has all packages in memory but the extras."""

import os
import sys
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

CONTEXT = get_context("forkserver")
CONTEXT.set_forkserver_preload(
    ["servobench.harness.batch.campaign", "servobench.harness.run.episode"]
)


@dataclass(frozen=True)
class Done:
    """How a command ended."""

    returncode: int | None
    stdout: str
    stderr: str


def servobench_without(blocked, arguments, folder: Path, **environment: str) -> Done:
    """Run `servobench` with arguments in a folder of its own process, which cannot import what is blocked."""
    streams = [folder.with_name(folder.name + end) for end in (".out", ".err")]
    process = CONTEXT.Process(
        target=_call, args=(tuple(blocked), arguments, folder, streams, environment)
    )
    # Where a test of Gymnasium ran before, the process would inherit its environment, and import it.
    process._config.pop("servobench/Servo-v0", None)
    process.start()
    process.join()
    return Done(process.exitcode, *(stream.read_text(encoding="utf-8") for stream in streams))


def _call(blocked, arguments, folder, streams, environment) -> None:
    for descriptor, stream in enumerate(streams, 1):
        os.dup2(os.open(stream, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
    os.chdir(folder)
    os.environ.update(environment)
    assert not sys.modules.keys() & set(blocked)
    sys.modules.update(dict.fromkeys(blocked))
    if arguments[0] == "run":  # whose figures take seconds
        names = ("Choice", "KINDS", "Order", "folder_figures", "draw_figures", "FOLDER")
        figures = SimpleNamespace(**dict.fromkeys(names, lambda *_: []))
        figures.FOLDER = "figures"
        sys.modules["servobench.harness.apps.figures.figures"] = figures
    sys.argv = ["servobench", *arguments]
    from servobench.harness.cli.main import main

    main()


def say_modules(_argument, tell):
    """Tell, as a task of a worker, which of two packages it has imported."""
    tell([name for name in ("pandas", "numpy.ma") if name in sys.modules])
