"""`servobench play`: a target is reached, a choice obeyed, a knock survived, and no foreign page let in."""

import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from kit.command import PACKAGE, servobench
from kit.played import free_port, opened_page, request, session_of
from servobench.controllers.controller import Controller
from servobench.harness.config.registry import CONTROLLER_REGISTRY, offering
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.loop import LoopSettings, Rollout
from servobench.harness.run.resolution import resolve
from servobench.harness.run.sampling import draw
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import Command

viser = pytest.importorskip("viser", reason="no viser: the extra play is not installed")


def advance(session, seconds):
    for _ in range(round(seconds / session.period)):
        session.advance()


def errors(session):
    return session.errors[-1][1:]


@pytest.mark.parametrize(
    ("task", "mismatch"),
    [("random", "moderate"), ("tour", "moderate"), ("random", "moderate+camera_move=60deg")],
)
def test_a_session_takes_the_steps_of_a_run_to_the_bit(task, mismatch):
    asked = request(task=task, mismatch=mismatch)
    steps = run_experiment(asked, Settings()).steps
    with session_of("ukf_mfac", task=task, mismatch=mismatch) as session:
        found = [session.errors[-1][1]]
        while len(found) < len(steps):
            session.advance()
            found.append(session.errors[-1][1])
    assert found == (1e3 * steps["error_norm"]).tolist()
    final = draw(resolve(asked, Settings())).final
    np.testing.assert_array_equal(session.model.camera, final.camera)


def test_a_reference_that_is_redirected_begins_now():
    rollout = Rollout(None, None, np.arange(10.0)[:, None], LoopSettings(10, preview=1))
    rollout.k = 4
    assert rollout.reference[:, 0].tolist() == [4.0, 5.0]
    rollout.redirect(np.array([[7.0], [8.0], [9.0]]))
    assert rollout.reference[:, 0].tolist() == [7.0, 8.0]
    rollout.k = 5
    assert rollout.reference[:, 0].tolist() == [8.0, 9.0]


def test_the_ball_arrives_where_the_target_was_put():
    with session_of("calibrating_mfac", task="exp2") as session:
        advance(session, 3.0)
        place = session.sides[0].period.reference[0] + (0.1, -0.1, 0.05)
        session.aim(place)
        advance(session, 0.1)
        assert errors(session)[0] > 100.0
        advance(session, 4.0)
        assert errors(session)[0] < 3.0
        assert np.allclose(session.sides[0].period.truth.feature, place, atol=3e-3)


def test_two_sides_share_the_robot_and_the_noise():
    with session_of("ukf_mfac", "ukf_mfac", latency=0.1) as session:
        advance(session, 1.0)
        first, second = (side.period for side in session.sides)
        assert first.observation.feature.tolist() == second.observation.feature.tolist()
        assert errors(session)[0] == errors(session)[1]


def test_a_knock_is_seen_by_both_and_forgotten_by_the_better_one():
    with session_of("calibrating_mfac", "ukf_mfac", task="exp2") as session:
        advance(session, 5.0)
        before = session.model.camera.copy()
        assert max(errors(session)) < 3.0
        session.knock(np.radians(25.0))
        advance(session, 0.1)
        assert min(errors(session)) > 20.0
        assert not np.allclose(before, session.model.camera, atol=0.05)
        advance(session, 5.0)
        assert max(errors(session)) < 3.0


def test_what_a_method_has_found_out_is_told():
    with session_of("calibrating_mfac", latency=0.1) as session:
        advance(session, 6.0)
        numbers = session.sides[0].numbers
    assert numbers["calibrated"] == 1.0
    assert numbers["calibration_latency"] == pytest.approx(0.1, abs=0.01)


class Faulty(Controller):
    """Fails after half a second."""

    def __init__(self, knowledge):
        pass

    def reset(self, observation, seed):
        pass

    def step(self, observation, reference):
        if observation.time > 0.5:
            raise KeyError("no plan")
        return Command(np.zeros(6))


def test_a_controller_that_fails_is_named_and_the_other_one_goes_on():
    with offering():
        name = CONTROLLER_REGISTRY.choose(Faulty)
        with session_of(name, "ukf_mfac", task="exp2") as session:
            advance(session, 5.0)
            assert "no plan" in session.sides[0].reason
            assert np.isnan(errors(session)[0])
            assert errors(session)[1] < 3.0


def test_a_plant_with_a_robot_of_its_own_is_refused_in_one_line(monkeypatch, capsys):
    place = PACKAGE.parent / "docs" / "examples" / "planar" / "planar.py"
    code = servobench(monkeypatch, "play", "--plant", f"{place}:ENTRY", "--mismatch", "none")
    assert code == 2
    assert "robot that cannot be drawn" in capsys.readouterr().err


