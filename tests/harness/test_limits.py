"""What a run may take, whose code is kept apart, and the processes below one."""

import math
import os
import subprocess
import sys

import pytest

from kit.command import carried_out
from servobench.controllers.methods import METHODS
from servobench.harness.batch import processes
from servobench.harness.batch.blocks import open_workers
from servobench.harness.batch.processes import FOREIGN_TIME, LEAST_FOREIGN_MEMORY, Bounds, Limits, read_size, show_size
from servobench.harness.config.registry import is_foreign_controller, is_foreign_plant


@pytest.mark.parametrize(
    ("text", "size"),
    [("2GB", 2e9), ("500 MB", 5e8), ("1.5gb", 1.5e9), ("64kB", 64e3), ("1TB", 1e12), ("100B", 100), ("inf", math.inf)],
)
def test_sizes_are_read_as_they_are_written(text, size):
    assert read_size(text) == size


@pytest.mark.parametrize(("size", "text"), [(2e9, "2 GB"), (6.5e8, "650 MB"), (64e3, "64 kB"), (100, "100 B")])
def test_sizes_are_shown_in_their_largest_unit(size, text):
    assert show_size(int(size)) == text


def test_only_foreign_code_has_limits_that_nobody_gave():
    assert Bounds().limits(2, foreign=False) == Limits()
    usual = Bounds().limits(2, foreign=True)
    assert usual.time == FOREIGN_TIME
    assert usual.memory is not None
    assert usual.memory >= LEAST_FOREIGN_MEMORY
    assert not usual.addresses
    assert Bounds(math.inf, math.inf).limits(2, foreign=True) == Limits(addresses=True)
    assert Bounds(3.0, 1e9).limits(2, foreign=False) == Limits(3.0, 10**9, addresses=True)


def test_methods_of_this_package_are_not_foreign_and_everything_else_is():
    own = [*METHODS, "nmpc_calibrated", "mfac+rls"]
    assert [name for name in own if is_foreign_controller(name)] == []
    assert is_foreign_controller("mine")
    assert is_foreign_controller("mine+rls")
    assert [is_foreign_plant(name) for name in ("kinematic", "bullet", "fmu")] == [False] * 3
    assert is_foreign_plant("fmu:arm.toml")
    assert is_foreign_plant("mine")


@pytest.mark.parametrize(
    ("bounds", "controllers", "here"),
    [
        (Bounds(), ("constant",), True),
        (Bounds(), ("mine",), False),
        (Bounds(isolate=False), ("mine",), True),
        (Bounds(run_timeout=9.0, isolate=False), ("mine",), False),
        (Bounds(run_memory=1e9), ("constant",), False),
    ],
)
def test_one_worker_is_this_process_unless_code_is_foreign_or_limited(bounds, controllers, here):
    with open_workers(1, bounds=bounds, plants=("kinematic",), controllers=controllers) as workers:
        assert (workers.submit is None) == here


FAMILY = """
import os, sys, time
if os.fork() == 0:
    held = bytearray(50_000_000)
    print(os.getpid(), flush=True)
    time.sleep(60)
time.sleep(60)
"""


def test_processes_below_one_are_found_with_their_memory():
    with subprocess.Popen([sys.executable, "-S", "-c", FAMILY], stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        try:
            assert child in processes.descendants(os.getpid())
            assert processes.descendants(parent.pid) == [child]
            assert processes.resident_memory([child]) > 50e6
            assert 50e6 < processes.own_memory([child]) <= processes.resident_memory([child])
        finally:
            os.kill(child, 9)
            parent.kill()
    assert processes.descendants(parent.pid) == []
    assert processes.resident_memory([parent.pid]) == 0


ADOPTED = """
import os, subprocess, sys, time
from servobench.harness.batch import processes
processes.adopt_orphans()
twice = "import os, time; os.fork() and os._exit(0); os.setsid(); os.fork() and os._exit(0); time.sleep(60)"
subprocess.run([sys.executable, "-S", "-c", twice])
while len(below := processes.descendants(os.getpid())) != 1:
    processes.collect_ended(below)
    time.sleep(0.01)
processes.end_descendants()
print(processes.descendants(os.getpid()))
"""


def test_a_process_that_left_its_session_and_its_parent_is_ended_all_the_same():
    done = carried_out(sys.executable, "-c", ADOPTED, timeout=50)
    assert (done.returncode, done.stdout) == (0, "[]\n")
