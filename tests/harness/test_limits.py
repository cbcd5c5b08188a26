"""What a run may take, whose code is kept apart, and the processes below one."""

import math
import os
import subprocess
import sys

import psutil
import pytest

from kit.command import carried_out
from servobench.controllers.methods import METHODS
from servobench.harness.batch import blocks, processes
from servobench.harness.batch.blocks import open_workers
from servobench.harness.batch.container import memory_limit, processor_limit
from servobench.harness.batch.processes import (
    FOREIGN_TIME,
    LEAST_FOREIGN_MEMORY,
    Bounds,
    Limits,
    read_size,
    show_size,
)
from servobench.harness.config.registry import is_foreign_controller, is_foreign_plant


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("2GB", 2e9),
        ("500 MB", 5e8),
        ("1.5gb", 1.5e9),
        ("64kB", 64e3),
        ("1TB", 1e12),
        ("100B", 100),
        ("inf", math.inf),
    ],
)
def test_sizes_are_read_as_they_are_written(text, size):
    assert read_size(text) == size


@pytest.mark.parametrize(
    ("size", "text"), [(2e9, "2 GB"), (6.5e8, "650 MB"), (64e3, "64 kB"), (100, "100 B")]
)
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


@pytest.mark.parametrize(
    ("files", "memory", "processors"),
    [
        ({"proc/self/cgroup": "0::/", "memory.max": "2000000000", "cpu.max": "100000 100000"}, 2e9, 1.0),
        ({"memory.max": "2000000000", "cpu.max": "150000 100000"}, 2e9, 1.5),
        ({"proc/self/cgroup": "0::/a/b", "a/memory.max": "3e9", "a/b/memory.max": "max"}, 3e9, math.inf),
        ({"proc/self/cgroup": "0::/a/b", "a/cpu.max": "200000 100000", "a/b/cpu.max": "max 100000"}, math.inf, 2.0),
        ({"proc/self/cgroup": "0::/a", "a/memory.max": "max", "a/memory.high": "1000000000"}, 1e9, math.inf),
        (
            {
                "proc/self/cgroup": "12:cpu,cpuacct:/docker/x\n4:memory:/docker/x\n0::/",
                "memory/docker/x/memory.limit_in_bytes": "2147483648",
                "memory/memory.limit_in_bytes": "9223372036854771712",
                "cpu,cpuacct/docker/x/cpu.cfs_quota_us": "50000",
                "cpu,cpuacct/docker/x/cpu.cfs_period_us": "100000",
            },
            2.0**31,
            0.5,
        ),
        (
            {
                "proc/self/cgroup": "4:memory:/docker/unseen\n3:cpu,cpuacct:/docker/unseen",
                "memory/memory.limit_in_bytes": "4000000000",
                "cpu/cpu.cfs_quota_us": "-1",
                "cpu/cpu.cfs_period_us": "100000",
            },
            4e9,
            math.inf,
        ),
        ({"proc/self/cgroup": "0::/", "unified/memory.max": "5000000000"}, 5e9, math.inf),
        ({"proc/self/cgroup": "no line", "memory.max": "", "cpu.max": "0 100000"}, math.inf, math.inf),
        ({}, math.inf, math.inf),
    ],
)  # fmt: skip
def test_limits_of_a_container_are_those_of_its_group_and_of_the_groups_around_it(
    files, memory, processors, tmp_path
):
    for name, text in files.items():
        path = tmp_path / (name if name.startswith("proc") else f"sys/fs/cgroup/{name}")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")
    assert memory_limit(tmp_path) == memory
    assert processor_limit(tmp_path) == processors


@pytest.mark.parametrize(
    ("machine", "container", "workers", "wanted"),
    [
        (32e9, math.inf, 2, 12.8e9),
        (4e9, math.inf, 4, 2e9),
        (1e9, math.inf, 1, 0.8e9),
        (32e9, 2e9, 1, 1.6e9),
        (32e9, 2e9, 2, 0.8e9),
    ],
)
def test_foreign_code_gets_a_share_of_the_memory_that_is_there(
    machine, container, workers, wanted, monkeypatch
):
    total = psutil.virtual_memory()._replace(total=machine)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: total)
    monkeypatch.setattr(processes, "memory_limit", lambda: container)
    assert Bounds().limits(workers, foreign=True).memory == pytest.approx(wanted)


@pytest.mark.parametrize(("limit", "wanted"), [(0.5, 1), (1.0, 1), (1.9, 1)])
def test_workers_are_as_many_as_whole_processors(limit, wanted, monkeypatch):
    monkeypatch.setattr(processes, "processor_limit", lambda: limit)
    assert processes.available_processors() == wanted


def test_memory_counts_as_a_whole_where_the_system_does_not_say_which_part_is_shared(monkeypatch):
    def refuse(process):
        raise psutil.AccessDenied(process.pid)

    monkeypatch.setattr(psutil.Process, "memory_full_info", refuse)
    assert processes.own_memory([os.getpid()]) > 10e6


def test_a_system_that_hides_processes_is_named_where_there_are_limits(monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(blocks, "remark", said.append)
    monkeypatch.setattr(processes, "_ask", lambda *_: None)
    for limit in (math.inf, 1e9):
        with open_workers(
            1, bounds=Bounds(run_memory=limit), plants=("kinematic",), controllers=("constant",)
        ):
            pass
    assert [line.partition(",")[0] for line in said] == [
        "the memory and the processes of a run cannot be watched here"
    ]


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


@pytest.mark.parametrize("listed", [True, False])
def test_processes_below_one_are_found_with_their_memory(listed, monkeypatch):
    if not listed:  # as gVisor's kernel
        monkeypatch.setattr(processes, "_lists_children", lambda: False)
    with subprocess.Popen(
        [sys.executable, "-S", "-c", FAMILY], stdout=subprocess.PIPE, text=True
    ) as parent:
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