def choose(page, **values):
    """Let a user choose values on the page."""
    for key, value in values.items():
        page.controls[key].value = value
    page.obey()


@pytest.mark.slow
def test_a_choice_on_the_page_begins_anew_and_a_refused_one_changes_nothing():
    with opened_page("ukf_mfac", "calibrating_mfac", task="exp2") as (page, _):
        choose(page, beside="calibrating_mfac", mismatch="severe", seed=7, task="circle")
        choose(page, **{"plant.sensing.latency": 0.1, "plant.sensing.outliers": 0.05})
        session = page.session
        # A plot of logarithms without a number above 0 ends with an error in the browser.
        _, *errors_shown = page._plot.data
        assert np.greater(errors_shown, 0.0).all()
        assert len(errors_shown) == 2
        assert [side.name for side in session.sides] == ["ukf_mfac", "calibrating_mfac"]
        assert str(session.request.mismatch) == "severe"
        assert (session.request.task, session.request.seed) == ("circle", 7)
        assert (session.sensing.latency, session.sensing.outliers) == (0.1, 0.05)
        choose(page, mismatch="moderate+outliers=20%")
        for _ in range(10):
            page.show()
        assert page.session is session
        assert "outliers is varied" in page.texts.content
        session.advance()


@pytest.mark.slow
def test_each_mismatch_on_the_page_can_be_chosen():
    from servobench.harness.apps.play.scene import PAGE

    for text in PAGE["mismatches"]:
        with session_of("ukf_mfac", mismatch=text) as session:
            advance(session, 0.2)
            assert not session.sides[0].reason


@pytest.mark.slow
def test_a_target_that_is_dragged_comes_through_the_websocket():
    import msgspec
    from websockets.sync.client import connect

    with opened_page("calibrating_mfac", task="exp2") as (page, port):
        page.show()
        place = [0.15, -0.1, 1.2]
        dragged = {
            "type": "TransformControlsUpdateMessage", "name": "/0/camera/target",
            "wxyz": [1.0, 0.0, 0.0, 0.0], "position": place, "owner": "",
        }  # fmt: skip
        protocol = [f"viser-v{viser.__version__}"]
        with connect(f"ws://127.0.0.1:{port}", subprotocols=protocol) as browser:
            browser.send(msgspec.msgpack.encode(dragged))
            for _ in range(100):
                page.obey()
                if page.session.held:
                    break
                time.sleep(0.05)
        advance(page.session, 4.0)
        assert np.allclose(page.session.sides[0].period.truth.feature, place, atol=3e-3)


@pytest.mark.parametrize(
    "origin",
    ["http://foreign.invalid", "http://127.0.0.1:{other}", "https://127.0.0.1:{port}", "null"],
)
def test_a_page_from_elsewhere_is_refused_before_the_handshake(origin):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    from servobench.harness.apps.play.guard import open_server

    port = free_port()
    server = open_server("127.0.0.1", port)
    try:
        place = f"ws://127.0.0.1:{port}"
        with pytest.raises(InvalidStatus, match="403"):
            connect(place, origin=origin.format(port=port, other=port + 1))
        protocol = [f"viser-v{viser.__version__}"]
        for own in (f"http://127.0.0.1:{port}", f"http://localhost:{port}", None):
            with connect(place, origin=own, subprotocols=protocol) as browser:
                assert browser.recv(timeout=10)
    finally:
        server.stop()


def test_a_port_that_is_used_and_an_address_that_is_none_are_one_line_each():
    from servobench.harness.apps.play.guard import open_server

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigurationError, match=f"127.0.0.1:{port} cannot be opened, try"):
            open_server("127.0.0.1", port)
    with pytest.raises(ConfigurationError, match="^--host: "):
        open_server("home", 8090)


# Processes of a shell's background ignore Ctrl-C, and hand that on.
LISTENING = "import signal, os, sys; signal.signal(signal.SIGINT, signal.default_int_handler); " \
    "os.execv(sys.executable, [sys.executable, '-m', 'servobench', *sys.argv[1:]])"  # fmt: skip


@pytest.mark.slow
def test_ctrl_c_ends_the_page_and_frees_its_port():
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-c", LISTENING, "play", "--port", str(port)],
        env={**os.environ, "PYTHONPATH": str(PACKAGE)}, start_new_session=True,
        text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        assert process.stdout.readline() == f"playing at http://127.0.0.1:{port}; Ctrl-C ends it\n"
        process.send_signal(signal.SIGINT)
        output, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (process.returncode, output, said) == (130, "", "servobench: interrupted\n")
    socket.create_server(("127.0.0.1", port)).close()
