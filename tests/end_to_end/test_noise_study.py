"""The study of filters and noise: its commands in any set-up, and its tables and picture from made-up runs."""

import io

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from page_studies import noise
from page_studies.noise import (
    ESTIMATORS,
    LEVELS,
    PLATE,
    POSITION,
    SetUp,
    family_sweep,
    pictures,
    tables,
)
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import parse_magnitudes


def made_up(path):
    """Return runs of a family: the error grows with the place of the estimator; one run of `kalman` ends early."""
    family = path.name
    places = (
        [each.number for each in parse_magnitudes(family, LEVELS[family])]
        if LEVELS[family]
        else [np.nan]
    )
    rows = [
        {"controller": f"pid+{name}", "seed": seed, "magnitude": place, "unit": "%", "status": "completed",
         "rms_error": (1.0 + 0.01 * i) * (1.0 + seed), "jacobian_error_mean": 0.3}
        for i, name in enumerate(reversed(ESTIMATORS))
        for place in places
        for seed in range(4)
    ]  # fmt: skip
    runs = pd.DataFrame(rows)
    runs.loc[(runs["controller"] == "pid+kalman") & (runs["seed"] == 3), "status"] = "diverged"
    return runs


def test_a_set_up_brings_its_size_of_a_pixel_and_its_options():
    words = family_sweep(SetUp("other", "other_errors", 0.5, ("--new", "word")), "stable")
    assert words[-2:] == ("--new", "word")
    assert {"kinematic.sensing.noise_offset=10", "kinematic.sensing.feature_noise=0.707107"} <= set(
        words
    )
    assert "kinematic.sensing.feature_noise=0.001" in family_sweep(POSITION, "white")


def test_a_pixel_of_the_plate_is_one_of_its_cameras():
    """Settings of noise are what metres are at the distance of the planned fixed camera."""
    robot = find_robot("ur10")
    distance = 1.3 * robot.workspace.scale
    assert PLATE.pixel * 120.0 / np.tan(np.radians(30.0)) / distance == pytest.approx(1.0, rel=1e-6)


def test_tables_are_of_ratios_to_the_true_jacobian_of_the_same_run(monkeypatch, tmp_path):
    monkeypatch.setattr(noise, "load_runs", made_up)
    made = tables(POSITION, tmp_path)
    assert list(tables(PLATE, tmp_path)) == ["noise_plate", "noise_plate_jacobian"]
    row = made["noise"].iloc[0]
    assert (row["noise"], row["level"]) == ("white", "")
    assert row["`constant`"] == "1.01 (1.01)"
    assert row["`kalman`"] == "1.07 (∞)"
    assert made["noise"].shape == made["noise_jacobian"].shape == (17, 2 + len(ESTIMATORS) - 1)
    assert set(made["noise_jacobian"]["`mckf`"]) == {"0.30"}


def test_the_picture_has_a_column_for_each_measure(monkeypatch, tmp_path):
    monkeypatch.setattr(noise, "load_runs", made_up)
    with mpl.rc_context({"savefig.facecolor": "black"}):  # of the user's
        ((name, content),) = pictures(POSITION, tmp_path).items()
    assert name == "pictures/noise.png"
    assert len(content) < 300e3
    with Image.open(io.BytesIO(content)) as picture:
        assert picture.size[0] > 900
        assert picture.convert("RGB").getpixel((0, 0)) == (255, 255, 255)
