"""A served plant in a thread of this process, and a client of RTDE that speaks bytes."""

import asyncio
import itertools
import os
import socket
import struct
import threading
import time
from contextlib import contextmanager

from servobench.harness.apps.serve.server import PORTS, Server
from servobench.harness.config.settings import Settings
from servobench.harness.run.loop import careful
from servobench.harness.run.request import RunRequest
from servobench.plant.robot.mismatch import Mismatch

REQUEST = RunRequest("kinematic", "constant", "target", Mismatch.parse("moderate"), 0, robot="ur5e")
# of speedJ, speedStop and moveJ, as ur-rtde has them
SPEED = ("input_int_register_0", *(f"input_double_register_{k}" for k in range(8)))
_numbers = itertools.count()


def fresh_address():
    """Return an address on which no other test of this machine listens."""
    number = os.getpid() * 64 + next(_numbers)
    return f"127.{1 + number // 62_500 % 200}.{1 + number // 250 % 250}.{1 + number % 250}"


def waited_for(condition, seconds=20.0):
    """Return whether a condition comes true within a time."""
    due = time.monotonic() + seconds
    while not condition() and time.monotonic() < due:
        time.sleep(0.001)
    return condition()


@contextmanager
def served(request=REQUEST, settings=None, *, lockstep=True):
    """Yield a server that runs, its address and the lines that it says."""
    lines, address = [], fresh_address()
    with careful():
        server = Server(request, Settings(settings or {}), lines.append, lockstep=lockstep)
    loop, failed = asyncio.new_event_loop(), []

    def run():
        try:
            with careful():
                loop.run_until_complete(task)
        except asyncio.CancelledError:
            pass
        except Exception as error:  # noqa: BLE001
            failed.append(error)
        finally:
            for each in asyncio.all_tasks(loop):
                each.cancel()
            loop.run_until_complete(asyncio.sleep(0))
            loop.run_until_complete(loop.shutdown_asyncgens())
            loop.close()

    task = loop.create_task(server.serve(address))
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        assert waited_for(lambda: len(lines) >= 2), failed
        yield server, address, lines
        assert not failed, failed
    finally:
        if thread.is_alive():
            loop.call_soon_threadsafe(task.cancel)
        thread.join(10.0)
        server.rollout.plant.close()


def connected(address, port):
    """Return a socket to a port by its name."""
    return socket.create_connection((address, PORTS[port]), timeout=20.0)


def packed(kind, body=b""):
    """Return a packet."""
    return struct.pack(">HB", 3 + len(body), ord(kind)) + body


class Bytes:
    """A client of RTDE: what it sends is what a test says."""

    def __init__(
        self,
        address,
        outputs="timestamp,output_int_register_0,robot_status_bits,safety_status_bits",
    ):
        self.socket = connected(address, "RTDE")
        self.stream = self.socket.makefile("rb")
        self.names = outputs.split(",")
        assert self.asked("V", b"\x00\x02") == b"\x01"
        self.types = (
            self.asked("O", struct.pack(">d", 500.0) + outputs.encode())[1:].decode().split(",")
        )

    def asked(self, kind, body=b""):
        """Return the answer to a packet; data that come before it are left out."""
        self.socket.sendall(packed(kind, body))
        while (got := self.packet())[0] != kind:
            pass
        return got[1]

    def packet(self):
        """Return kind and body of the next packet; nothing at the end."""
        head = self.stream.read(3)
        if len(head) < 3:
            return "", b""
        size, kind = struct.unpack(">HB", head)
        return chr(kind), self.stream.read(size - 3)

    def set_up(self, *names):
        """Return number and types of a recipe of inputs."""
        answer = self.asked("I", ",".join(names).encode())
        return answer[0], answer[1:].decode().split(",")

    def start(self):
        """Begin the stream of data."""
        return self.asked("S")

    def send(self, number, layout, *values):
        """Send values by a recipe."""
        self.socket.sendall(packed("U", bytes([number]) + struct.pack(">" + layout, *values)))

    def command(self, number, *values):
        """Send a command by the first recipe, which is that of `SPEED`."""
        self.send(1, "i8d", number, *values, *[0.0] * (8 - len(values)))

    def close(self):
        """Hang up."""
        self.stream.close()
        self.socket.close()


@contextmanager
def commanding(server, address):
    """Yield a client whose control program runs."""
    client = Bytes(address)
    client.set_up(*SPEED)
    client.start()
    server.program.begin()
    try:
        yield client
    finally:
        client.close()
