"""Random inputs on each port of a served plant: no crash, no traceback, and one line for each that makes no sense.

PYTHONPATH=tests:benchmarks python -m night.served_bytes --inputs 100000
"""

from __future__ import annotations

import logging
import math
import random
import socket
import struct
import sys
import time
from collections import Counter
from contextlib import suppress

from kit.served import SPEED, Bytes, packed, served
from measuring import options
from servobench.harness.apps.serve.server import PORTS

NAMES = (
    *SPEED,
    "actual_q",
    "timestamp",
    "input_int_register_24",
    "nonsense",
    "standard_digital_output",
    "",
    "é",
)
WORDS = (
    b"stop",
    b"running",
    b"unlock protective stop",
    b"play",
    b"quit",
    b"PolyscopeVersion",
    b"\xff\xfe",
    b"",
)
NUMBERS = (0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e-9, 0.3)

METHODS = (b"GET", b"POST", b"OPTIONS", b"CONNECT", b"PRI", b"post", b"S", b"!", b"def")


def browser(draw):
    """Return what a browser sends first, by HTTP, TLS or STUN, and behind it what a port carries out."""
    line = draw.choice(METHODS) + draw.choice(
        (b" / HTTP/1.1\r\n", b" http://x/ HTTP/1.1\r\n", b" * HTTP/2.0\r\n")
    )
    first = draw.choice(
        (
            line,
            line,
            b"\r\n" + line,
            b"\x16\x03\x01\x02\x00\x01",
            b"\x00\x03\x00\x1c\x21\x12\xa4\x42",
        )
    )
    packets = (
        first.ljust(int.from_bytes(first[:2]), b"x")
        + packed("I", ",".join(SPEED).encode())
        + packed("S")
    )
    return draw.choice(
        (packets, first + b"\nend\ndef rtde_control():\nend\n", first + b"\r\n\r\nstop\npictures\n")
    )


def wire(draw):
    """Return packets that are right, wrong in one place, or nothing of the kind."""
    match draw.randrange(8):
        case 0:
            return draw.randbytes(draw.randrange(1, 80))
        case 1:
            return packed(chr(draw.randrange(256)), draw.randbytes(draw.randrange(40)))
        case 2:
            names = ",".join(draw.choices(NAMES, k=draw.randrange(1, 6))).encode()
            return packed("O", struct.pack(">d", draw.choice((125.0, 500.0, *NUMBERS))) + names)
        case 3:
            return packed("I", ",".join(draw.choices(NAMES, k=draw.randrange(1, 6))).encode())
        case 4:
            whole = packed("I", ",".join(SPEED).encode()) + packed("S")
            return whole[: draw.randrange(1, len(whole))]
        case 5:
            return struct.pack(">HB", draw.randrange(65536), draw.randrange(256)) + draw.randbytes(
                20
            )
        case 6:
            version = packed("V", struct.pack(">H", draw.randrange(4)))
            return (
                version
                + packed("M", draw.randbytes(draw.randrange(8)))
                + packed("O", b"timestamp,actual_q")
            )
        case _:
            body = struct.pack(">i8d", draw.randrange(-3, 260), *draw.choices(NUMBERS, k=8))
            number = draw.choice((b"\x01", b"\x01", b"\x01", b"\x02", b"\x00"))
            return packed("I", ",".join(SPEED).encode()) + packed(
                "U", number + body[: draw.choice((68, 68, 40))]
            )


def inputs(port, draw):
    """Return an input for a port."""
    if draw.randrange(10) == 0:
        return browser(draw)
    if port == "RTDE":
        return wire(draw)
    if port == "dashboard":
        line = draw.choice(WORDS) if draw.random() < 0.5 else draw.randbytes(draw.randrange(60))
        return line + draw.choice((b"\n", b"\n", b"")) + b"x" * draw.choice((0, 0, 0, 0, 5000))
    if port == "script":
        text = draw.choice(
            (b"", b"def rtde_control():\n", b"Script Loaded (\xff)", b"Script Loaded (1.1.30)")
        )
        return (
            text
            + draw.randbytes(draw.randrange(60))
            + draw.choice((b"\nend\n", b"\nend\n\nend\n", b""))
        )
    return draw.choice(
        (
            b"pictures\n",
            b"",
            draw.randbytes(draw.randrange(60)),
            draw.randbytes(20) + b"\n",
            b"x" * 5000,
        )
    )


def knock(address, port, data, number):
    """Send an input from an address of its own, hang up, and wait until the server has."""
    with socket.socket() as line:
        line.settimeout(10.0)
        line.bind((f"127.200.{number // 250 % 250}.{1 + number % 250}", 0))
        line.connect((address, PORTS[port]))
        with suppress(ConnectionError):
            line.sendall(data)
            line.shutdown(socket.SHUT_WR)
            while line.recv(65536):
                pass


def main() -> None:
    """Print a table by port, and end with exit code 1 if something was wrong."""
    given = options(__doc__, inputs=100_000, seed=0)
    found, logged = [], []
    handler = logging.Handler()
    handler.emit = lambda record: logged.append(
        f"{record.getMessage()} {record.exc_info and record.exc_info[1]!r}"
    )
    logging.getLogger("asyncio").addHandler(handler)
    for port in PORTS:
        draw, most, before, kinds = random.Random(given.seed), 0, time.monotonic(), Counter()
        with served() as (server, address, lines):
            for number in range(given.inputs):
                if number % 16 == 0:
                    server.program.stopped_at = None
                    server.program.begin()
                data, said = inputs(port, draw), len(lines)
                knock(address, port, data, number)
                kinds.update(line.partition(",")[0][:40] for line in lines[said:])
                if (count := len(lines) - said) > 2 + data.count(b"end") + data.count(b"\n"):
                    found.append(f"{port} {number}: {count} lines for {data!r}")
                if number % 1000 == 0:
                    del lines[2:]
                most = max(most, count)
            client = Bytes(address)
            if client.start() != b"\x01":
                found.append(f"{port}: the server does not answer any more")
            client.close()
        seconds = time.monotonic() - before
        print(
            f"{port:10s} {given.inputs} inputs, {sum(kinds.values())} lines, at most {most} each, {seconds:.0f} s",
            flush=True,
        )
    found += [f"asyncio: {each}" for each in logged]
    print(*found[:20], f"{len(found)} findings", sep="\n")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
