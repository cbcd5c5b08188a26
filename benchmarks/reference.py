"""Writes the numbers against which `servobench selftest` compares, on the machine that made the figures of the pages.

    python benchmarks/reference.py

The self-test names this machine; whoever renews the figures of the pages on another one renews the numbers, too.
"""

import numpy as np

from servobench.harness.apps.board.selftest import MACHINE, METHODS, REFERENCE, describe_machine
from servobench.harness.batch.fingerprint import numbers

PLANTS = ("kinematic", "bullet", "mujoco")

if __name__ == "__main__":
    values = numbers((), METHODS)
    machine = describe_machine()  # before engines load libraries of their own
    values |= numbers(PLANTS, ())
    np.savez_compressed(str(REFERENCE), **{MACHINE: np.array(machine)}, **values)
    print(machine)
