"""The client `ur-rtde` itself moves a served plant, by docs/examples/on_a_ur.py and by calls of its own."""

import os
import re
import runpy
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from threading import Thread

import numpy as np
import pytest

import servobench
from kit.command import PACKAGE, start
from kit.documents import ROOT
from kit.served import connected, fresh_address, served, waited_for
from servobench.harness.apps.serve.server import PORTS
from servobench.plant.robot.camera import CAMERA

pytestmark = pytest.mark.skipif(
    find_spec("rtde_control") is None, reason="ur-rtde has no wheel for this Python"
)
EXAMPLE = ROOT / "docs" / "examples" / "on_a_ur.py"
WIDE = (
    "--set",
    "UR.speed=1.0",
    "--set",
    "UR.box=[-2.0,-2.0,-2.0,2.0,2.0,2.0]",
    "--set",
    "UR.patience=60.0",
)
SIGNALS = ("time_s", "reference_", "feature_", "joint_")


def wait_for(process, words):
    """Wait for a line with these words, and for a second in which more happens."""
    while words not in (line := process.stdout.readline()):
        assert line, process.stderr.read()
    time.sleep(1.0)


@contextmanager
def double(*arguments):
    """Yield the process of `servobench serve` and its address."""
    address = fresh_address()
    process = start("serve", "--task", "target", "--address", address, *arguments)
    try:
        wait_for(process, "conformance")
        yield process, address
    finally:
        if not process.stdout.closed:
            process.terminate()
            process.communicate(timeout=20)


def python(*arguments):
    """Start Python with arguments, such that the client's lock is not that of the tests."""
    return subprocess.Popen(
        [sys.executable, *arguments], text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(PACKAGE), "COLUMNS": "200"},
    )  # fmt: skip


def on_a_ur(address, out, *arguments):
    """Start the example against an address."""
    return python(
        str(EXAMPLE), "ukf_mfac", "--out", str(out), "--set", f'UR.host="{address}"', *arguments
    )


def finished(process):
    """Return the exit code of a process once it has ended, and what it said."""
    said, errors = process.communicate(timeout=90)
    return process.returncode, said + errors


def numbers(steps):
    """Return the rows that a controller saw and commanded."""
    names = [name for name in steps if name.startswith(SIGNALS)]
    return steps[names].to_numpy(np.float64)


@pytest.mark.slow
def test_in_lockstep_rows_and_commands_are_those_of_a_run(tmp_path):
    settings = {"target": {"duration": 2.0}}
    with served(settings=settings) as (_, address, _):
        code, said = finished(
            on_a_ur(address, tmp_path / "served", *WIDE, "--set", "target.duration=2.0")
        )
    assert code == 0, said
    run = servobench.run("ukf_mfac", task="target", robot="ur5e", settings=settings)
    rows = numbers(servobench.load(tmp_path / "served").steps)
    assert rows.shape == (40, 20)
    assert np.array_equal(rows, numbers(run.steps))


def hang_up(end):
    """Close a socket, such that a thread that waits at it goes on."""
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()


@contextmanager
def forwarded(address, delay):
    """Yield an address that stands for another one; what its first client of RTDE hears comes later by a delay [s]."""
    own = fresh_address()
    first_of_rtde = [delay]

    def pump(source, sink, delay):
        with suppress(OSError):
            while data := source.recv(1 << 16):
                time.sleep(delay)
                sink.sendall(data)
        hang_up(sink)

    def accept(listener, port):
        with suppress(OSError):
            while True:
                near, _ = listener.accept()
                far = connected(address, port)
                far.settimeout(None)
                stack.callback(hang_up, near)
                stack.callback(hang_up, far)
                late = 0.0
                if port == "RTDE" and first_of_rtde:
                    late = first_of_rtde.pop()
                Thread(target=pump, args=(near, far, 0.0), daemon=True).start()
                Thread(target=pump, args=(far, near, late), daemon=True).start()

    with ExitStack() as stack:
        for port, number in PORTS.items():
            listener = socket.create_server((own, number))
            stack.callback(hang_up, listener)
            Thread(target=accept, args=(listener, port), daemon=True).start()
        yield own


@pytest.mark.slow
def test_a_run_begins_where_its_second_connection_is_the_later_one(tmp_path):
    """The control program runs by one connection, and by the other one not yet."""
    short = ("--set", "target.duration=1.0")
    with (
        served(settings={"target": {"duration": 1.0}}) as (_, address, _),
        forwarded(address, 0.1) as late,
    ):
        code, said = finished(on_a_ur(late, tmp_path / "late", *WIDE, *short))
    assert code == 0, said


@pytest.mark.slow
def test_a_dry_run_reads_everything_and_moves_nothing(tmp_path):
    with served(lockstep=False) as (_, address, _):
        patient = ("--set", "UR.patience=20.0", "--set", "target.duration=1.0")
        code, said = finished(on_a_ur(address, tmp_path / "dry", "--dry-run", *patient))
    assert code == 0, said
    joints = servobench.load(tmp_path / "dry").steps.filter(like="joint_position")
    assert np.ptp(joints.to_numpy(), axis=0).max() == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGSTOP])
