"""The self-test: whether this machine computes as the one whose values are stored did, and by how much not.

`reference.npz` holds `servobench.harness.batch.fingerprint.numbers` of the machine that it describes;
`benchmarks/reference.py` writes it.
"""

import platform
from collections.abc import Iterator
from importlib.resources import as_file, files
from typing import NamedTuple

import numpy as np

from servobench.harness.config.installation import blas_libraries, installed_version
from servobench.plant.contract.checks import NamedArrays

REFERENCE = files("servobench.harness.apps.board") / "reference.npz"
MACHINE = "machine"  # entry with the description
METHODS = (
    "constant", "calibrated", "regression_mfac", "rbfnn_mfac", "ukf_mfac", "ukf_mpc", "calibrating_mfac",
    "nmpc_calibrated",
)  # fmt: skip


class Part(NamedTuple):
    """The result about one part of the arithmetic."""

    name: str
    difference: float  # largest absolute difference; 0 for the same bits
    first: int  # the first row that differs, which is a period of runs; 0 if none does

    def __str__(self) -> str:
        """Return it as a line."""
        said = "bit for bit"
        if self.difference > 0.0:
            said = f"differs by up to {self.difference:.2g}, first in row {self.first}"
        return f"{self.name:20s} {said}"


def describe_machine() -> str:
    """Return what decides the arithmetic of this machine, in a line."""
    words = ["Python", platform.python_version(), platform.machine(), *platform.libc_ver()]
    for name in ("numpy", "scipy"):
        words += [name, str(installed_version(name))]
    for library in blas_libraries():
        words += [str(library[key]) for key in ("name", "version", "kernel")]
    simd = np.show_config(mode="dicts")["SIMD Extensions"]
    words += simd.get("found", [])[-1:]
    return " ".join(words)


def read_reference() -> tuple[str, NamedArrays]:
    """Return the description of the machine of the reference, and its numbers by name."""
    with as_file(REFERENCE) as file, np.load(file) as stored:
        values = dict(stored)
    return str(values.pop(MACHINE)), values


def compare(values: NamedArrays, wanted: NamedArrays) -> Iterator[Part]:
    """Yield the result about each part; the reference has all of them."""
    for name, own in values.items():
        apart = np.abs(own - wanted[name])
        differs = apart.reshape(len(own), -1).any(axis=1)
        yield Part(name, float(apart.max()), int(np.argmax(differs)))
