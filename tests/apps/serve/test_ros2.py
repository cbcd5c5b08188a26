"""The bench as a robot and docs/examples/on_ros2.py as a node talk through ROS 2 itself, each in its own process."""

import itertools
import os
import signal
import subprocess
import sys
import time
import tomllib
from contextlib import contextmanager
from importlib.util import find_spec

import numpy as np
import pytest

import servobench
from kit.command import PACKAGE, start
from kit.documents import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("rclpy") is None, reason="needs rclpy, of ROS 2"),
]
EXAMPLE = ROOT / "docs" / "examples" / "on_ros2.py"
WIDE = ("--set", "ROS2.speed=1.0", "--set", "ROS2.box=[-2.0,-2.0,-2.0,2.0,2.0,2.0]")
SIGNALS = ("time_s", "reference_", "feature_", "joint_")
_domains = itertools.count(os.getpid() % 50)


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Set a domain of ROS 2 in which no other test talks."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(next(_domains) % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


@contextmanager
def robot(*arguments):
    """Yield the process of the served robot."""
    process = start("serve", "--protocol", "ros2", "--task", "target", *arguments)
    try:
        while "conformance" not in (line := process.stdout.readline()):
            assert line, process.stderr.read()
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=20)


def node(out, *arguments, controller="ukf_mfac"):
    """Start the example."""
    return subprocess.Popen(
        [sys.executable, str(EXAMPLE), controller, "--out", str(out), *arguments], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(PACKAGE), "COLUMNS": "200"},
    )  # fmt: skip


def finished(process, timeout=90):
    """Return the exit code of a process once it has ended, and what it said."""
    said, errors = process.communicate(timeout=timeout)
    return process.returncode, said + errors


def numbers(steps):
    """Return the rows that a controller saw and commanded."""
    names = [name for name in steps if name.startswith(SIGNALS)]
    return steps[names].to_numpy(np.float64)


def reason(out):
    """Return why the run in a folder ended."""
    return servobench.load(out).runs.iloc[0]["reason"]


def test_in_simulated_time_rows_and_commands_are_those_of_a_run(tmp_path):
    with robot("--lockstep"):
        short = ("--set", "target.duration=2.0", "--set", "ROS2.simulated=true")
        code, said = finished(node(tmp_path / "served", *WIDE, *short))
    assert code == 0, said
    settings = {"target": {"duration": 2.0}, "kinematic": {"sensing": {"stamps": True}}}
    run = servobench.run("ukf_mfac", task="target", robot="ur5e", settings=settings)
    rows = numbers(servobench.load(tmp_path / "served").steps)
    assert rows.shape == (40, 20)
    assert np.abs(rows - numbers(run.steps)).max() < 1e-12


def test_a_dry_run_reads_everything_and_moves_nothing(tmp_path):
    with robot():
        patient = ("--set", "ROS2.patience=40.0", "--set", "target.duration=1.0")
        code, said = finished(node(tmp_path / "dry", "--dry-run", *patient))
    assert code == 0, said
    joints = servobench.load(tmp_path / "dry").steps.filter(like="joint_position")
    assert np.ptp(joints.to_numpy(), axis=0).max() == 0.0


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGSTOP])
def test_a_robot_that_dies_or_hangs_ends_the_run_with_a_reason(tmp_path, stop):
    with robot() as process:
        bag = tmp_path / "bag"
        run = node(tmp_path / "lost", "--set", f"ROS2.bag={bag}", "--set", "ROS2.patience=10.0")
        due = time.monotonic() + 30.0
        while not bag.exists():
            assert time.monotonic() < due
            time.sleep(0.05)
        time.sleep(6.0)  # until the two have found each other
        process.send_signal(stop)
        finished(run)
        process.send_signal(signal.SIGCONT)
    assert "late" in reason(tmp_path / "lost")  # its messages, or this busy machine


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGINT])
def test_a_node_that_is_ended_leaves_an_arm_that_stands(tmp_path, stop):
    with robot():
        run = node(tmp_path / "ended", "--set", "ROS2.patience=20.0")
        time.sleep(8.0)
        run.send_signal(stop)
        finished(run)
        still = node(
            tmp_path / "after",
            "--dry-run",
            "--set",
            "ROS2.patience=40.0",
            "--set",
            "target.duration=0.5",
        )
        code, said = finished(still)
    assert code == 0, said
    joints = servobench.load(tmp_path / "after").steps.filter(like="joint_position")
    assert np.ptp(joints.to_numpy(), axis=0).max() < 1e-6


