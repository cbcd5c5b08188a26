"""A plant behind the sockets of a UR's controller: RTDE, dashboard, scripts, and features on a port of their own.

In lockstep the clock waits for the command of each period, so that a run is the same on every machine. Nothing here
keeps an arm safe: it stands in for a robot that has its own limits.
"""

import asyncio
import base64
import errno
import ipaddress
import json
import math
import os
import struct
from asyncio import StreamReader, StreamWriter
from collections.abc import Awaitable, Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias, final

import cv2

from servobench.harness.apps.serve import wire
from servobench.harness.apps.serve.program import (
    COMMAND,
    ControlProgram,
    begins_script,
    script_version,
)
from servobench.harness.apps.serve.served import RATE, Served
from servobench.harness.config.settings import Settings
from servobench.harness.run.request import RunRequest
from servobench.plant.bench.plant import TrueModel
from servobench.plant.contract.faults import ConfigurationError, RunFault
from servobench.plant.contract.files import Record, reason
from servobench.plant.robot.catalogue import find_robot

Handler: TypeAlias = Callable[[StreamReader, StreamWriter], Awaitable[None]]
# All but the last are UR's
PORTS = {"RTDE": 30004, "dashboard": 29999, "script": 30003, "features": 30020}
HEARTBEAT = 0.004  # [s] between two packets while lockstep waits
SEND_BUFFER = 1 << 17  # bytes that wait for a slow reader, from which packets are left out
PACKETS_A_PERIOD = 50  # packets of a client in a period; the others wait
SCRIPT_SIZE = 1 << 20  # bytes of a script at most
SCRIPT_END = b"\nend\n"
CONNECTIONS = 32  # to a port at once
LEGACY_FREQUENCY = 125.0  # [Hz], at which version 1 of RTDE sends outputs


@dataclass(eq=False)
class Client:
    """A connection to the RTDE port."""

    writer: StreamWriter
    version: int = 0  # the protocol's, once the client has shown it
    number: bytes = b""  # that begins data: the recipe's, which version 1 leaves out
    outputs: wire.Recipe | None = None
    every: int = 1  # periods of the controller between two packets
    started: bool = False
    packets: int = 0  # that came since the last period
    inputs: list[wire.Recipe] = field(default_factory=list)


