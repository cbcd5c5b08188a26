"""PyBullet, imported without the banner that its C library prints.

    from servobench.plant.rendered.bullet.engine import pybullet

The banner comes from C, past `sys.stderr`, so the file descriptor is turned aside during the import. All else that is
written to it in the meantime is passed on afterwards.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator

BANNER = b"pybullet build time:"  # what the line begins with
STANDARD_ERROR = 2  # file descriptor


@contextlib.contextmanager
def without_banner(descriptor: int = STANDARD_ERROR) -> Iterator[None]:
    """Let nothing reach a file descriptor within the context, and afterwards all that came but the banner."""
    try:
        kept = os.dup(descriptor)
    except OSError:  # it is closed, so nothing can be printed
        yield
        return
    with tempfile.TemporaryFile() as aside:
        os.dup2(aside.fileno(), descriptor)
        try:
            yield
        finally:
            os.dup2(kept, descriptor)
            os.close(kept)
            aside.seek(0)
            others = b"".join(line for line in aside if not line.startswith(BANNER))
            while others:
                others = others[os.write(descriptor, others) :]


with without_banner():
    import pybullet

__all__ = ["pybullet"]