def test_a_server_that_dies_or_hangs_ends_the_run_with_a_reason(tmp_path, stop):
    long = ("--set", "target.duration=60.0")
    with double(*long) as (process, address):
        run = on_a_ur(address, tmp_path / "lost", "--set", "UR.patience=6.0", *long)
        wait_for(process, "control program of")
        process.send_signal(stop)
        began = time.monotonic()
        code, said = finished(run)
        assert time.monotonic() - began < 12.0
        process.send_signal(signal.SIGCONT)
        process.kill()
    if code < 0 or "Timeout (" in said:
        pytest.skip("ur-rtde itself crashed or hung while it connected anew")
    row = servobench.load(tmp_path / "lost").runs.iloc[0]
    assert row["status"] == "crashed"
    assert re.search(
        "timed out|cannot be heard any more|has ended|takes no command|JSON", row["reason"]
    ), row["reason"]


def said(words, lines):
    """Return whether a line has these words; on a busy machine the server says in further ones that it is late."""
    return any(words in line for line in lines)


@pytest.mark.slow
def test_a_client_that_is_killed_leaves_an_arm_that_stands(tmp_path):
    with served(settings={"target": {"duration": 60.0}}, lockstep=False) as (_, address, lines):
        assert "serving in real time, in steps of 2 ms, at" in lines[0]
        run = on_a_ur(
            address,
            tmp_path / "killed",
            "--set",
            "UR.patience=6.0",
            "--set",
            "target.duration=60.0",
        )
        assert waited_for(lambda: said("control program of", lines), 60.0)
        time.sleep(1.0)
        run.kill()
        run.communicate()
        assert waited_for(lambda: said("control program ended by its watchdog", lines)), lines


CALLS = """
import sys, time, rtde_control, rtde_receive
host = sys.argv[1]
control, receive = rtde_control.RTDEControlInterface(host), rtde_receive.RTDEReceiveInterface(host)
q = receive.getActualQ()
target = [q[0] + 0.2, *q[1:]]
moved = control.moveJ(target, 0.8, 1.4), time.sleep(0.2)
print(moved[0], max(abs(a - b) for a, b in zip(target, receive.getActualQ())) < 5e-3)
print(control.speedJ([0.1] * 6, 1.0, 0.05), control.speedStop())
print(control.servoJ(q, 0, 0, 0.05, 0.1, 300), control.servoStop())
try:
    rtde_control.RTDEControlInterface(host)
except RuntimeError as error:
    print(error)
print(control.moveL(receive.getActualTCPPose(), 0.1, 0.1), control.isProgramRunning())
print(control.reuploadScript(), time.sleep(0.2), control.isProgramRunning())
control.stopScript()
print(control.isProgramRunning())
"""


@pytest.mark.slow
def test_calls_of_the_client_do_what_they_say_or_are_refused_by_name():
    with double("--lockstep") as (process, address):
        client = python("-c", CALLS, address)
        said, errors = client.communicate(timeout=60)
        assert client.returncode == 0, errors
        process.terminate()
        served, _ = process.communicate(timeout=20)
    lines = said.splitlines()
    assert lines[:3] == ["True True"] * 3
    assert lines[3].startswith("One of the RTDE input registers are already in use!")
    assert lines[-3:] == ["False False", "True None True", "False"]
    assert "control program ended at moveL (command 3), which is not served" in served
    assert "a second client is refused: another one writes input_int_register_0" in served


def test_a_colour_ball_is_found_where_it_is_and_missed_where_it_is_not():
    ball, radius, h, w = np.array([0.05, -0.03, 0.8]), 0.03, CAMERA.height, CAMERA.width
    rays = CAMERA.rays(*(each.ravel() for each in np.meshgrid(np.arange(w), np.arange(h))))
    along = rays @ ball / (rays**2).sum(axis=1)
    miss = ((along[:, None] * rays - ball) ** 2).sum(axis=1)
    hit = miss < radius**2
    depth = np.where(
        hit, along - np.sqrt(np.maximum(radius**2 - miss, 0.0) / (rays**2).sum(axis=1)), 1.5
    ).reshape(h, w)
    image = np.where(hit.reshape(h, w, 1), np.uint8([200, 20, 20]), np.uint8([90, 90, 90]))
    detector = runpy.run_path(str(EXAMPLE))["ColourBall"]
    feature, valid, *stamps = detector(lambda: (image, depth, 7.0), CAMERA, radius).read()
    assert (valid, stamps) == (True, [7.0, 7.0])
    assert np.abs(feature - ball).max() < 1e-3
    feature, valid, *_ = detector(lambda: (np.zeros_like(image), depth, 7.1), CAMERA, radius).read()
    assert not valid
