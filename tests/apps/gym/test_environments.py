"""Environments of every task and of every plant as Gymnasium checks them, and runs that fail at the start."""

import warnings

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from kit.nightly import some
from kit.plants import NEEDS, NEEDS_MUJOCO
from servobench.harness.config.registry import RENDERED
from servobench.harness.gym.environment import ServoEnv
from servobench.harness.run.starts import PoseTask
from servobench.harness.run.tasks import TASKS

WAYPOINTS = "time_s,x_m,y_m,z_m\n0,0,0,1.25\n1,0.05,0,1.25\n"
FAILS_AT_ONCE = 11  # of twenty seeds of `moderate` the one whose stretched arm touches the table


@pytest.mark.parametrize(
    ("plant", "task"),
    [
        *(
            ("kinematic", task)
            for task in some(TASKS, "circle", "random", "waypoints", "plane_turn")
        ),
        ("fmu", "circle"),
        *(pytest.param(plant, "exp1", marks=NEEDS[plant]) for plant in RENDERED),
    ],
)
def test_the_checker_finds_nothing_to_warn_of(plant, task, tmp_path):
    settings = {plant: {"scenery": False}} if plant in RENDERED else {}
    if task == "waypoints":
        (tmp_path / "points.csv").write_text(WAYPOINTS)
        settings |= {task: {"file": str(tmp_path / "points.csv")}}
    poses = isinstance(TASKS[task].default, PoseTask)
    env = ServoEnv(plant, task, sensing="plate" if poses else "position", settings=settings)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)
    env.close()


@NEEDS_MUJOCO
def test_a_failed_start_terminates_with_the_first_step_and_the_next_episode_runs():
    env = ServoEnv("mujoco", "singular_start")
    seen, info = env.reset(seed=FAILS_AT_ONCE)
    assert seen in env.observation_space
    assert info["reason"].endswith("meets table at 0.000 s")
    assert not env.observation.valid.any()
    _, reward, terminated, truncated, after = env.step(np.zeros(6))
    assert (terminated, truncated, after["reason"]) == (True, False, info["reason"])
    assert reward == pytest.approx(-after["error"] * 10.0)
    _, info = env.reset(seed=0)
    assert "reason" not in info
    assert env.observation.valid.all()
    env.close()
