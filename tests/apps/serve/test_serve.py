"""A plant on the ports of a UR: packets, the control program, lockstep, refusals, and bytes that make no sense.

Here a client speaks bytes; tests/end_to_end/test_on_a_ur.py talks to the server by `ur-rtde` itself.
"""

import asyncio
import hashlib
import json
import math
import random
import socket
import struct
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kit.served import REQUEST, SPEED, Bytes, commanding, connected, packed, served, waited_for
from servobench.harness.apps.serve.program import ControlProgram, profile, script_version
from servobench.harness.apps.serve.server import CONNECTIONS, PORTS, Server
from servobench.harness.apps.serve.wire import (
    CONTROLLER,
    INPUTS,
    NOT_FOUND,
    OUTPUTS,
    Recipe,
    WireError,
)
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.resolution import resolve
from servobench.plant.bench.plant import TrueModel
from servobench.plant.contract.faults import Collision, ConfigurationError
from servobench.plant.contract.seeds import named_seed
from servobench.plant.contract.signals import Command

VERSION_2 = packed("V", b"\x00\x02")


@pytest.fixture(scope="module")
def lockstep():
    with served() as running:
        yield running


def test_a_move_takes_the_time_of_a_trapezoid():
    duration, done = profile(0.5, 0.8, 1.4)
    assert duration == pytest.approx(0.5 / 0.8 + 0.8 / 1.4)
    assert done(duration / 2.0) == pytest.approx(0.5)
    assert done(0.1) == pytest.approx(1.4 * 0.1**2 / 2.0 / 0.5)
    assert [done(0.0), done(-1.0), done(duration), done(9.0)] == [0.0, 0.0, 1.0, 1.0]
    # Never reaches its speed
    assert profile(0.1, 5.0, 1.0)[0] == pytest.approx(2.0 * math.sqrt(0.1))
    assert profile(0.0, 1.0, 1.0)[0] == 0.0


@given(st.lists(st.sampled_from(sorted(INPUTS)), min_size=1, max_size=9, unique=True), st.data())
def test_values_come_back_as_they_were_packed(names, data):
    recipe = Recipe.of(",".join(names).encode(), INPUTS)
    kinds = {
        "INT32": st.integers(-(2**31), 2**31 - 1),
        "UINT32": st.integers(0, 2**32 - 1),
        "UINT8": st.integers(0, 255),
        "DOUBLE": st.floats(allow_nan=False),
        "VECTOR6D": st.tuples(*[st.floats(allow_nan=False)] * 6),
    }
    values = {name: data.draw(kinds[kind]) for name, kind in zip(names, recipe.types, strict=True)}
    assert recipe.unpack(recipe.pack(values)) == values


def test_bytes_that_are_no_list_of_names_are_no_recipe():
    for body in (b"\xff", b"a," * 1025):
        with pytest.raises(WireError, match="a recipe must be at most 2048 bytes of names"):
            Recipe.of(body, OUTPUTS)
    for body in (b"", b",,"):
        assert Recipe.of(body, OUTPUTS).types == (NOT_FOUND,)
    assert Recipe.of(b"actual_q,nonsense,", OUTPUTS).types == ("VECTOR6D", NOT_FOUND)
    assert Recipe.of(b"actual_q", INPUTS).types == (NOT_FOUND,)


def test_a_commanded_period_is_that_of_a_run(lockstep):
    server, address, _ = lockstep
    experiment = build(resolve(REQUEST, Settings({})))
    plant = experiment.plant
    plant.reset(named_seed(REQUEST.seed, "plant"))
    with commanding(server, address) as client:
        client.names, rows = ["timestamp", "actual_q"], []
        own = Bytes(address, "timestamp,actual_q")
        own.start()
        start = server.rollout.observation
        for k in range(20):
            speeds = [0.1 * math.sin(k + joint) for joint in range(6)]
            client.command(9, *speeds, 1.0, 0.05)
            before = server.rollout.k
            expected = plant.step(Command(np.array(speeds)))
            while True:
                row = struct.unpack(">7d", own.packet()[1][1:])
                if row[0] > start.time + (k + 0.5) * 0.05:
                    break
            rows.append((row[1:], expected.joint_position))
            assert server.rollout.k <= before + 1
        own.close()
    for row, joints in rows:
        assert np.array_equal(row, joints)
    plant.close()


