"""Plants in any order of reset, step, save, restore, keep and close: a run is where it is.

A run of a seed has one observation after k periods, however it got there: the machine remembers the bits of that and
demands them again.
"""

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
    run_state_machine_as_test,
)

from kit.plants import configure, mismatched
from servobench.harness.config.registry import find_plant
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract import lanes
from servobench.plant.contract.signals import Command
from servobench.plant.robot.ur5 import HOME

LANES = 3
MODELS = [mismatched("severe+gear_ratio=5%", seed) for seed in range(LANES)]
STARTS = np.array(HOME) + np.random.default_rng(0).uniform(-0.3, 0.3, (LANES, 6))
MAX_PERIODS = 200
COMMANDS = np.random.default_rng(1).uniform(-1.5, 1.5, (MAX_PERIODS, LANES, 6))
SENSING = {
    "command_delay": 0.13,
    "latency": 0.07,
    "frame_period": 0.03,
    "drop_probability": 0.3,
    "outliers": 0.2,
}
FEW = settings(max_examples=4, stateful_step_count=25, deadline=None)


def bits(*arrays) -> bytes:
    return b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)


class PlantLife(RuleBasedStateMachine):
    """Runs of one plant side by side, of which some are dropped."""

    name: str
    seen: dict[tuple[int, int, int], bytes]  # by lane, seed and period, over all examples

    @initialize()
    def build(self) -> None:
        self.lanes, self.saved, self.k, self.seed = np.arange(LANES), [], 0, 0
        entry = find_plant(self.name)
        setup = PlantSetup(lanes.stack(MODELS), STARTS, 0.05)
        self.plant = entry.build(configure(entry.config, **SENSING), setup)
        self.reset(0)

    @rule(seed=st.integers(0, 1))
    def reset(self, seed: int) -> None:
        self.seed, self.k = seed, 0
        self.look(self.plant.reset([10 * seed + lane for lane in self.lanes.tolist()]))

    @rule(count=st.integers(1, 5))
    def step(self, count: int) -> None:
        for _ in range(min(count, MAX_PERIODS - self.k)):
            self.look(self.plant.step(Command(COMMANDS[self.k, self.lanes])), self.k + 1)

    def look(self, observation, k: int = 0) -> None:
        self.k = k
        truth = self.plant.truth()
        for place, lane in enumerate(self.lanes.tolist()):
            shown = bits(
                observation.joint_position[place], observation.feature[place], truth.feature[place]
            )
            assert self.seen.setdefault((lane, self.seed, k), shown) == shown

    @rule()
    def save(self) -> None:
        self.saved.append((self.plant.save(), self.k, self.seed))

    @precondition(lambda self: self.saved)
    @rule(data=st.data())
    def restore(self, data) -> None:
        state, self.k, self.seed = data.draw(st.sampled_from(self.saved))
        self.plant.restore(state)

    @precondition(lambda self: len(self.lanes) > 1)
    @rule(data=st.data())
    def keep(self, data) -> None:
        chosen = np.array(
            sorted(data.draw(st.sets(st.integers(0, len(self.lanes) - 1), min_size=1)))
        )
        self.plant.keep(chosen)
        # States of more runs are no states of these
        self.lanes, self.saved = (self.lanes[chosen], [])

    @rule()
    def close_and_build(self) -> None:
        self.plant.close()
        self.plant.close()
        self.build()

    def teardown(self) -> None:
        if hasattr(self, "plant"):
            self.plant.close()


@pytest.mark.parametrize("name", ["kinematic", "fmu"])
def test_runs_of_a_plant_are_where_they_are(name):
    machine = type("PlantLifeOf" + name, (PlantLife,), {"name": name, "seen": {}})
    run_state_machine_as_test(machine, settings=FEW)
    assert machine.seen
