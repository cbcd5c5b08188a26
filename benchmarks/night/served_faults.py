"""Faults between a client and a served plant: nothing beyond the limits is commanded, and the arm stops in two periods.

    PYTHONPATH=tests:benchmarks python -m night.served_faults --faults 500

The client is docs/examples/on_a_ur.py with `ur-rtde`; a relay between both cuts, halves, delays, doubles and changes
its packets. The server in this process notes every command that reaches the plant. Time is counted in its periods. On
a full machine the server leaves periods out, and then a delay of the wall clock is none in its periods: a finding in
such a trial is tried again, twice at most.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import random
import signal
import socket
import struct
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from kit.served import fresh_address, served, waited_for
from measuring import options
from night import served_client
from servobench.harness.apps.serve.server import PORTS

LIMIT = 0.25  # [rad/s] of on_a_ur.py
PERIOD = 25  # periods of the server in one of the controller
# Periods of the server that a stop takes, and its hand-over
RAMP = math.ceil(LIMIT / 10.0 / 0.002) + 3
PATIENCE = 25.0  # [s] until a client has ended
ATTEMPTS = 3  # at a trial, where the machine was too slow for the server
BY_CONTROLLER = (
    "NaN of the controller",
    "hanging controller",
    "late controller",
    "exception",
    "beyond limits",
)
BY_CAMERA = ("frozen camera", "camera without frames", "lost frames")
BY_RELAY = (
    "cut",
    "half a packet",
    "late packets",
    "doubled packets",
    "NaN on the wire",
    "wrong recipe",
    *BY_CAMERA,
)
BY_FORCE = ("protective stop", "killed server", "killed client", "Ctrl-C", "stopped client")
HARMLESS = ("doubled packets", "beyond limits")  # after which a run goes on


class Relay:
    """Passes bytes of all ports on, and does harm once it is told to."""

    def __init__(self, server: str, commands: list) -> None:
        self.server, self.address, self.fault, self.commands, self.onset = (
            server,
            fresh_address(),
            "",
            commands,
            0,
        )
        self._open, self._listening, self._frame = [], [], None
        for port in PORTS.values():
            listening = socket.create_server((self.address, port))
            self._listening.append(listening)
            threading.Thread(target=self._accept, args=(listening, port), daemon=True).start()

    def close(self) -> None:
        """Cut everything."""
        for each in (*self._listening, *self._open):
            with_shutdown(each)

    def _accept(self, listening, port):
        while True:
            try:
                client, _ = listening.accept()
                server = socket.create_connection((self.server, port))
            except OSError:
                return
            for each in (
                client,
                server,
            ):  # otherwise a small packet waits for the answer to the one before
                each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._open += [client, server]
            change = self._packets if port == PORTS["RTDE"] else self._whole
            back = self._frames if port == PORTS["features"] else self._whole
            for source, sink, how in ((client, server, change), (server, client, back)):
                threading.Thread(target=self._pass, args=(source, sink, how), daemon=True).start()

    def _pass(self, source, sink, change):
        rest = b""
        with suppress(OSError):
            while data := source.recv(65536):
                out, rest = change(rest + data)
                for each in out:
                    sink.sendall(each)
        with_shutdown(source)
        with_shutdown(sink)

    @staticmethod
    def _whole(data):
        return [data], b""

    def _packets(self, data):
        """Change the commands of the client."""
        out = []
        while len(data) >= 3 and len(data) >= (size := struct.unpack(">H", data[:2])[0]):
            packet, data = data[:size], data[size:]
            out += self._changed(packet) if packet[2:3] == b"U" and size > 60 else [packet]
        return out, data

    def _changed(self, packet):
        if self.fault in BY_RELAY and not self.onset:
            self.onset = len(self.commands)  # with the first packet that is not as it should be
        match self.fault:
            case "cut":
                raise OSError
            case "half a packet":
                self.fault = "cut"
                return [packet[: len(packet) // 2]]
            case "late packets":
                time.sleep(0.2)
            case "doubled packets":
                return [packet, packet]
            case "NaN on the wire":
                return [packet[:8] + struct.pack(">d", math.nan) + packet[16:]]
            case "wrong recipe":
                return [packet[:3] + b"\xc8" + packet[4:]]
        return [packet]

    def _frames(self, data):
        """Change the features of the server."""
        *lines, rest = data.split(b"\n")
        if self.fault in BY_CAMERA and lines and not self.onset:
            self.onset = len(self.commands)  # with the first frame that is not as it should be
        if self.fault == "camera without frames":
            return [], rest
        if self.fault == "lost frames":
            lines = [
                json.dumps(json.loads(line) | {"valid": [False] * 3}).encode() for line in lines
            ]
        if self.fault == "frozen camera":
            lines = [
                json.dumps(json.loads(line) | {"feature": self._frame}).encode() for line in lines
            ]
        elif lines:
            self._frame = json.loads(lines[-1])["feature"]
        return [line + b"\n" for line in lines], rest


def with_shutdown(each):
    """Close a socket at once, also while another thread waits for it."""
    with suppress(OSError):
        each.shutdown(socket.SHUT_RDWR)
    each.close()


@contextmanager
def recorded(server):
    """Yield the commands that reached the plant, a row a period, and the period of the last one of the client."""
    commands, last = [], [0]
    advance, write = server.rollout.advance, server.program.write

    def noted(command):
        commands.append(command.joint_velocity)
        advance(command)

    def heard(values):
        if values.get("input_int_register_0") == 9:
            last[0] = len(commands)
        return write(values)

    server.rollout.advance, server.program.write = noted, heard
    yield commands, last


def trial(fault, draw, context):
    """Return how a run with a fault went: its end, what was wrong, and whether the server left periods out."""
    wrong, settings = [], {"kinematic": {"sensing": {"frame_period": 0.05}}}
    with (
        served(settings=settings, lockstep=False) as (server, address, said),
        recorded(server) as (commands, last),
    ):
        relay = Relay(address, commands)
        with tempfile.NamedTemporaryFile("w", suffix=".txt") as place:
            at = draw.randrange(4, 25) if fault in BY_CONTROLLER else 10**9
            client = context.Process(
                target=served_client.run, args=(relay.address, fault, at, place.name)
            )
            client.start()
            if not waited_for(lambda: last[0] > 0 or not client.is_alive(), 60.0):
                wrong.append("the client never commands")
            time.sleep(draw.uniform(0.1, 1.2))
            begun = len(commands)
            if client.is_alive() and server.program.running:
                inject(fault, relay, server, client)
            client.join(PATIENCE)
            if client.is_alive():
                wrong.append("the client hangs")
                client.kill()
                client.join()
            end = Path(place.name).read_text(encoding="utf-8")
        relay.fault = "over"
        until = len(commands) + 4 * PERIOD
        waited_for(lambda: len(commands) > until, 10.0)
        relay.close()
    rows = np.abs(np.array(commands)).max(axis=1)
    early = fault not in BY_CONTROLLER and last[0] < begun - 2 * PERIOD
    if rows.max() > LIMIT + 1e-9:
        wrong.append(f"{rows.max():g} rad/s were commanded")
    begun = last[0] if fault in (*BY_CONTROLLER, *HARMLESS) or early else begun
    begun = begun if fault in HARMLESS else relay.onset or begun
    moved = np.flatnonzero(rows > 1e-9)
    after = int(moved[-1]) + 1 - begun if len(moved) else 0
    if after > 2 * PERIOD + RAMP:
        wrong.append(f"the arm moves for {after} periods of 2 ms")
    if end == "begun":
        end = f"exit code {client.exitcode}"
    slow = any("slower than the wall clock" in line for line in said)
    return end, early, after, wrong, slow


def inject(fault, relay, server, client):
    """Begin a fault that no controller brings."""
    match fault:
        case "protective stop":
            server.program.protect("by the campaign")
        case "killed server":
            relay.close()
        case "killed client":
            client.kill()
        case "stopped client":
            os.kill(client.pid, signal.SIGSTOP)
            threading.Timer(3.0, os.kill, (client.pid, signal.SIGCONT)).start()
        case "Ctrl-C":
            os.kill(client.pid, signal.SIGINT)
        case _:
            relay.fault = fault


def main() -> None:
    """Print a table by kind, and end with exit code 1 if something was wrong."""
    given = options(__doc__, faults=500, seed=0, kind=("", "this kind alone"))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["night.served_client"])
    kinds, draw = (*BY_CONTROLLER, *BY_RELAY, *BY_FORCE), random.Random(given.seed)
    kinds = (given.kind,) if given.kind else kinds
    ends, longest, early, faults = defaultdict(Counter), Counter(), Counter(), []
    repeated = 0
    for number in range(given.faults):
        kind = kinds[number % len(kinds)]
        for attempt in range(ATTEMPTS):
            end, was_early, after, wrong, slow = trial(kind, draw, context)
            if not (wrong and slow):
                break
            if attempt + 1 < ATTEMPTS:
                repeated += 1
                print(
                    f"{number} {kind}: {wrong}, but the machine was too slow: once more",
                    file=sys.stderr,
                    flush=True,
                )
        ends[kind][end[:70]] += 1
        early[kind] += was_early
        longest[kind] = max(longest[kind], after)
        faults += [f"{number} {kind}: {each}; {end[:100]}" for each in wrong]
        if wrong:
            print(faults[-1], file=sys.stderr, flush=True)
    for kind in kinds:
        words = "; ".join(f"{count}x {end}" for end, count in ends[kind].most_common(3))
        moved = f"moved at most {2 * longest[kind]} ms after"
        print(
            f"{kind:24s} {ends[kind].total():4d} runs, {early[kind]} over before, {moved}; {words}"
        )
    print(
        f"{given.faults} faults, {len(faults)} findings, {repeated} trials repeated on a machine too slow"
    )
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
