"""Films and snapshots of runs, from the log alone."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from kit.command import finish, servobench, start, wait_for
from kit.own import CELL, PLAIN_CELL, write
from kit.plants import NEEDS_BULLET
from kit.robots import DRIVEN_TWIN
from servobench.harness.apps.figures.style import method_styles
from servobench.harness.apps.films import film
from servobench.harness.apps.films.replay import Replay, Trail, logged_run, stretch
from servobench.harness.batch import store
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.request import RunRequest
from servobench.plant.contract.faults import ConfigurationError

pytestmark = NEEDS_BULLET  # it renders what is shown
REQUEST = RunRequest("kinematic", "calibrated", "circle", "moderate", 3)


@pytest.fixture(scope="module")
def result():
    return run_experiment(REQUEST, Settings({"circle": {"laps": 1, "lap_time": 2.0}}))


@pytest.fixture(scope="module")
def run(result):
    return logged_run(result.row, result.steps)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, result):
    made = tmp_path_factory.mktemp("record") / "out"
    store.create_folder(made, {"configuration": {"bullet": {"scenery": False}}})
    store.write_part(made, 0, [result])
    store.collect(ResultsFolder(made))
    return made


def test_the_ball_in_the_scene_is_where_the_log_says(run):
    with Replay(run) as replay:
        for k in (0, 20, 39):
            replay.place(k)
            np.testing.assert_allclose(replay._scene.ball_position(), run.ball[k], atol=1e-6)


def test_the_reference_is_a_horizontal_circle_in_the_cameras_frame_wherever_that_is(run):
    np.testing.assert_allclose(run.model.to_camera(run.reference)[:, 2], 1.25)
    centre = run.model.to_base(np.array([0.0, 0.0, 1.25]))
    np.testing.assert_allclose(np.linalg.norm(run.reference - centre, axis=1), 0.3)


def test_the_cameras_view_has_the_detection_in_it(run):
    with Replay(run) as replay:
        replay.place(0)
        picture = replay.camera_view()
    assert picture.shape == (240, 320, 3)
    assert (picture == (40, 255, 80)).all(axis=2).any()


def test_a_trail_is_drawn_in_its_colour_and_pale_behind_the_arm(run):
    colour = (255, 0, 255)
    inside = np.linspace((0.0, 0.0, 0.02), (0.0, 0.0, 0.06), 5)  # within the arm's foot
    outside = np.linspace((0.6, -0.4, 0.3), (0.6, 0.0, 0.3), 5)
    with Replay(run) as replay:
        replay.place(0)
        plain, seen, hidden = (replay.overview(trails).astype(int) for trails in (
            [], [Trail(outside, colour, 2)], [Trail(inside, colour, 2)]))  # fmt: skip
    assert (seen == colour).all(axis=2).any()
    assert not (hidden == colour).all(axis=2).any()
    assert 0 < np.abs(hidden - plain).max() < 100


def test_a_frame_shows_the_time_grow(run):
    first, last = film.draw_frame(run, 0), film.draw_frame(run, 39)
    assert first.shape == last.shape == (film.HEIGHT, film.WIDTH, 3)
    colour = np.array(mpl.colors.to_rgb(method_styles(["calibrated"])["calibrated"].colour)) * 255
    error_panel = (slice(550, 680), slice(90, 930))
    dark = [(np.abs(frame[error_panel] - colour).max(axis=2) < 30).sum() for frame in (first, last)]
    assert dark[1] > dark[0] + 200


@pytest.fixture(scope="module")
def films(run, tmp_path_factory):
    pytest.importorskip("imageio_ffmpeg", reason="the extra animation is not installed")
    told = []
    stem = tmp_path_factory.mktemp("films") / "run"
    paths = film.write_recording(
        stretch(run, 0.0, 0.95), stem, ("mp4", "gif"), lambda *said: told.append(said)
    )
    return paths, told


def test_films_last_as_long_as_the_run_and_the_gif_is_small(films):
    import imageio_ffmpeg

    paths, told = films
    assert [path.name for path in paths] == ["run.mp4", "run.gif"]
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(paths[0]))
    assert (frames, seconds) == (20, pytest.approx(1.0, abs=0.05))
    with Image.open(paths[1]) as gif:
        assert gif.n_frames == 10
        assert gif.size[0] == film.GIF_WIDTH
    assert paths[1].stat().st_size < 6e6 * 1.0 / 20.0
    shares = [share for share, what in told if what == "frames"]
    assert shares == sorted(shares)
    assert len(shares) == 20


@pytest.fixture(scope="module")
def move():
    made = run_experiment(RunRequest("kinematic", "calibrated", "exp2", "moderate", 3), Settings())
    return logged_run(made.row, made.steps)


def test_snapshots_of_a_move_show_eight_places_and_not_the_arm_at_rest(move):
    chosen = film.snapshot_instants(move.ball, 8)
    time = move.track.time[chosen]
    assert time[0] == 0.0
    assert 0.5 < time[-1] < 3.0 < move.track.time[-1]
    ways = np.linalg.norm(np.diff(move.ball[chosen], axis=0), axis=1)
    assert ways.min() > 0.02


def test_snapshots_are_equally_far_apart_along_the_way():
    time = np.linspace(0.0, 1.0, 1001)
    ball = np.stack([time**3, 0.0 * time, 0.0 * time], axis=-1)  # it gets faster and faster
    chosen = film.snapshot_instants(ball, 5)
    np.testing.assert_allclose(ball[chosen, 0], [0.0, 0.25, 0.5, 0.75, 1.0], atol=0.012)


@given(st.integers(1, 30), st.integers(2, 12), st.integers(0, 2**31))
def test_snapshots_are_different_instants_in_order_whatever_the_ball_does(periods, count, seed):
    generator = np.random.default_rng(seed)
    ball = generator.normal(size=(periods, 3)) * generator.choice(
        [0.0, 1.0, 100.0], size=(periods, 1)
    )
    chosen = film.snapshot_instants(ball, count)
    assert len(chosen) == min(count, periods)
    assert sorted(set(chosen)) == chosen
    assert 0 == chosen[0] <= chosen[-1] < periods


def test_a_stretch_of_a_run_keeps_its_times_and_rows(run):
    part = stretch(run, 0.5, 1.0)
    assert part.track.time.tolist() == run.track.time[10:31].tolist()
    assert part.ball.tolist() == run.ball[10:31].tolist()
    assert part.moved_from == run.moved_from - 10
    assert stretch(run, 0.0, None).track.table.equals(run.track.table)
    with pytest.raises(
        ConfigurationError, match="has no instant from 3 to 4 s: it goes from 0 to 1.95 s"
    ):
        stretch(run, 3.0, 1.0)


def test_an_interruption_leaves_no_film_and_no_ffmpeg(run, tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg", reason="the extra animation is not installed")
    film.find_ffmpeg()  # which starts one the first time
    started = []
    popen = subprocess.Popen
    monkeypatch.setattr(
        film.subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[-1]
    )

    def interrupt(share, what):
        if share > 0.1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        film.write_recording(run, tmp_path / "run", ("mp4", "gif"), interrupt)
    assert list(tmp_path.iterdir()) == []
    assert len(started) == 2
    assert all(process.poll() is not None for process in started)


def write_frames(path):
    with film.encoding(film.find_ffmpeg(), path, (64, 48), 10.0) as write:
        for _ in range(100):
            write(np.zeros((48, 64, 3), np.uint8))


def test_a_film_that_ffmpeg_cannot_write_is_one_line_with_its_reason(tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="the extra animation is not installed")
    target = tmp_path / "none" / "run.mp4"
    with pytest.raises(
        ConfigurationError, match=r"ffmpeg cannot write .*run.mp4: .*No such file or directory"
    ):
        write_frames(target)


def test_a_stopped_recording_says_so_and_leaves_nothing(tmp_path, folder):
    process = start("record", str(folder), "--kinds", "gif", "--out", str(tmp_path))
    wait_for(lambda: any(tmp_path.iterdir()))
    os.kill(process.pid, signal.SIGTERM)
    code, output = finish(process)
    assert code == 143, output
    assert output.splitlines()[-1] == "servobench: terminated"
    assert "Traceback" not in output
    assert list(tmp_path.iterdir()) == []


def test_snapshots_go_once_around(run):
    assert film._lap(run) == 39
    twice = replace(run, reference=np.concatenate([run.reference, run.reference]))
    assert 38 <= film._lap(twice) <= 41
    resting = replace(run, reference=np.tile(run.reference[0], (40, 1)))
    assert film._lap(resting) == 39


def test_without_ffmpeg_there_is_one_line(refusal_of, monkeypatch, tmp_path, folder):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    error = refusal_of("record", folder, "--out", tmp_path)
    assert "pip install 'servobench[animation]'; --kinds snapshots works without it" in error
    assert list(tmp_path.iterdir()) == []


def test_a_file_named_as_a_film_is_that_film(refusal_of, monkeypatch, tmp_path, folder):
    pytest.importorskip("imageio_ffmpeg", reason="the extra animation is not installed")
    target = tmp_path / "mine.gif"
    assert (
        servobench(monkeypatch, "record", str(folder), "--out", str(target), "--length", "0.2") == 0
    )
    assert target.read_bytes().startswith(b"GIF8")
    assert list(tmp_path.iterdir()) == [target]
    assert "names one film; leave --kinds mp4 away" in refusal_of(
        "record", folder, "--out", target, "--kinds", "mp4"
    )


def test_runs_that_cannot_be_shown_are_refused(result):
    row, steps = result.row, result.steps
    with pytest.raises(ConfigurationError, match="has no steps: it ended before its first period"):
        logged_run(row, steps.iloc[:0])
    with pytest.raises(
        ConfigurationError, match=r"has 5 joint positions \[rad\]; wanted the 6 of a UR5"
    ):
        logged_run(row, steps.drop(columns="joint_position_elbow_rad"))
    other = json.loads(row["mismatch_values"])
    other["tool_offset"][0] += 1e-3
    with pytest.raises(
        ConfigurationError, match="was made on another robot than mismatch moderate and seed 3"
    ):
        logged_run(row | {"mismatch_values": json.dumps(other)}, steps)
    with pytest.raises(ConfigurationError, match="'mild' is not known"):
        logged_run(row | {"mismatch": "mild"}, steps)


def run_on(monkeypatch, folder, text, *arguments):
    """Carry out a short run on a plant of a file, which later commands do not know."""
    write(folder, text, "cell.py")
    arguments = (
        "run",
        "constant",
        "--plant",
        "./cell.py",
        *arguments,
        "--no-figures",
        "--out",
        "out",
    )
    assert servobench(monkeypatch, *arguments) == 0


def test_a_run_on_an_own_plant_with_the_arm_is_recorded(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    run_on(monkeypatch, tmp_path, CELL, "--task", "exp2", "--set", "exp2.duration=0.1")
    (tmp_path / "cell.py").unlink()  # the log is enough
    assert servobench(monkeypatch, "record", "out", "--kinds", "snapshots") == 0, (
        capsys.readouterr().err
    )
    assert (
        tmp_path / "out" / "recordings" / "Cell-constant-exp2-moderate-0_snapshots.png"
    ).stat().st_size > 10_000


def test_a_plant_with_a_robot_of_its_own_is_refused(refusal_of, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    target = (
        "--task",
        "target",
        "--set",
        "target.target=[0.2, 0.7]",
        "--set",
        "target.duration=0.5",
    )
    run_on(
        monkeypatch,
        tmp_path,
        PLAIN_CELL,
        *target,
        "--mismatch",
        "none",
        "--set",
        "constant.initial.source=probe",
    )
    line = refusal_of("record", "out", "--kinds", "snapshots")
    assert "cannot be shown: plant Plain brings a robot of its own\n" in line


def test_a_run_on_a_twin_is_shown_with_its_true_robot(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "twin.toml").write_text(DRIVEN_TWIN, encoding="utf-8")
    request = RunRequest("kinematic", "ukf_mfac", "random", "none", 3, robot="twin.toml")
    made = run_experiment(request, Settings({"random": {"duration": 1.0}}))
    shown = logged_run(made.row, made.steps)
    assert not caplog.text
    arm = np.array([shown.model.to_base(shown.model.feature(q)) for q in shown.joint_position])
    np.testing.assert_allclose(shown.ball, arm, atol=1e-9)
    nominal = shown.robot.nominal
    drawn = np.array([nominal.to_base(nominal.feature(q)) for q in shown.joint_position])
    assert np.linalg.norm(drawn - shown.ball, axis=1).min() > 0.02


def test_a_run_whose_camera_was_moved_is_shown_by_both_poses():
    request = RunRequest("kinematic", "regression_mfac", "random", "moderate+camera_move=90deg", 3)
    made = run_experiment(request, Settings({"random": {"duration": 2.0}}))
    shown = logged_run(made.row, made.steps)
    assert shown.moved_from == 21  # of 40 periods; the move happens during the one before
    arm = np.array([shown.model.to_base(shown.model.feature(q)) for q in shown.joint_position])
    np.testing.assert_allclose(shown.ball, arm, atol=1e-9)
    before, after = shown.reference[:21], shown.reference[21:]
    np.testing.assert_allclose(np.ptp(before, axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.ptp(after, axis=0), 0.0, atol=1e-9)
    assert np.linalg.norm(after[0] - before[0]) > 0.1
    targets = [film._trails(shown, k)[0].points.mean(axis=0) for k in (0, 20, 21, 39)]
    np.testing.assert_allclose(targets, [before[0], before[0], after[0], after[0]], atol=1e-9)
    with Replay(shown) as replay:
        views = []
        for k in (20, 21):
            replay.place(k)
            views.append(replay.camera_view())
    assert (views[0] != views[1]).mean() > 0.1
