"""What a command opens for writing, renames, removes or starts, by an audit hook of Python."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
# Arguments that are written, by event
TARGETS = {"os.rename": (0, 1), "os.link": (1,), "os.symlink": (1,)}
TARGETS |= dict.fromkeys(
    ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod", "shutil.rmtree"), (0,)
)
RELATIVE = ("os.mkdir", "os.remove", "os.rmdir", "os.rename")
# Which servobench, matplotlib and the platform module start
OWN_PROGRAMS = ("git", "fc-list", "uname")
PROGRAMS = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen")
_notes: list[list[tuple[str, str]]] = []  # the list of the moment: a hook cannot be taken away


def _note(event: str, arguments: tuple[object, ...]) -> None:
    if not _notes:
        return
    if event == "open":
        path, mode, flags = arguments
        if isinstance(path, str | bytes) and (set(str(mode)) & set("wax+") or int(flags) & WRITING):
            _notes[-1].append((event, os.path.realpath(os.fsdecode(path))))
    elif event in TARGETS:
        # A descriptor of the folder from which paths count
        at = arguments[-1] if event in RELATIVE else -1
        base = Path(f"/proc/self/fd/{at}" if isinstance(at, int) and at >= 0 else "")
        for given in (arguments[index] for index in TARGETS[event]):
            if not isinstance(given, int):  # an open file was noted when it was opened
                path = base / os.fsdecode(given)
                _notes[-1].append((event, str(path.parent.resolve() / path.name)))
    elif event in PROGRAMS and Path(str(arguments[0])).name not in OWN_PROGRAMS:
        _notes[-1].append((event, str(arguments[0])))


sys.addaudithook(_note)


@contextmanager
def noting() -> Iterator[list[tuple[str, str]]]:
    """Yield what is opened for writing, renamed, removed or started within the context."""
    _notes.append([])
    try:
        yield _notes[-1]
    finally:
        _notes.pop()
