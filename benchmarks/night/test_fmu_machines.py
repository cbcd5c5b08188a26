"""Exported FMUs on machines that this one imitates: ARM under qemu rounds as x86-64 does, Windows but for sin and cos.

Skipped where qemu, wine or zig is not installed; the libraries of macOS cannot be run here.
"""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from kit.controller_fmus import experiment, inputs_of, periods, recorded
from night.other_machines import drive, machines, unpack
from servobench.fmus.compiler import this_platform
from servobench.fmus.export import ExportOptions, product

PERIOD = 0.05
STEPS = 1000
EXACT, ROUNDED = 0.0, 1e-15  # largest difference: Windows has a sin and a cos of its own
TOLERANCES = {"aarch64-linux": EXACT, "x86_64-windows": ROUNDED}
MACHINES = [
    pytest.param(
        machine,
        id=machine.name,
        marks=pytest.mark.skipif(
            bool(machine.lacking), reason=f"{machine.name} needs {machine.lacking}"
        ),
    )
    for machine in machines()
]
NEEDS_CC = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder for what wine writes at its first start, which takes long."""
    return tmp_path_factory.mktemp("home")


@NEEDS_CC
@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("version", [2, 3])
def test_the_arm_moves_alike_over_a_thousand_random_steps(version, machine, tmp_path, home):
    made = product(ExportOptions(version))
    first = made.description.layout.offsets["joint_velocity_command"]
    commands = np.random.default_rng(1).uniform(-1.3, 1.3, (STEPS, 6))
    unpacked = unpack(made, (this_platform(), machine.platform), tmp_path)
    here, there = (
        drive(unpacked, made, each, commands, first=first, step=PERIOD, home=home)
        for each in (None, machine)
    )
    assert here.shape == there.shape == (STEPS, made.description.layout.size)
    assert np.ptp(here, axis=0).max() > 1.0
    np.testing.assert_allclose(there, here, rtol=0, atol=TOLERANCES[machine.name])


@NEEDS_CC
@pytest.mark.parametrize("machine", MACHINES)
def test_a_controller_commands_as_its_original_does(machine, tmp_path, home):
    made, (*rows,) = recorded("ukf_mfac").product(2), periods(experiment("ukf_mfac"))
    inputs = np.array([inputs_of(seen, desired) for seen, desired, _ in rows])
    unpacked = unpack(made, (machine.platform,), tmp_path)
    there = drive(unpacked, made, machine, inputs, step=PERIOD, home=home)[:, inputs.shape[1] :][
        :, :6
    ]
    wanted = np.array([command.joint_velocity for *_, command in rows])
    assert np.ptp(wanted, axis=0).max() > 0.1
    np.testing.assert_allclose(there, wanted, rtol=0, atol=1e-9)
