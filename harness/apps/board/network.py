"""Closes the network for this process and all that it starts, by a filter of system calls of Linux (seccomp).

After it `socket` fails for every family but that of pipes on this machine. The filter, `network.csv`, needs no
privilege and cannot be taken off. Source: Documentation/userspace-api/seccomp_filter.rst of Linux.
"""

import csv
import ctypes
import platform
import struct
import sys
from importlib.resources import files

FILTER = files("servobench.harness.apps.board") / "network.csv"
NO_NEW_PRIVILEGES = 38  # options of prctl(2)
SET_SECCOMP = 22
FILTER_MODE = 2


class _Program(ctypes.Structure):
    """`struct sock_fprog`."""

    _fields_ = (("length", ctypes.c_ushort), ("code", ctypes.c_char_p))


def close_network() -> bool:
    """Refuse sockets to this thread and its later children; return whether this system can."""
    rows = list(csv.DictReader(FILTER.read_text(encoding="utf-8").splitlines()))
    value = f"value_{platform.machine()}"
    if sys.platform != "linux" or value not in rows[0]:
        return False
    columns = ("operation", "if_true", "if_false", value)
    code = b""
    for row in rows:
        code += struct.pack("HBBI", *(int(row[name], 0) for name in columns))
    program = _Program(len(rows), code)
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    if prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0) != 0:
        return False
    return bool(prctl(SET_SECCOMP, FILTER_MODE, ctypes.byref(program), 0, 0) == 0)
