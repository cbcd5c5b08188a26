"""The contract of a plant, checked on a mismatched arm: `check_plant`."""

import contextlib
from collections.abc import Callable
from typing import Final

import numpy as np

from servobench.harness.check.report import Check, CheckFailed, Finding, Report, report
from servobench.harness.config.registry import choose_plant, find_plant, offering
from servobench.harness.run.contract import HeldPlant
from servobench.plant.bench.plant import Plant, PlantEntry, PlantSetup, World
from servobench.plant.contract.signals import Command, Observation
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.ur5 import HOME

PERIOD: Final = 0.05  # [s]
MISMATCH: Final = "moderate+gear_ratio=5%"
STEPS: Final = 6
SHARE: Final = 0.5  # of the joint-speed limits, within which commands are drawn
JACOBIAN_STEPS: Final = 4  # of a slow motion that the true Jacobian has to predict
JACOBIAN_TOLERANCE: Final = 0.05  # of the motion of the feature
MIN_MOTION: Final = 1e-3  # [natural size of the feature], below which the Jacobian cannot be judged


def check_plant(
    plant: str | type[Plant] | type[World] | PlantEntry,
    begin: Callable[[str], None] = lambda _name: None,
    found: Callable[[Finding], None] = lambda _finding: None,
) -> Report:
    """Check a plant against its contract, in this process.

    In a test: `report = servobench.check_plant(ENTRY); assert report.ok, report`.

    Args:
        plant: a name, a place such as "./cell.py:Cell", a class or an entry; see `servobench.run`.
        begin: called with the name of each check before it is carried out.
        found: called with each finding.

    Returns:
        The finding of each check; each failure names the remedy.

    Raises:
        ConfigurationError: there is no such plant, or it cannot be loaded; it is a ValueError.
    """
    with offering():
        entry = plant if isinstance(plant, PlantEntry) else find_plant(choose_plant(plant))
        with contextlib.closing(PlantChecks(entry)) as checks:
            return report(entry.name, checks.checks(), begin, found)


class PlantChecks:
    """The checks of one plant."""

    def __init__(self, entry: PlantEntry) -> None:
        """Prepare the checks."""
        self.entry, self._plant = entry, list[Plant]()

    def close(self) -> None:
        """Close the plant."""
        for plant in self._plant:
            with contextlib.suppress(Exception):  # the check of it has reported it
                plant.close()

    def checks(self) -> list[Check]:
        """Return the checks in their order."""
        run = ("build", "run")
        return [
            Check("build", self.build),
            Check("run", self.run, ("build",)),
            Check("repeatable", self.repeatable, run),
            Check("clipping", self.clipping, run),
            Check("wrong size", self.wrong_size, run),
            Check("negative seed", self.negative_seed, run),
            Check("truth", self.truth, run),
            Check("save", self.save, (*run, "repeatable")),
            Check("close", self.closing, run),
        ]

    def build(self) -> None:
        """It can be built."""
        self._plant.append(self._build())

    def run(self) -> None:
        """Time counts control periods, and observations have the sizes of the spec."""
        plant = self._plant[0]
        spec = plant.spec
        if spec.period != PERIOD:
            raise CheckFailed(f"spec.period must be the period of the setup, {PERIOD:g} s, got {spec.period:g} s")
        for k, observation in enumerate(self._observe(HeldPlant(plant), 0)):
            if abs(observation.time - k * PERIOD) > 1e-12:
                raise CheckFailed(f"after {k} steps time must be {k * PERIOD:g} s, got {observation.time!r}")

    def repeatable(self) -> None:
        """The same seed gives the same bits."""
        first, again = ([_bits(each) for each in self._observe(self._plant[0], 7)] for _ in range(2))
        if first != again:
            raise CheckFailed(
                "reset with the same seed gives another run: draw all randomness from it and keep nothing"
            )

    def clipping(self) -> None:
        """A command beyond the limits is clipped."""
        plant, moves = self._plant[0], []
        for factor in (1.0, 10.0):
            plant.reset(0)
            for _ in range(2):
                observation = plant.step(Command(factor * plant.spec.joint_velocity_limit))
            moves.append(observation.joint_position)
        if not np.allclose(moves[0], moves[1], atol=1e-9):
            raise CheckFailed("a command of ten times the limits moves farther than the limits allow: clip it in step")

    def wrong_size(self) -> None:
        """A command of the wrong size is refused."""
        plant = self._plant[0]
        plant.reset(0)
        with contextlib.suppress(ValueError):
            plant.step(Command(np.zeros(plant.spec.n + 1)))
            raise CheckFailed(f"step must refuse {plant.spec.n + 1} joint velocities by a ValueError")

    def negative_seed(self) -> None:
        """A negative seed is refused."""
        with contextlib.suppress(ValueError):
            self._plant[0].reset(-1)
            raise CheckFailed("reset must refuse the seed -1 by a ValueError")

    def truth(self) -> str | None:
        """The true Jacobian predicts how the true feature moves."""
        plant = self._plant[0]
        start = plant.reset(0).joint_position
        before = HeldPlant(plant).truth()
        for _ in range(JACOBIAN_STEPS):
            observation = plant.step(Command(0.05 * plant.spec.joint_velocity_limit))
        after = plant.truth()
        if before.jacobian is None or after.jacobian is None:
            return "the plant does not know its true Jacobian, so the error of estimates cannot be logged"
        moved = after.feature - before.feature
        wrong = np.linalg.norm(moved - (before.jacobian + after.jacobian) / 2 @ (observation.joint_position - start))
        size = float(np.linalg.norm(moved))
        if size < MIN_MOTION * plant.spec.feature.scale:
            return "the feature hardly moves at the start, so the true Jacobian cannot be judged"
        if wrong > JACOBIAN_TOLERANCE * size:
            raise CheckFailed(f"truth().jacobian misses {wrong / size:.0%} of a small motion of truth().feature")
        return None

    def save(self) -> str | None:
        """A restored state continues with the same bits."""
        plant = self._plant[0]
        plant.reset(5)
        try:
            state = plant.save()
        except ValueError as error:
            return f"it cannot be saved: {error}"
        first = [_bits(plant.step(command)) for command in self._commands(plant)]
        plant.restore(state)
        if first != [_bits(plant.step(command)) for command in self._commands(plant)]:
            raise CheckFailed("after restore the run goes on otherwise: save must return all that step changes")
        return None

    def closing(self) -> None:
        """Closing twice is allowed and closes no other plant."""
        other = self._build()
        other.close()
        other.close()
        self._plant[0].reset(0)

    def _build(self) -> Plant:
        if self.entry.own_robot:
            return self.entry.build(self.entry.config(), PlantSetup(None, None, PERIOD))
        robot = find_robot("ur5")
        model, _ = sample_mismatch(Mismatch.parse(MISMATCH), robot, 1)
        config = self.entry.config() if self.entry.config_for is None else self.entry.config_for(robot)
        return self.entry.build(config, PlantSetup(model, np.array(HOME), PERIOD, robot))

    def _commands(self, plant: Plant) -> list[Command]:
        drawn = np.random.default_rng(2).uniform(-SHARE, SHARE, (STEPS, plant.spec.n))
        return [Command(u) for u in drawn * plant.spec.joint_velocity_limit]

    def _observe(self, plant: Plant, seed: int) -> list[Observation]:
        return [plant.reset(seed), *(plant.step(command) for command in self._commands(plant))]


def _bits(observation: Observation) -> tuple[bytes, bytes, bool]:
    return observation.joint_position.tobytes(), observation.feature.tobytes(), bool(observation.feature_valid)