def test_a_move_in_lockstep_ends_at_its_target():
    with served() as (server, address, _), commanding(server, address) as client:
        target = server.rollout.observation.joint_position + np.array(
            [0.3, -0.1, 0.2, 0.0, 0.0, 0.1]
        )
        client.command(1, *target, 0.8, 1.4)
        assert waited_for(lambda: server.program.progress == 2)
        assert np.abs(server.rollout.observation.joint_position - target).max() < 3e-3
        theory = 0.3 / 0.8 + 0.8 / 1.4
        assert theory <= server.rollout.observation.time < theory + 0.5
        client.command(0)
        assert waited_for(lambda: server.program.progress == 1)


def test_a_served_position_is_approached():
    with served() as (server, address, _), commanding(server, address) as client:
        names = ("input_int_register_0", *(f"input_double_register_{k}" for k in range(11)))
        number, _ = client.set_up(*names)
        target = server.rollout.observation.joint_position + 0.1
        for k in range(40):
            client.send(number, "i11d", 11, *target, 0.0, 0.0, 0.05, 0.1, 300.0)
            assert waited_for(lambda k=k: server.rollout.k > k)
        assert np.abs(server.rollout.observation.joint_position - target).max() < 5e-3


@pytest.mark.parametrize(
    ("number", "values", "said"),
    [
        (9, [math.nan] * 6 + [1.0, 0.1], "ended at speedJ: its numbers must be finite"),
        (9, [0.1] * 6 + [0.0, 0.1], "ended at speedJ: its acceleration must be positive, got 0"),
        (
            1,
            [99.0] * 6 + [1.0, 1.0],
            "ended at moveJ: its target must be within the joints' limits",
        ),
        (1, [0.5] * 6 + [1e-9, 1.0], "ended at moveJ: its move must take less than 300 s"),
        (1, [0.5] * 6 + [5e-324, 5e-324], "ended at moveJ: its move must take less than 300 s"),
        (3, [], "ended at moveL (command 3), which is not served"),
        (10, [], "ended at speedL (command 10), which is not served"),
        (66, [], "ended at directTorque (command 66), which is not served"),
        (-7, [], "ended at - (command -7), which is not served"),
    ],
)
def test_a_command_that_cannot_be_obeyed_ends_the_program_by_name_and_the_arm_stands(
    number, values, said
):
    with served() as (server, address, lines), commanding(server, address) as client:
        client.command(9, *[0.2] * 6, 1.0, 0.05)
        client.command(number, *values)
        assert waited_for(lambda: any(said in line for line in lines)), lines
        assert waited_for(lambda: not server.program.busy)
        assert not server.program.running
        assert not server.program.velocity.any()
        assert server.program.progress == 0


def test_an_asynchronous_move_is_refused():
    with served() as (server, address, lines), commanding(server, address) as client:
        number, _ = client.set_up(*SPEED, "input_int_register_1")
        client.send(number, "i8di", 1, *[0.0] * 6, 1.0, 1.0, 1)
        assert waited_for(
            lambda: any("asynchronous moves are not served" in line for line in lines)
        )


def test_speeds_are_clipped_as_in_a_run(lockstep):
    server, address, _ = lockstep
    with commanding(server, address) as client:
        client.command(9, *[1e300, -1e300] * 3, 1.0, 0.05)
        assert waited_for(lambda: np.abs(server.program.velocity).max() == 1.0)