@final
class Server:
    """The sockets around the plant of a run.

    Attributes:
        rollout: the plant's side of the run.
        program: the control program.
        state: the outputs of the controller, by name.
    """

    def __init__(
        self,
        request: RunRequest,
        settings: Settings,
        say: wire.Say,
        *,
        lockstep: bool = False,
    ) -> None:
        """Begin a run. In real time its plant advances at the rate of a UR, and frames come once a control period.

        The controller of the request is not asked; `say` prints a line; in lockstep the clock waits for commands.

        Raises:
            ConfigurationError: a name or setting that cannot be used, or an arm without six joints.
            RunFault: the run cannot begin.
        """
        self._arm = find_robot(request.robot).arm
        if self._arm.n != 6:
            raise ConfigurationError(
                f"--robot must be one with 6 joints, as every UR has, got {self._arm.n}"
            )
        self._served = Served(request, settings, say, lockstep=lockstep)
        self._plant = self._served.plant
        self._spec = self._plant.spec
        self.rollout = self._served.rollout
        self._say = say
        self._lockstep = lockstep
        # For its lag and its command delay
        drive = self._plant.with_delays(TrueModel(lambda q: q, lambda q: q))
        self.program = ControlProgram(self._spec, drive, say, lockstep=lockstep)
        self._clients: set[Client] = set()
        self._watchers: dict[StreamWriter, bool] = {}  # of features, and whether they want pictures
        self._open: dict[str, set[StreamWriter]] = {port: set() for port in PORTS}
        # Ports of connections that said nothing whole yet, oldest first.
        self._silent: dict[StreamWriter, str] = {}
        self._crowded: set[str] = set()  # ports at which a connection had to give way
        self._fault: str | None = None
        self._sent = 0
        self._turn = asyncio.Event()
        self.state: Record = {
            **wire.CONTROLLER["constant"],
            "actual_digital_output_bits": 0,
        }
        self._measure()

    async def serve(self, address: str) -> None:
        """Listen at an address and keep the clock until cancelled.

        Raises:
            ConfigurationError: a port that cannot be opened.
        """
        with ExitStack() as stack:
            handlers: tuple[Handler, ...] = (
                self._rtde,
                self._dashboard,
                self._script,
                self._features,
            )
            for handler, (name, port) in zip(handlers, PORTS.items(), strict=True):
                guarded = partial(self._guard, name, handler)
                try:
                    server = await asyncio.start_server(guarded, address, port, limit=wire.MAX_LINE)
                except OSError as error:
                    remedy = "serve at another address of this machine, such as --address 127.0.0.2"
                    if error.errno == errno.EADDRINUSE:
                        remedy = f"end what uses it, or {remedy}"
                    # of the address
                    why = reason(error) if (error.errno or 0) < 0 else os.strerror(error.errno or 0)
                    failed = f"{name} port {port} of {address} cannot be opened: {why}"
                    raise ConfigurationError(f"{failed}; {remedy}") from error
                stack.callback(server.close)
            if not ipaddress.ip_address(address).is_loopback:
                self._say(
                    f"warning: whoever reaches {address} can move this plant; there is no password"
                )
            ports = ", ".join(f"{name} {port}" for name, port in PORTS.items())
            clocked = (
                "lockstep"
                if self._lockstep
                else f"real time, in steps of {1e3 * self._spec.period:g} ms,"
            )
            self._say(f"serving in {clocked} at {address}: {ports}")
            self._say("conformance with ur-rtde 1.6.5 is checked, safety is not; Ctrl-C ends it")
            clock = asyncio.get_running_loop().time
            due = clock()
            while True:
                if self._lockstep:
                    await asyncio.sleep(0.0 if self.program.busy else HEARTBEAT)
                else:
                    due = self._served.next_period(due, clock())
                    await asyncio.sleep(max(0.0, due - clock()))
                    self.program.cycle()
                if self.program.busy or not self._lockstep:
                    self._advance()
                self._publish()

    async def _guard(
        self, port: str, handler: Handler, reader: StreamReader, writer: StreamWriter
    ) -> None:
        """Close a connection with a line where its bytes make no sense, and without one where its other end is gone."""
        if not self._has_room(port):
            writer.transport.abort()
            return
        self._open[port].add(writer)
        self._silent[writer] = port
        try:
            await handler(reader, writer)
        except (OSError, asyncio.CancelledError):  # as at the end of the server
            pass
        except wire.WireError as error:
            if writer in self._open[port]:
                self._say(f"{port}: {error}; the connection is closed")
        finally:
            self._watchers.pop(writer, None)
            self._silent.pop(writer, None)
            self._open[port].discard(writer)
            if (
                writer.transport.get_write_buffer_size()
            ):  # a client that never reads would keep it open
                writer.transport.abort()
            writer.close()

    def _has_room(self, port: str) -> bool:
        """Return whether a port takes one more connection; one that has never said anything gives way to it."""
        if len(self._open[port]) < CONNECTIONS:
            return True
        if port not in self._crowded:
            self._crowded.add(port)
            self._say(
                f"{port}: {CONNECTIONS} connections are open; silent ones give way, others are refused"
            )
        for writer, name in self._silent.items():
            if name == port:
                del self._silent[writer]
                self._open[port].discard(writer)
                writer.transport.abort()
                return True
        return False

    def _advance(self) -> None:
        """Hold the command of the program for a period."""
        velocity = self.program.advance()
        if self._fault is None:
            try:
                has_frame = self._served.advance(velocity)
            except (RunFault, FloatingPointError) as error:
                self._fault = str(error)
                self.program.protect(self._fault)
            else:
                self._measure()
                if has_frame:
                    self._tell(self._watchers)

    def _measure(self) -> None:
        """Take the joints into program and state."""
        before = self.program.joints
        now = self.rollout.observation
        joints = now.joint_position
        self.program.joints = joints
        flange = self._arm.frames(joints)[-1]
        turn, _ = cv2.Rodrigues(flange[:3, :3])
        pose = (*flange[:3, 3], *turn.ravel())
        velocity = (joints - before) / self._spec.period
        moving = velocity if now.time > 0.0 else wire.ZEROS["VECTOR6D"]
        self.state |= {
            "timestamp": now.time, "actual_q": joints, "target_q": joints, "actual_qd": moving,
            "target_qd": self.program.velocity, "actual_TCP_pose": pose, "target_TCP_pose": pose,
        }  # fmt: skip

    def _publish(self) -> None:
        """Send the state to every client whose turn it is."""
        running = self.program.running
        stopped = self.program.stopped_at is not None
        self.state |= {
            "output_int_register_0": self.program.progress, "runtime_state": 2 if running else 1,
            "robot_status_bits": 3 if running else 1, "safety_status_bits": 4 if stopped else 1,
            "safety_mode": 3 if stopped else 1,
        }  # fmt: skip
        self._turn.set()
        self._sent += 1
        self._turn = asyncio.Event()
        for each in self._clients:
            each.packets = 0
            due = each.started and (self._lockstep or self._sent % each.every == 0)
            if due and each.outputs is not None and _ready(each.writer):
                each.writer.write(wire.packet("U", each.number + each.outputs.pack(self.state)))

    async def _rtde(self, reader: StreamReader, writer: StreamWriter) -> None:
        own = Client(writer)
        self._clients.add(own)
        try:
            while (got := await wire.read_packet(reader)) is not None:
                self._silent.pop(writer, None)
                self._answer(own, *got)
                if got[0] != "U":
                    await writer.drain()
                own.packets += 1
                if own.packets > PACKETS_A_PERIOD and not self._lockstep:
                    await self._turn.wait()
        finally:
            self._clients.discard(own)

    def _answer(self, own: Client, kind: str, body: bytes) -> None:
        """Take a packet of a client, or raise a `WireError` where its body makes no sense."""
        if kind == "U":
            self._receive(own, body)
        elif kind == "M":
            message = wire.read_message(body, own.version)
            self._say(f"message of a client: {message!r}")
        else:
            answer = self._answer_of(own, kind, body)
            own.writer.write(wire.packet(kind, answer))
            own.started = kind == "S" or (own.started and kind != "P")

    def _answer_of(self, own: Client, kind: str, body: bytes) -> bytes:
        """Return the body of the answer to a packet of a client."""
        match kind:
            case "V":
                return self._negotiate(own, int.from_bytes(body))
            case "v":
                return struct.pack(">4I", *wire.CONTROLLER["version"])
            case "O":
                return self._subscribe(own, body)
            case "I":
                return self._admit(own, body)
            case "S":
                return bytes([own.outputs is not None])
        return b"\x01"  # to "P"

    def _negotiate(self, own: Client, version: int) -> bytes:
        """Take the version of the protocol that a client wants."""
        accepted = version in (1, 2)
        if accepted:
            own.version = version
        else:
            self._say(f"version {version} of RTDE is refused; served are 1 and 2")
        return bytes([accepted])

    def _subscribe(self, own: Client, body: bytes) -> bytes:
        """Take the recipe of the outputs that a client wants."""
        if (
            own.version == 0 and body[:1].isalpha()
        ):  # as no frequency begins: version 1, with which a UR begins
            own.version = 1
        frequency = LEGACY_FREQUENCY
        names = body
        own.number = b""
        if own.version != 1:
            frequency = struct.unpack(">d", body[:8])[0] if len(body) >= 8 else 0.0
            names = body[8:]
            own.number = b"\x01"
        if not 1.0 <= frequency <= RATE:
            raise wire.WireError(f"outputs need a frequency of 1 to {RATE:g} Hz, got {frequency:g}")
        recipe = self._recipe(names, wire.OUTPUTS)
        own.outputs = None if wire.NOT_FOUND in recipe.types else recipe
        own.every = max(1, round(1.0 / (frequency * self._spec.period)))
        return own.number + ",".join(recipe.types).encode()

    def _admit(self, own: Client, body: bytes) -> bytes:
        """Take a recipe of inputs of a client, if no other client writes one of them."""
        recipe = self._recipe(body, wire.INPUTS)
        taken = {
            name
            for each in self._clients - {own}
            for inputs in each.inputs
            for name in inputs.names
        }
        if (
            COMMAND in taken
        ):  # a program can be commanded by the lower or the upper range of registers
            taken.add("input_int_register_24")
        types = [
            "IN_USE" if name in taken else recipe.types[k] for k, name in enumerate(recipe.names)
        ]
        if "IN_USE" in types:
            self._say(
                f"a second client is refused: another one writes {recipe.names[types.index('IN_USE')]}"
            )
        elif wire.NOT_FOUND not in types and len(own.inputs) < 255:
            own.inputs.append(recipe)
            return bytes([len(own.inputs)]) + ",".join(types).encode()
        return b"\x00" + ",".join(types).encode()

    def _recipe(self, body: bytes, known: dict[str, str]) -> wire.Recipe:
        recipe = wire.Recipe.of(body, known)
        if recipe.names == ("",):
            self._say("a recipe without variables sets up nothing")
        elif wire.NOT_FOUND in recipe.types:
            name = recipe.names[recipe.types.index(wire.NOT_FOUND)][:40]
            self._say(
                f"{recipe.types.count(wire.NOT_FOUND)} variables are not served, the first is {name!r}"
            )
        return recipe

    def _receive(self, own: Client, body: bytes) -> None:
        """Take the inputs of a client, and in lockstep carry their command out."""
        number = body[0] if body else 0
        if not 0 < number <= len(own.inputs):
            raise wire.WireError(f"data are of recipe {number}, which this client has not set up")
        values = own.inputs[number - 1].unpack(body[1:])
        self._switch(values)
        if self.program.write(values) and self._lockstep:
            if self.program.cycle():
                self._advance()
            self._publish()

    def _switch(self, values: Record) -> None:
        """Set outputs of the control box and the tool."""
        for name, shift in (("standard", 0), ("configurable", 8), ("tool", 16)):
            mask = values.get(f"{name}_digital_output_mask", 0) << shift
            bits = values.get(f"{name}_digital_output", 0) << shift
            before = self.state["actual_digital_output_bits"]
            self.state["actual_digital_output_bits"] = before & ~mask | bits & mask
        for k in (0, 1):
            if values.get("standard_analog_output_mask", 0) >> k & 1:
                share = values.get(f"standard_analog_output_{k}", 0.0)
                volts = values.get("standard_analog_output_type", 0) >> k & 1
                self.state[f"standard_analog_output{k}"] = (
                    10.0 * share if volts else 0.004 + 0.016 * share
                )
        if values.get("speed_slider_mask", 0):
            self._say("setSpeedSlider is not served; speeds stay as commanded")

    async def _script(self, reader: StreamReader, writer: StreamWriter) -> None:
        script = b""
        while data := await reader.read(wire.MAX_LINE):
            *whole, script = (script + data).split(SCRIPT_END)
            for each in whole:
                self._silent.pop(writer, None)
                self._load(each + SCRIPT_END)
            if not begins_script(script):
                raise wire.WireError(f"{script[:20]!r} does not begin a script")
            if len(script) > SCRIPT_SIZE:
                raise wire.WireError(f"a script must be at most {SCRIPT_SIZE} bytes")
        if script:
            raise wire.WireError(
                f"{len(script)} bytes that are no control script are not carried out"
            )

    def _load(self, script: bytes) -> None:
        """Begin the control program of a script, or raise a `WireError` for bytes that are none."""
        if not begins_script(script):
            raise wire.WireError(f"{script[:20]!r} does not begin a script")
        version, known = script_version(script)
        if not known:
            self._say(f"a script is not carried out: {version}; served is that of ur-rtde 1.6.5")
        elif self.program.stopped_at is not None:
            self._say("the control program does not start: the robot is in a protective stop")
        else:
            self._say(f"control program of {version}")
            self.program.begin()

    async def _dashboard(self, reader: StreamReader, writer: StreamWriter) -> None:
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        async for words in wire.read_lines(reader):
            if writer.is_closing():
                break
            self._silent.pop(writer, None)
            writer.write(self._reply(words).encode() + b"\n")
            await writer.drain()
            if words == "quit":
                break

    def _reply(self, words: str) -> str:
        """Return the answer to a command of the dashboard, in its own words."""
        program, stopped = self.program, self.program.stopped_at is not None
        replies = wire.CONTROLLER["dashboard"] | {
            "running": f"Program running: {str(program.running).lower()}",
            "safetystatus": f"Safetystatus: {'PROTECTIVE_STOP' if stopped else 'NORMAL'}",
            "programState": f"{'PLAYING' if program.running else 'STOPPED'} rtde_control",
        }
        if words == "stop":
            program.stop("by the dashboard")
        if words == "unlock protective stop":
            if self._fault is None and program.unlock():
                return "Protective stop releasing"
            return f"Cannot unlock protective stop {self._fault or 'until 5s after occurrence'}"
        if words not in replies:
            self._say(f"the dashboard command {words[:40]!r} is not served")
        return str(replies.get(words, f"could not understand: '{words[:40]}'"))

    async def _features(self, reader: StreamReader, writer: StreamWriter) -> None:
        self._watchers[writer] = False
        del self._silent[writer]  # since it need not say anything
        if self._lockstep:
            self._tell([writer])
        async for words in wire.read_lines(reader):
            if words != "pictures":
                raise wire.WireError(f"wanted is the word pictures, got {words[:20]!r}")
            self._watchers[writer] = True

    def _tell(self, writers: Iterable[StreamWriter]) -> None:
        """Send the present features, and where they are wanted a picture."""
        seen, channel = self.rollout.observation, self._spec.feature
        frame = {"time": seen.time, "names": channel.names, "unit": channel.unit}
        frame |= {"feature": seen.feature.tolist(), "valid": seen.valid.tolist()}
        captured = float(seen.capture_time)
        if math.isfinite(captured):
            frame["capture_time"] = captured
        lines = {False: frame, True: frame}
        if any(map(self._watchers.get, writers)) and (picture := self._plant.picture()) is not None:
            png = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
            lines[True] = frame | {"picture": base64.b64encode(png).decode()}
        for writer in filter(_ready, writers):
            writer.write(json.dumps(lines[self._watchers[writer]]).encode() + b"\n")


def _ready(writer: StreamWriter) -> bool:
    return not writer.is_closing() and writer.transport.get_write_buffer_size() < SEND_BUFFER
