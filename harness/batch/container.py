"""Limits of memory and processors of the container in which this process runs, if it runs in one.

A container is a control group of Linux. Its limits, and those of the groups around it, are files below the mount of its
hierarchy, in version 1 and 2 of the interface (https://docs.kernel.org/admin-guide/cgroup-v2.html). A container that
sees the whole hierarchy has a path below the mount; for one that sees itself only, the mount is its group.
"""

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path

ROOT = Path("/")
# The last is that of version 1
MEMORY_LIMITS = ("memory.max", "memory.high", "memory.limit_in_bytes")


def memory_limit(root: Path = ROOT) -> float:
    """Return the memory [bytes] that this process and its relatives may hold together; infinity for no limit.

    Args:
        root: of the file system in which the files of the system are looked up.
    """
    limits = [math.inf]
    for group in _groups(root):
        for name in MEMORY_LIMITS:
            limits += _numbers(group / name)[:1]
    return min(limit for limit in limits if limit > 0.0)


def processor_limit(root: Path = ROOT) -> float:
    """Return the share of time of processors that this process may use, such as 1.5; `memory_limit` has the rest."""
    limits = [math.inf]
    for group in _groups(root):
        pair = _numbers(group / "cpu.max")
        if not pair:
            pair = _numbers(group / "cpu.cfs_quota_us") + _numbers(group / "cpu.cfs_period_us")
        if len(pair) == 2 and min(pair) > 0.0:
            quota, period = pair
            limits.append(quota / period)
    return min(limits)


def _groups(root: Path) -> Iterator[Path]:
    """Yield the folders of the control groups of this process, from each group to the mount of its hierarchy."""
    mounts = root / "sys/fs/cgroup"
    with contextlib.suppress(OSError, UnicodeDecodeError):
        for line in (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines():
            _, _, rest = line.partition(":")
            controllers, _, path = rest.partition(":")
            names = {controllers, *controllers.split(",")}
            if not controllers:
                names = {"", "unified"}
            for name in sorted(names):
                group = mounts / name / path.lstrip("/")
                yield group
                yield from group.parents[: len(group.parts) - len((mounts / name).parts)]
    yield mounts


def _numbers(file: Path) -> list[float]:
    """Return the numbers in a file, infinity for its word max; none where there is no such file."""
    try:
        return [
            float(word.replace("max", "inf")) for word in file.read_text(encoding="ascii").split()
        ]
    except (OSError, ValueError):
        return []
