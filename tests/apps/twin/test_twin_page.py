"""The window of a log that is held out, and the page about a twin."""

import math
from dataclasses import replace
from functools import cache
from html import unescape

import numpy as np
import pytest

from servobench import run
from servobench.harness.apps.twin.drive import command_response
from servobench.harness.apps.twin.held_out import held_out
from servobench.harness.apps.twin.identification import identify
from servobench.harness.apps.twin.log import read_log
from servobench.harness.apps.twin.page import region_of
from servobench.harness.apps.twin.summary import Answer, held_out_line
from servobench.harness.apps.twin.twin_file import twin_text
from servobench.harness.config.sensing import find_sensing
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.twin import deviated

ROBOT = "ur10e"


@cache
def logged():
    """Return the table of a run of 20 s, its log, the nominal model and the robot identified from it."""
    settings = {"random": {"duration": 20.0}, "kinematic": {"sensing": {"latency": 0.08}}}
    steps = run("docs/examples/excite.py", task="random", robot=ROBOT, mismatch="severe", seed=3,
                settings=settings).steps  # fmt: skip
    model = find_sensing("position").nominal(find_robot(ROBOT))
    log = read_log(hand_eye_spec(model, 0.05, 1.0, 2.0 * math.pi), steps)
    return steps, log, model, identify(log, model)


def test_errors_of_frames_that_were_held_out_are_their_noise():
    _, log, model, robot = logged()
    held = held_out(log, model, robot)
    assert held.begin == pytest.approx(16.0, abs=0.2)
    assert held.ratio == pytest.approx(1.0, abs=0.25)
    assert held.deviations == pytest.approx(np.sqrt(np.diag(robot.noise)), rel=0.3)
    assert f"{held.ratio:.2f} times its residuals" in held_out_line(log, held)


def test_a_robot_that_changes_in_the_window_is_not_hidden_by_the_fit():
    _, log, model, robot = logged()
    late = (log.time > held_out(log, model, robot).begin)[:, None]
    moved = log._replace(features=log.features + 0.02 * late)
    assert held_out(moved, model, robot).ratio > 3.0


def test_a_log_that_is_too_short_holds_nothing_out():
    _, log, model, robot = logged()
    short = log._replace(valid=log.valid & (log.time < 3.0))
    assert held_out(short, model, robot) is None
    assert held_out_line(short, None) == ""


def test_a_twin_keeps_its_errors_in_the_window(tmp_path):
    _, log, model, robot = logged()
    held = held_out(log, model, robot)
    path = tmp_path / "twin.toml"
    named = (ROBOT, "position")
    path.write_text(twin_text(robot, log, command_response(log), named, held), encoding="utf-8")
    assert find_robot(str(path)).twin.keys.held_out == pytest.approx(held.deviations)


def test_where_a_twin_is_sure_is_what_drawn_robots_say():
    _, log, model, robot = logged()
    small = replace(robot, covariance=1e-6 * robot.covariance)  # so small that effects are linear
    answer = Answer("a robot", "log", log, model, small, None, None)
    joints = log.joints[::80]
    draws = np.random.default_rng(1).multivariate_normal(
        np.zeros(len(robot.names)), small.covariance, 400
    )
    static = {n: v for n, v in robot.values_by_name().items() if not n.startswith("camera")}
    features = []
    for draw in draws:
        values = dict(static)
        for name, change in zip(robot.names, draw, strict=True):
            values[name] = values.get(name, 0.0) + change
        features.append(deviated(model.with_camera(robot.pose), values).feature(joints))
    wanted = np.sqrt(np.var(features, axis=0).sum(axis=-1))
    np.testing.assert_allclose(region_of(answer, joints).deviation, wanted, rtol=0.2)


@pytest.mark.slow
def test_the_page_of_a_twin_holds_everything_itself(tmp_path, output_of):
    steps, *_ = logged()
    steps.to_csv(tmp_path / "log.csv", index=False)
    page = tmp_path / "twin.html"
    said = output_of("identify", tmp_path / "log.csv", "--robot", ROBOT, "--page", page)
    text = unescape(page.read_text(encoding="utf-8"))
    assert text.count("data:image/png;base64,") == 6
    assert "default-src 'none'" in text
    assert 'src="http' not in text
    (line,) = (line for line in said.splitlines() if line.startswith("held out"))
    for words in (line, "gear_<wbr>elbow", "not told:<wbr> ", "in the median"):
        assert words in text
