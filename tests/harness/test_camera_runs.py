"""Runs with a user's camera: features within its image, side by side, from a folder that is resumed, and refusals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import servobench as package
from kit.lanes import assert_rows_of_single_runs
from servobench.harness.apps.films.replay import logged_run
from servobench.harness.apps.studies.challenge import find_challenge
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.settings import Settings
from servobench.harness.run import starts
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.sampling import draw
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.kinematic import ENTRY as KINEMATIC

CAMERA = """
width = 640
height = 480
matrix = [[615.0, 0.0, 318.0], [0.0, 615.0, 242.0], [0.0, 0.0, 1.0]]
distortion = {k1 = 0.12, k2 = -0.25, p1 = 0.001, p2 = -0.0005}
rate = 15
noise = "0.5px"
"""
ON_FLANGE = '[pose]\nframe = "flange"\nposition = [0.0, -0.07, 0.05]\n'
WORD = "ur10e with mine.toml"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(CAMERA + ON_FLANGE)
    aside = (
        CAMERA.replace("615.0", "500.0") + '[pose]\nframe = "base"\nposition = [0.0, 0.5, 1.55]\n'
    )
    Path("aside.toml").write_text(
        aside + "rotation = [[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]\n"
    )
    Path("planned.toml").write_text(CAMERA.replace('noise = "0.5px"', ""))


def request(task="random", seed=1, sensing="pixel:hand", plant="kinematic", robot=WORD):
    return RunRequest(
        plant, "regression_mfac", task, "moderate", seed, robot=robot, sensing=sensing
    )


def test_features_are_in_its_image_and_change_at_its_rate():
    result = run_experiment(request(), Settings({"random": {"duration": 3.0}}))
    assert (
        result.row["run_id"]
        == "kinematic-ur10e+mine.toml-pixel_hand-regression_mfac-random-moderate-1"
    )
    assert result.steps is not None
    u, v = (result.steps[f"feature_{name}_px"] for name in ("u", "v"))
    assert u.between(0, 640).all()
    assert v.between(0, 480).all()
    # Beyond the bench's image
    assert max(u.max() - 320, 320 - u.min()) > 160 or max(v.max() - 240, 240 - v.min()) > 120
    frames = (15.0 * result.steps["time_s"] + 1e-9).astype(int).diff().iloc[1:].to_numpy() > 0
    np.testing.assert_array_equal(u.diff().iloc[1:].to_numpy() != 0.0, frames)


def test_its_noise_is_that_of_the_file():
    settings = Settings({"run": {"period": 0.067}, "kinematic": {"command_delay": 0.067}})
    plant = build(resolve(request(), settings)).plant
    observation = plant.reset(4)
    errors = []
    for _ in range(200):
        errors.append(observation.feature - plant.truth().feature)
        observation = plant.step(package.Command(np.zeros(6)))
    assert np.std(errors) == pytest.approx(0.5, rel=0.15)


def test_runs_side_by_side_have_the_rows_of_single_ones():
    settings = Settings({"random": {"duration": 1.0}})
    assert_rows_of_single_runs([resolve(request(seed=seed), settings) for seed in (1, 2)])


@pytest.mark.parametrize(("sensing", "robot"), [("pixel:hand", WORD), ("pixel", "ur5 with planned.toml"),
                                                ("position", "panda with planned.toml")])  # fmt: skip
def test_a_circle_is_within_the_image_and_leads_through_where_the_target_is(sensing, robot):
    drawn = draw(resolve(request("circle", sensing=sensing, robot=robot), Settings()))
    points = drawn.scenario.reference.points(np.linspace(0.0, 10.0, 50))
    assert drawn.true.valid_at(points, 1.0).all()
    middle = 0.5 * (points[0] + points[25])
    assert (
        np.linalg.norm(middle - drawn.true.points(drawn.scenario.start)) < 0.2 * drawn.true.distance
    )


def test_a_folder_tells_its_camera():
    asked = {"sensings": ["pixel:hand"], "robot": WORD, "settings": {"random": {"duration": 0.5}}}
    package.compare(["constant"], tasks=["random"], out="out", **asked)
    manifest = ResultsFolder(Path("out")).manifest
    assert manifest["robots"][0]["camera"]["pose"]["position"] == [0.0, -0.07, 0.05]
    assert manifest["configuration"]["kinematic"]["sensing.frame_period"] == 1.0 / 15.0


def test_a_run_is_shown_through_its_camera():
    result = run_experiment(
        request(sensing="position", robot="ur10e with planned.toml"), Settings()
    )
    shown = logged_run(result.row, result.steps)
    assert shown.robot.pinhole.width == 640
    np.testing.assert_allclose(shown.ball[-1], shown.reference[-1], atol=0.01)


def test_a_challenge_has_the_camera_of_a_file_beside_it(tmp_path):
    keys = 'title = "a"\nwhy = "b"\ntask = "random"\nreference = ["calibrated"]\ncamera = "planned.toml"\n'
    (tmp_path / "mine_too.toml").write_text(keys)
    cells = find_challenge(str(tmp_path / "mine_too.toml")).cells((), ("constant",), [0])
    assert {cell.request.robot for cell in cells} == {f"ur5 with {tmp_path / 'planned.toml'}"}


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (("--sensing", "pixel"), "camera mine.toml is on the flange; use the sensing pixel:hand"),
        (("--sensing", "stereo:hand"), "sensing stereo has 2 cameras, and mine.toml describes 1"),
        (("--sensing", "position:hand"), "sensing.feature_noise is 0.5px, but the features are in m"),
        (("--camera", "aside.toml", "--sensing", "pixel", "--task", "exp2"),
         "look at [pose] in aside.toml, whose z axis is"),
        (("--camera", "none.toml"), "camera file none.toml cannot be read: No such file or directory"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_one_line(refusal_of, command, said):
    arguments = [
        "run",
        "constant",
        "--plant",
        "kinematic",
        "--camera",
        "mine.toml",
        *command,
        "--out",
        "out",
    ]
    assert said in " ".join(refusal_of(*arguments).split())


def test_a_distance_that_no_two_targets_in_view_have_is_one_line(monkeypatch):
    monkeypatch.setattr(starts, "MAX_DRAWS", 512)
    with pytest.raises(
        ConfigurationError, match=r"of 512 postures .* no two of these are shortest = 100 m apart"
    ):
        run_experiment(request(), Settings({"random": {"shortest": 100.0}}))


def test_a_plant_with_a_camera_of_its_own_refuses_it():
    cell = replace(KINEMATIC, name="cell", any_sensing=False)
    with pytest.raises(
        ConfigurationError,
        match="plant cell brings a camera of its own, so --camera mine.toml does",
    ):
        package.run("constant", cell, task="random", robot="ur5 with mine.toml")
