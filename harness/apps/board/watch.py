"""Watches what code of a user touches: files, network, programs.

The events are those of `sys.addaudithook`, which nothing in the process can take off again. It is a witness, no wall:
compiled code raises no events. What it misses, the comparison of commands may find.
"""

import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from servobench.harness.config.source import PACKAGE_FOLDER
from servobench.harness.run.result import NETWORKS
from servobench.plant.contract.cache import cache_folder

TOUCHES = {  # event -> what the code does
    "socket.__new__": "uses the network",
    "subprocess.Popen": "starts a program",
    "os.system": "starts a program",
    "os.exec": "starts a program",
    "os.posix_spawn": "starts a program",
    "os.fork": "starts a process",
}
SYSTEM = ("/dev/", "/etc/", "/proc/", "/sys/", "/usr/")  # where libraries look, and no user writes


def watch(folders: Iterable[Path], note: Callable[[str], None]) -> None:
    """Note from now on what this process touches besides files of the system, of packages and in some folders."""
    prefixes = Path(sys.prefix), Path(sys.base_prefix)
    known = (*folders, PACKAGE_FOLDER, cache_folder(NETWORKS), *prefixes)
    # As code may name them, and without links
    places = [path for each in known for path in (os.path.abspath(each), str(each.resolve()))]  # noqa: PTH100
    allowed = (*SYSTEM, *places)

    def hear(event: str, arguments: tuple[Any, ...]) -> None:
        if event in TOUCHES:
            note(TOUCHES[event])
        # A file that is open already is no text
        if event == "open" and isinstance(arguments[0], str | bytes):
            path = os.path.abspath(os.fsdecode(arguments[0]))  # noqa: PTH100 - no link is followed
            if not path.startswith(allowed):
                note(f"opens the file {path}")

    sys.addaudithook(hear)
