"""The robustness map, and the seeded scenarios that a change in a method must not break.

A scenario's threshold is the lower end of the 99 % Wilson interval of what was measured on many robots, so that chance
does not break the test and a regression does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom
from statsmodels.stats.proportion import proportion_confint

from kit.command import servobench
from servobench.harness.analysis.statistics import settled_share
from servobench.harness.batch import results
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import RunRequest
from servobench.harness.studies.robustness import (
    LINES,
    MOVE,
    draw_map,
    map_cells,
    moved_settings,
    number_of,
    settling_median,
)


def test_the_map_has_every_place_for_every_method_and_no_run_twice():
    usual, moved = map_cells("kinematic", ["constant", "broyden"], [0, 1, 2])
    cells = [*usual, *moved]
    assert len({cell.request.run_id for cell in usual}) == len(usual)
    assert len(cells) == 2 * 3 * sum(len(line.places) for line in LINES)
    assert {cell.axis for cell in moved} == {MOVE}
    assert {cell.request.mismatch for cell in moved} >= {"moderate+camera_move=90deg"}
    assert {cell.request.latency_periods for cell in usual if cell.axis == "latency"} == {0, 1, 2, 3, 4, 5}
    assert {cell.request.noise_factor for cell in usual if cell.axis == "noise"} == {0.0, 1.0, 2.0, 4.0, 8.0}


def test_a_run_whose_camera_moves_is_longer_unless_the_user_says_how_long():
    assert moved_settings(Settings()).sections["random"]["duration"] == 20.0
    assert moved_settings(Settings({"random": {"duration": 5.0}})).sections["random"]["duration"] == 5.0


def test_settling_counts_from_the_move_of_the_camera():
    runs = pd.DataFrame({"settling_time_s": [11.0, 12.0, np.nan], "status": "completed", "moved_at_s": 10.0})
    assert settling_median(runs).value == 2.0
    assert settling_median(runs.drop(columns="moved_at_s")).value == 12.0
    assert settled_share(runs).value == pytest.approx(200 / 3)
    assert math.isinf(settling_median(runs.tail(1)).value)


def test_the_number_of_a_magnitude_has_no_unit():
    assert [number_of(place) for place in ("0deg", "12.5mm", "30%", "4")] == ["0", "12.5", "30", "4"]


def test_a_table_that_is_no_map_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="holds no axis of the robustness map; make one with"):
        draw_map(pd.DataFrame({"axis": ["", ""]}), tmp_path)


def test_the_command_draws_the_map(monkeypatch, tmp_path, capsys):
    out = tmp_path / "map"
    arguments = (
        "robustness", "--plant", "kinematic", "--controllers", "constant", "--seeds", "1", "--workers", "1",
        "--set", "random.duration=1", "--out", str(out),
    )  # fmt: skip
    assert servobench(monkeypatch, *arguments) == 0
    assert "the map is in" in capsys.readouterr().out
    assert len(results.load_runs(out / "moved")) == 5
    assert {path.name for path in (out / "figures").iterdir()} == {
        "robustness.png", "robustness.pdf", "robustness_settling.png", "robustness_settling.pdf",
    }  # fmt: skip


@dataclass(frozen=True)
class Scenario:
    """A world that is worse than usual, and how many of 100 robots each method settled on when it was measured.

    Attributes:
        name: for the test's name.
        mismatch: of the robots.
        settled: method -> settled runs of 100, seeds 500 to 599 on `fmu`.
        latency: of the camera, periods; None for the plant's.
        duration: of a run, s.
    """

    name: str
    mismatch: str
    settled: dict[str, int]
    latency: int | None = None
    duration: float = 10.0


SCENARIOS = (
    Scenario("severe", "severe", {"rbfnn_mfac": 99, "ukf_mfac": 100, "ukf_mpc": 100, "rbf_pid": 100}),
    Scenario(
        "camera_turned_by_60_degrees",
        "moderate+camera_rotation=60deg",
        {"rbfnn_mfac": 98, "ukf_mfac": 100, "ukf_mpc": 100, "rbf_pid": 100},
    ),
    Scenario(
        "camera_turned_by_120_degrees",
        "moderate+camera_rotation=120deg",
        {"ukf_mfac": 100, "ukf_mpc": 100, "rbf_pid": 94},  # where the proposed method settles 7 of 100
    ),
    Scenario(
        "links_20_percent_tool_60_mm",
        "moderate+links=20%+tool=60mm",
        {"rbfnn_mfac": 100, "ukf_mfac": 100, "ukf_mpc": 100, "rbf_pid": 100},
    ),
    Scenario(
        "latency_of_one_period",
        "moderate",
        {"rbfnn_mfac": 99, "ukf_mfac": 100, "ukf_mpc": 100, "rbf_pid": 100},
        latency=1,
    ),
    Scenario(
        "camera_moved_by_45_degrees",
        "moderate+camera_move=45deg",
        {"rbfnn_mfac": 98, "ukf_mfac": 100, "ukf_mpc": 100, "rbf_pid": 100},
        duration=16.0,
    ),
)
RUNS = 8  # of each method in each scenario; other robots than those that were measured
CASES = [
    pytest.param(plant, scenario, controller, id=f"{plant}-{scenario.name}-{controller}")
    for plant in ("kinematic", "fmu")
    for scenario in SCENARIOS
    for controller in scenario.settled
]


def fewest(settled_of_100: int) -> int:
    """Return the smallest number of RUNS that a method at the lower end of its 99 % interval reaches with 99.9 %."""
    low, _ = proportion_confint(settled_of_100, 100, alpha=0.01, method="wilson")
    return int(binom.ppf(0.001, RUNS, low))


def test_a_threshold_leaves_room_for_chance_and_none_for_a_break():
    assert fewest(100) == 5
    assert fewest(94) == 3
    assert binom.sf(fewest(94) - 1, RUNS, 0.07) < 0.02  # a method broken as the proposed one at 120° is caught


@pytest.mark.parametrize(("plant", "scenario", "controller"), CASES)
def test_methods_settle_in_worse_worlds_as_often_as_they_did(plant, scenario, controller):
    settings = Settings({"random": {"duration": scenario.duration}})
    settled = 0
    for seed in range(700, 700 + RUNS):
        request = RunRequest(plant, controller, "random", scenario.mismatch, seed, latency_periods=scenario.latency)
        settled += not math.isnan(run_experiment(request, settings).row["settling_time_s"])
    assert settled >= fewest(scenario.settled[controller])