def program_of(spec, lines, **how):
    drive = TrueModel(lambda q: q, lambda q: q, command_delay=0.05, lag=0.05)
    program = ControlProgram(spec, drive, lines.append, **how)
    program.joints = np.zeros(spec.n)
    program.begin()
    return program


@pytest.fixture(scope="module")
def spec():
    experiment = build(resolve(REQUEST, Settings({"run": {"period": 0.002}})))
    yield experiment.plant.spec
    experiment.plant.close()


def registers(command, *values):
    return {"input_int_register_0": command} | {
        f"input_double_register_{k}": each for k, each in enumerate(values)
    }


def test_a_speed_is_reached_with_its_acceleration(spec):
    program = program_of(spec, [], lockstep=False)
    program.inputs |= registers(9, 0.5, -0.25, 0.0, 0.0, 0.0, 0.0, 2.0)
    assert program.cycle()
    speeds = np.array([program.advance() for _ in range(200)])
    assert speeds[0] == pytest.approx([0.004, -0.002, 0.0, 0.0, 0.0, 0.0])
    assert speeds[124] == pytest.approx([0.5, -0.25, 0.0, 0.0, 0.0, 0.0])


def test_the_watchdog_ends_the_program_after_its_time_and_a_kick_holds_it_off(spec):
    lines = []
    program = program_of(spec, lines, lockstep=False)
    program.inputs |= registers(35, 10.0)
    program.cycle()
    assert program.progress == 2
    for _ in range(3):
        for _ in range(49):
            program.advance()
        assert program.running
        program.write({"input_int_register_0": 99})
    for _ in range(51):
        program.advance()
    assert not program.running
    assert lines == ["control program ended by its watchdog, after 0.102 s without a command"]


@pytest.mark.parametrize("replaced", [False, True])
def test_a_program_that_ends_or_replaces_one_that_moves_stops_the_arm(spec, replaced):
    program = program_of(spec, [], lockstep=False)
    program.inputs |= registers(9, *[1.0] * 6, 100.0)
    program.cycle()
    for _ in range(20):
        program.advance()
    if replaced:
        program.inputs |= registers(0)
        program.begin()
        program.cycle()
    else:
        program.stop("for a test")
    assert np.abs([program.advance() for _ in range(60)][-1]).max() == pytest.approx(0.0, abs=1e-12)
    assert program.running == replaced


