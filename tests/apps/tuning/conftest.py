"""Tuning in a few seconds."""

import pytest

from servobench.harness.apps.tuning import objective


@pytest.fixture
def short_runs(monkeypatch):
    """Let the runs of tuning end early, and the second set have no more of them than a trial."""
    short = {
        "random": {"duration": 0.5},
        "circle": {"lap_time": 1.0},
        "lemniscate": {"lap_time": 1.0},
    }
    monkeypatch.setattr(
        objective, "TASKS", {name: task | short[name] for name, task in objective.TASKS.items()}
    )
    monkeypatch.setattr(objective, "SECOND_FACTOR", 1)  # instead of three times the runs of a trial