def test_a_second_commander_ends_the_run(tmp_path):
    with robot("--lockstep"):
        first = node(
            tmp_path / "first", "--set", "ROS2.simulated=true", "--set", "target.duration=600"
        )
        time.sleep(6.0)
        second = node(tmp_path / "second", "--set", "ROS2.simulated=true")
        finished(first)
        finished(second)
    # The one that hears the other first ends; the clock goes on with both, so that it may also find itself late.
    why = reason(tmp_path / "first") + reason(tmp_path / "second")
    assert "another node commands the robot" in why or "late, lost or frozen" in why


FULL = """
import errno, itertools, runpy, sys
from rosbags.rosbag2 import Writer

write, count = Writer.write, itertools.count()

def fail(*arguments):
    if next(count) > 60:
        raise OSError(errno.ENOSPC, "No space left on device")
    write(*arguments)

Writer.write = fail
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_a_bag_without_space_ends_the_run(tmp_path):
    pytest.importorskip("rosbags.rosbag2")
    bag = ("--set", f"ROS2.bag={tmp_path / 'bag'}", "--set", "ROS2.simulated=true")
    with robot("--lockstep"):
        command = [sys.executable, "-c", FULL, str(EXAMPLE), "ukf_mfac", "--out", tmp_path / "full"]
        environment = {**os.environ, "PYTHONPATH": str(PACKAGE)}
        subprocess.run(
            [*command, *bag], env=environment, capture_output=True, timeout=90, check=False
        )
    assert "No space left on device" in reason(tmp_path / "full")


def test_a_bag_has_all_messages(tmp_path):
    rosbags = pytest.importorskip("rosbags.highlevel")
    bag = ("--set", f"ROS2.bag={tmp_path / 'bag'}", "--set", "ROS2.simulated=true")
    with robot("--lockstep"):
        code, said = finished(node(tmp_path / "out", *bag, "--set", "target.duration=2.0"))
    assert code == 0, said
    counts = {}
    with rosbags.AnyReader([tmp_path / "bag"]) as reader:
        for connection, _, packed in reader.messages():
            reader.deserialize(packed, connection.msgtype)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
    assert set(counts) == {"/joint_states", "/feature", "/forward_velocity_controller/commands"}
    assert min(counts.values()) >= 39


def test_the_bag_of_a_node_tells_the_delays_that_were_there(tmp_path):
    pytest.importorskip("rosbags.highlevel")
    times = {"sensing.latency": 0.08, "command_delay": 0.03, "lag": 0.07}
    given = [word for key, value in times.items() for word in ("--set", f"kinematic.{key}={value}")]
    bag, twin = tmp_path / "bag", tmp_path / "twin.toml"
    with robot("--lockstep", *given):
        run = node(
            tmp_path / "out", *WIDE, "--set", "ROS2.simulated=true", "--set", f"ROS2.bag={bag}",
            "--set", "target.duration=40", "--set", "Excite.swing=0.25", "--set", "Excite.reach=0.15",
            controller=str(ROOT / "docs" / "examples" / "excite.py"),
        )  # fmt: skip
        code, said = finished(run, timeout=300)
    assert code == 0, said
    process = start("identify", "--joints", str(bag), "--robot", "ur5e", "--out", str(twin))
    said, errors = process.communicate(timeout=300)
    assert process.returncode == 0, said + errors
    found = tomllib.loads(twin.read_text(encoding="utf-8"))
    assert found["camera"]["latency"] == pytest.approx(0.08, abs=0.004)
    assert found["mean"]["command_delay"] == pytest.approx(0.03, abs=1e-3)
    assert found["mean"]["lag"] == pytest.approx(0.07, abs=1e-3)