def test_a_protective_stop_can_be_unlocked_after_five_seconds_and_not_before(spec, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("servobench.harness.apps.serve.program.time.monotonic", lambda: now[0])
    program = program_of(spec, [], lockstep=False)
    program.protect("for a test")
    assert not program.running
    now[0] += 4.9
    assert not program.unlock()
    now[0] += 0.2
    assert program.unlock()


def test_a_second_client_that_commands_is_refused_by_either_register(lockstep):
    server, address, lines = lockstep
    with commanding(server, address):
        second = Bytes(address)
        assert second.set_up(*SPEED)[0] == 0
        assert second.set_up("input_int_register_24") == (0, ["IN_USE"])
        assert second.set_up("input_int_register_18")[0] == 1
        second.close()
    assert (
        sum(
            "a second client is refused: another one writes input_int_register_" in line
            for line in lines
        )
        == 2
    )


def test_a_variable_that_is_not_served_is_named(lockstep):
    _, address, lines = lockstep
    client = Bytes(address, "timestamp,actual_q,no_such_thing")
    assert client.types == ["DOUBLE", "VECTOR6D", NOT_FOUND]
    assert client.start() == b"\x00"
    client.close()
    assert "1 variables are not served, the first is 'no_such_thing'" in lines


def test_an_unknown_script_is_named_with_its_date_and_not_carried_out(lockstep):
    _, address, lines = lockstep
    with connected(address, "script") as script:
        script.sendall(
            b'def rtde_control():\n  textmsg("RTDE Control Script Loaded (01.01.2030-12:00)")\nend\n'
        )
        said = "a script is not carried out: 83 bytes, dated 01.01.2030-12:00, SHA-256 "
        assert waited_for(lambda: any(line.startswith(said) for line in lines)), lines
    assert script_version(b"x") == ("1 bytes, dated nowhere, SHA-256 2d711642b726…", False)


def test_scripts_of_other_versions_are_named_and_not_served(monkeypatch):
    for digest, version in CONTROLLER["scripts"].items():
        monkeypatch.setattr(
            hashlib, "sha256", lambda _, digest=digest: SimpleNamespace(hexdigest=lambda: digest)
        )
        assert script_version(b"") == (f"ur-rtde {version}", "1.6.5" in version)


def test_the_dashboard_answers_in_its_words_and_names_what_is_not_served(lockstep):
    server, address, lines = lockstep
    with connected(address, "dashboard") as line, line.makefile("rwb", buffering=0) as stream:
        assert stream.readline() == b"Connected: Universal Robots Dashboard Server\n"

        def answer(words):
            stream.write(words.encode() + b"\n")
            return stream.readline().decode().strip()

        assert answer("PolyscopeVersion") == "URSoftware 5.11.0.0"
        assert answer("unlock protective stop") == "Protective stop releasing"
        server.program.begin()
        assert answer("running") == "Program running: true"
        assert answer("stop") == "Stopped"
        assert answer("programState") == "STOPPED rtde_control"
        assert answer("load x.urp") == "could not understand: 'load x.urp'"
        assert answer("quit") == "Disconnected"
        assert stream.readline() == b""
    assert "the dashboard command 'load x.urp' is not served" in lines


def test_features_come_as_lines_of_json(lockstep):
    server, address, _ = lockstep
    assert waited_for(lambda: not server.program.busy)  # from a test before
    with connected(address, "features") as line, line.makefile("rb") as stream:
        frame = json.loads(stream.readline())
    seen = server.rollout.observation
    assert frame["time"] == seen.time
    assert frame["feature"] == seen.feature.tolist()
    assert (frame["names"], frame["unit"], frame["valid"]) == (["x", "y", "z"], "m", [True] * 3)
    assert "capture_time" not in frame


def test_stamped_features_say_when_they_were_exposed():
    stamped = {"kinematic": {"sensing": {"stamps": True}}}
    with served(settings=stamped) as (server, address, _):
        with connected(address, "features") as line, line.makefile("rb") as stream:
            frame = json.loads(stream.readline())
        assert frame["capture_time"] == server.rollout.observation.capture_time


def test_a_port_that_cannot_be_opened_is_named_with_a_remedy(lockstep):
    for address, remedy in (
        (lockstep[1], "end what uses it, or serve at"),
        ("192.0.2.1", "serve at"),
    ):
        with pytest.raises(
            ConfigurationError,
            match=f"30004 of {address} cannot be opened: [^;]*; {remedy} another",
        ):
            asyncio.run(Server(REQUEST, Settings({}), print).serve(address))


def test_outputs_of_the_control_box_are_set(lockstep):
    server, address, lines = lockstep
    client = Bytes(address)
    number, _ = client.set_up("standard_digital_output_mask", "standard_digital_output")
    client.send(number, "2B", 8, 8)
    names = ("standard_analog_output_mask", "standard_analog_output_type")
    number, _ = client.set_up(*names, "standard_analog_output_0", "standard_analog_output_1")
    client.send(number, "2B2d", 3, 1, 0.5, 0.25)
    number, _ = client.set_up("speed_slider_mask", "speed_slider_fraction")
    client.send(number, "Id", 1, 0.5)
    assert waited_for(lambda: "setSpeedSlider is not served; speeds stay as commanded" in lines)
    client.close()
    assert server.state["actual_digital_output_bits"] == 8
    assert [server.state[f"standard_analog_output{k}"] for k in (0, 1)] == [5.0, 0.008]


def test_a_plant_that_cannot_go_on_is_a_protective_stop_that_stays(monkeypatch):
    with served() as (server, address, lines), commanding(server, address) as client:

        def collide(_):
            raise Collision("the wrist meets the table at 1.000 s")

        monkeypatch.setattr(server.rollout, "advance", collide)
        client.command(9, *[0.1] * 6, 1.0, 0.05)
        assert waited_for(lambda: "protective stop: the wrist meets the table at 1.000 s" in lines)
        assert server.state["safety_status_bits"] == 4
        with connected(address, "dashboard") as line, line.makefile("rwb", buffering=0) as stream:
            stream.readline()
            stream.write(b"unlock protective stop\n")
            assert (
                stream.readline()
                == b"Cannot unlock protective stop the wrist meets the table at 1.000 s\n"
            )


@pytest.mark.parametrize(
    ("port", "sent", "said"),
    [
        ("RTDE", b"\x00\x01V", "RTDE: a packet must have 3 to 2059 bytes, got a size of 1"),
        ("RTDE", b"\x00\x09I\x00", "RTDE: the stream ends within a packet, after 1 bytes"),
        (
            "RTDE",
            packed("S", b"\x00"),
            "RTDE: a packet of kind 'S' must have 3 bytes, got a size of 4",
        ),
        (
            "RTDE",
            packed("P", b"\x00"),
            "RTDE: a packet of kind 'P' must have 3 bytes, got a size of 4",
        ),
        (
            "RTDE",
            packed("V", b"\x02"),
            "RTDE: a packet of kind 'V' must have 5 bytes, got a size of 4",
        ),
        (
            "RTDE",
            VERSION_2 + packed("M", b"\x05hell"),
            "RTDE: a text message must be as long as its parts say, got 5",
        ),
        ("RTDE", packed("x"), "RTDE: kind 'x' of packet is none that a client sends"),
        (
            "RTDE",
            packed("U", b"\x07abc"),
            "RTDE: data are of recipe 7, which this client has not set up",
        ),
        (
            "RTDE",
            VERSION_2 + packed("O", b"abc"),
            "RTDE: outputs need a frequency of 1 to 500 Hz, got 0",
        ),
        (
            "RTDE",
            packed("O", struct.pack(">d", 5e-324) + b"actual_q"),
            "of 1 to 500 Hz, got 4.94066e-324",
        ),
        ("RTDE", packed("O", struct.pack(">d", math.nan) + b"actual_q"), "of 1 to 500 Hz, got nan"),
        (
            "RTDE",
            packed("I", b"input_int_register_0") + packed("U", b"\x01abc"),
            "must be 4 bytes, got 3",
        ),
        ("dashboard", b"x" * 9000, "dashboard: a line must have at most 4096 bytes"),
        (
            "script",
            b"def nothing",
            "script: 11 bytes that are no control script are not carried out",
        ),
        ("features", b"more\n", "features: wanted is the word pictures, got 'more'"),
    ],
)
def test_bytes_that_make_no_sense_are_a_line_and_the_end_of_their_connection(
    lockstep, port, sent, said
):
    _, address, lines = lockstep
    with connected(address, port) as line:
        line.sendall(sent)
        line.shutdown(1)
        assert waited_for(
            lambda: any(
                said in each and each.endswith("the connection is closed") for each in lines
            )
        ), lines
        while line.recv(65536):
            pass


# A recipe and moveJ
MOVE = packed("I", ",".join(SPEED).encode()) + packed(
    "U", b"\x01" + struct.pack(">i8d", 1, *[0.5] * 6, 1.0, 1.0)
)
METHODS = (
    "GET", "POST", "HEAD", "OPTIONS", "PUT", "DELETE", "PATCH", "TRACE", "PROPFIND", "COPY", "MOVE", "UNLOCK",
    "post", "S", "P", "!", "PO", "def", "stop",
)  # fmt: skip
FOREIGN = [
    *(f"{each} / HTTP/1.1\r\n".encode() for each in METHODS),
    b"CONNECT 127.0.0.1:30004 HTTP/1.1\r\n", b"POST http://127.0.0.1:29999/ HTTP/1.1\r\n", b"GET /\r\n",
    b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"GET /chat HTTP/1.1\r\nUpgrade: websocket\r\n",
    b"\r\n\r\nPOST / HTTP/1.1\r\n", b"\n\nOPTIONS / HTTP/1.1\r\n", b"POST /" + b"x" * 5000 + b" HTTP/1.1\r\n",
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", b"\x80\x2e\x01\x03\x01\x00\x15\x00",  # TLS, and that of before
    b"\x00\x03\x00\x1c\x21\x12\xa4\x42",  # STUN on TCP, as a page opens it
]  # fmt: skip


@pytest.mark.parametrize("port", PORTS)
@pytest.mark.parametrize("piece", [1 << 20, 1, 7])
def test_a_browser_closes_its_connection_with_its_first_line_and_nothing_moves(
    lockstep, monkeypatch, port, piece
):
    """After the first line comes what a port carries out, if it reads that line as a packet, a script or a command."""
    server, address, lines = lockstep
    monkeypatch.setattr(
        "servobench.harness.apps.serve.server.script_version", lambda _: ("a test", True)
    )
    server.program.begin()
    before = server.rollout.k, dict(server.program.inputs)
    for first in FOREIGN:
        size = int.from_bytes(first[:2])
        bodies = {
            "RTDE": first.ljust(size, b"x") + MOVE,
            "script": first + b"\r\n\nend\ndef rtde_control():\nend\n",
            "dashboard": first + b"Host: localhost\r\n\r\nstop\nunlock protective stop\n",
            "features": first + b"\r\npictures\n",
        }
        said = len(lines)
        with connected(address, port) as line:
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            body = bodies[port]
            with suppress(ConnectionError):
                for k in range(0, min(len(body), 2000 * piece), piece):
                    line.sendall(body[k : k + piece])
                while line.recv(65536):
                    pass
        assert any(each.startswith(f"{port}: ") for each in lines[said:]), (first, lines[said:])
    assert not server._watchers
    assert server.program.running
    assert (server.rollout.k, server.program.inputs) == before
    assert not any("control program" in each for each in lines[-len(FOREIGN) :])


def test_the_script_port_keeps_a_client_of_an_unserved_script_and_reads_it_in_pieces(
    lockstep, monkeypatch
):
    _, address, lines = lockstep
    known = b"def rtde_control():\n  pass\nend\n"
    monkeypatch.setattr(
        "servobench.harness.apps.serve.server.script_version",
        lambda each: ("a test", each == known),
    )
    said = len(lines)
    with connected(address, "script") as line:
        for byte in b"def custom():\n  textmsg(1)\nend\n" + known:
            line.sendall(bytes([byte]))
        assert waited_for(lambda: "control program of a test" in lines[said:]), lines
        assert sum("a script is not carried out: a test" in each for each in lines[said:]) == 1
        line.sendall(b"\nend\n" + known)
        assert line.recv(10) == b""
    assert lines[-1] == r"script: b'\nend\n' does not begin a script; the connection is closed"


def test_version_1_has_neither_frequency_nor_number_of_outputs(lockstep):
    _, address, lines = lockstep
    names = b"timestamp,output_int_register_3"
    for version in (packed("V", b"\x00\x01"), b""):  # a UR begins with it
        with connected(address, "RTDE") as line, line.makefile("rb") as stream:
            line.sendall(version + packed("O", names) + packed("S"))
            assert stream.read(len(version and b"...1")) == (version and packed("V", b"\x01"))
            assert stream.read(15) == packed("O", b"DOUBLE,INT32")
            assert stream.read(4) == packed("S", b"\x01")
            assert stream.read(15)[:3] == struct.pack(">HB", 15, ord("U"))
            assert stream.read(15)[:3] == struct.pack(">HB", 15, ord("U"))
    with connected(address, "RTDE") as line:
        line.sendall(packed("V", b"\x00\x09"))
        assert line.recv(10) == packed("V", b"\x00")
    assert "version 9 of RTDE is refused; served are 1 and 2" in lines


def test_a_message_is_a_line_and_an_empty_recipe_is_not_found(lockstep):
    _, address, lines = lockstep
    client = Bytes(address)
    client.socket.sendall(packed("M", b"\x05hel\x1bo\x03abc\x01"))
    assert client.asked("O", struct.pack(">d", 125.0)) == b"\x01NOT_FOUND"
    assert client.start() == b"\x00"
    assert client.set_up("") == (0, [NOT_FOUND])
    client.asked("V", b"\x00\x01")
    client.socket.sendall(packed("M", b"\x03of version 1"))
    assert client.asked("P") == b"\x01"
    client.close()
    assert {r"message of a client: 'hel\x1bo'", "message of a client: 'of version 1'"} < {*lines}
    assert lines.count("a recipe without variables sets up nothing") == 2


def test_silent_connections_give_way_and_none_that_has_spoken_or_listens_does():
    with served() as (server, address, lines), ExitStack() as stack:
        client = stack.enter_context(closing(Bytes(address)))
        dashboard, features = (
            stack.enter_context(connected(address, port)) for port in ("dashboard", "features")
        )
        answers, frames = (
            stack.enter_context(each.makefile("rb")) for each in (dashboard, features)
        )
        dashboard.sendall(b"running\n")
        assert [answers.readline(), answers.readline()][1] == b"Program running: false\n"
        frames.readline()
        for port in PORTS:
            for _ in range(3 * CONNECTIONS):
                stack.enter_context(connected(address, port)).sendall(
                    b"\x00" if port == "RTDE" else b"d"
                )
        assert waited_for(lambda: all(len(each) == CONNECTIONS for each in server._open.values()))
        assert [len(each) for each in server._open.values()] == [CONNECTIONS] * len(PORTS)
        late = stack.enter_context(closing(Bytes(address)))
        assert (late.start(), client.start()) == (b"\x01", b"\x01")
        dashboard.sendall(b"robotmode\n")
        assert answers.readline() == b"Robotmode: RUNNING\n"
        client.set_up(*SPEED)
        server.program.begin()
        client.command(9, *[0.1] * 6, 1.0, 0.05)
        assert json.loads(frames.readline())["time"] > 0.0
        assert sum("32 connections are open" in each for each in lines) == len(PORTS)
        assert not any("stream ends" in each for each in lines)


def test_a_client_that_goes_away_amid_its_packets_leaves_no_warning(lockstep, caplog):
    _, address, _ = lockstep
    for _ in range(5):
        line = connected(address, "RTDE")
        line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        line.sendall(packed("v") * 2000)
        line.recv(100)
        line.close()
    client = Bytes(address)
    assert client.start() == b"\x01"
    client.close()
    assert not caplog.records


def test_no_random_bytes_end_the_server(lockstep):
    _, address, lines = lockstep
    draw = random.Random(0)
    for k in range(80):
        with connected(address, ("RTDE", "dashboard", "script", "features")[k % 4]) as line:
            body = draw.randbytes(draw.randrange(1, 60))
            line.sendall(packed(draw.choice("VvOIUSPx"), body) if k % 8 == 0 else body)
    client = Bytes(address)
    assert client.start() == b"\x01"
    client.close()
    assert not any("Traceback" in line for line in lines)


def test_an_arm_without_six_joints_is_no_ur():
    with pytest.raises(
        ConfigurationError, match="--robot must be one with 6 joints, as every UR has, got 7"
    ):
        Server(replace(REQUEST, robot="panda"), Settings({}), print)
