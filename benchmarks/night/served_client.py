"""A client of the served plant in a process of its own, with controllers that fail at a given period."""

from __future__ import annotations

import faulthandler
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import servobench

ON_A_UR = f"{Path(__file__).parents[2] / 'docs' / 'examples' / 'on_a_ur.py'}:UR"


@dataclass(frozen=True)
class SwingConfig:
    """Settings: the fault and when it begins."""

    fault: str = ""
    at: int = 10**9  # period


class Swing(servobench.Controller):
    """Swings every joint, until it fails."""

    def __init__(self, config: SwingConfig, knowledge):
        self.config, self.k = config, 0

    def reset(self, observation, seed):
        self.k = 0

    def step(self, observation, reference):
        self.k += 1
        size = 0.24 if self.config.fault != "beyond limits" else 5.0
        v = size * np.cos(2.0 * observation.time + np.arange(6.0))
        if self.k >= self.config.at:
            if self.config.fault == "hanging controller":
                time.sleep(3600.0)
            if self.config.fault == "exception":
                raise KeyError("of the controller")
            if self.config.fault == "late controller":
                time.sleep(0.7)
            if self.config.fault == "NaN of the controller":
                v = np.full(6, np.nan)
        return servobench.Command(v)


def run(host: str, fault: str, at: int, place: str) -> None:
    """Drive, and write how it ended into a file."""
    faulthandler.enable()
    Path(place).write_text("begun", encoding="utf-8")
    wide = (-2.0, -2.0, -2.0, 2.0, 2.0, 2.0)
    settings = {
        "UR": {"host": host, "patience": 10.0, "box": wide},
        "Swing": {"fault": fault, "at": at},
        "run": {"lost_after": 0.1},
        "target": {"duration": 3.0},
    }
    done = servobench.run(
        Swing, ON_A_UR, task="target", mismatch="none", robot="ur5e", settings=settings
    )
    Path(place).write_text(f"{done.row['status']}: {done.row['reason']}", encoding="utf-8")
