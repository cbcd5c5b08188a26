"""The contract of a plant, checked on a mismatched arm: `check_plant`."""

import contextlib

import numpy as np

from servobench.harness.apps.check.report import (
    Begin,
    Check,
    CheckFailed,
    Hear,
    Report,
    naming,
    report,
)
from servobench.harness.config.registry import choose_plant, find_plant, offering
from servobench.harness.run.contract import HeldPlant
from servobench.plant.bench.plant import Plant, PlantEntry, PlantSetup, World
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Command, Observation, PlantSpec, Truth
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch

PERIOD = 0.05  # [s]
OTHER = "panda", 0.1  # a second robot, and its period [s]
MISMATCH = "moderate+gear_ratio=5%"
STEPS = 6
SHARE = 0.5  # share of the joint-speed limits within which commands are drawn
# [rad] by which the first and the last joint are moved, those between by lengths between
MOTION = (0.05, 0.1)
# [s] Length of such a motion and of the rest after it, which is longer than usual delays.
MOTION_TIME, REST_TIME = (0.5, 1.0)
TURN = (
    0.2  # [rad] of the first joint at the start, so that no feature of the two robots is near zero
)
START_TOLERANCE = 0.01  # [rad]
FOLLOWING = (0.6, 1.6)  # a motion over the commanded one
SAMPLES = 5  # last features at rest, whose median has little noise and no outliers
FEATURE_TOLERANCE = 0.05  # share of the feature, or of its natural size if that is larger
NOMINAL_SHARE = (
    0.2  # of the distance from the true model, within which a plant is that of the nominal model
)
CLIPPED_STEPS = 4  # more than a usual command delay
JACOBIAN_STEPS = 4  # steps of a slow motion that the true Jacobian has to predict
JACOBIAN_TOLERANCE = 0.05  # share of the motion of the feature
MIN_MOTION = 1e-3  # [natural size of the feature], below which the Jacobian cannot be judged


def check_plant(
    plant: str | type[Plant] | type[World] | PlantEntry,
    begin: Begin = lambda _name: None,
    found: Hear = lambda _finding: None,
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
        self.entry, self._plants = entry, list[tuple[Plant, PlantSetup]]()
        self._at_rest: list[
            tuple[FloatArray, FloatArray, Truth]
        ] = []  # results of `_drive` for each plant
        self._second = f"a period of {1e3 * OTHER[1]:g} ms" + (
            "" if entry.own_robot else f" and the robot {OTHER[0]}"
        )

    @property
    def _plant(self) -> Plant:
        return self._plants[0][0]

    def close(self) -> None:
        """Close the plant."""
        for plant, _ in self._plants:
            with contextlib.suppress(Exception):  # the check of it has reported it
                plant.close()

    def checks(self) -> list[Check]:
        """Return the checks in their order."""
        run = ("build", "run")
        middle = (
            self.repeatable,
            self.clipping,
            self.wrong_size,
            self.negative_seed,
            self.truth,
        )
        return [
            Check.of(self.build),
            Check.of(self.run, "build"),
            *(Check.of(each, *run) for each in middle),
            Check.of(self.save, *run, "repeatable"),
            Check("close", self.closing, run),
        ]

    def build(self) -> str | None:
        """It can be built, with a second robot and control period, too."""
        self._plants.append(self._build())
        try:
            self._plants.append(self._build(*OTHER))
        except Exception as error:  # noqa: BLE001 - of the user
            return f"not checked: {error}; this happens with {self._second}"
        return None

    def run(self) -> None:
        """Time counts control periods, observations have the sizes of the spec, and joints follow their commands."""
        for (plant, setup), what in zip(self._plants, ("", self._second), strict=False):
            with naming(what):
                self._at_rest.append(_drive(HeldPlant(plant), setup))

    def repeatable(self) -> None:
        """The same seed gives the same bits."""
        plant, commands = self._plant, self._commands()
        first, again = (
            [_bits(plant.reset(7)), *map(_bits, map(plant.step, commands))] for _ in range(2)
        )
        if first != again:
            raise CheckFailed(
                "reset with the same seed gives another run: draw all randomness from it and keep nothing"
            )

    def clipping(self) -> None:
        """A command beyond the limits is clipped."""
        plant, moves = self._plant, []
        for factor in (1.0, 10.0):
            plant.reset(0)
            for _ in range(CLIPPED_STEPS):
                observation = plant.step(Command(factor * plant.spec.joint_velocity_limit))
            moves.append(observation.joint_position)
        if not np.allclose(moves[0], moves[1], atol=1e-9):
            raise CheckFailed(
                "a command of ten times the limits moves farther than the limits allow: clip it in step"
            )

    def wrong_size(self) -> None:
        """A command of the wrong size is refused."""
        plant = self._plant
        plant.reset(0)
        with contextlib.suppress(ValueError):
            plant.step(Command(np.zeros(plant.spec.n + 1)))
            raise CheckFailed(
                f"step must refuse {plant.spec.n + 1} joint velocities by a ValueError"
            )

    def negative_seed(self) -> None:
        """A negative seed is refused."""
        with contextlib.suppress(ValueError):
            self._plant.reset(-1)
            raise CheckFailed("reset must refuse the seed -1 by a ValueError")

    def truth(self) -> str | None:
        """The true feature is what is measured and what the model says, and its Jacobian predicts how it moves."""
        for (plant, setup), at_rest, what in zip(
            self._plants, self._at_rest, ("", self._second), strict=False
        ):
            with naming(what):
                _compare(plant.spec, setup, *at_rest)
        plant = self._plant
        start = plant.reset(0).joint_position
        before = HeldPlant(plant).truth()
        for _ in range(JACOBIAN_STEPS):
            observation = plant.step(Command(0.05 * plant.spec.joint_velocity_limit))
        after = plant.truth()
        if before.jacobian is None or after.jacobian is None:
            return "the plant does not know its true Jacobian, so the error of estimates cannot be logged"
        moved = after.feature - before.feature
        wrong = np.linalg.norm(
            moved - (before.jacobian + after.jacobian) / 2 @ (observation.joint_position - start)
        )
        size = float(np.linalg.norm(moved))
        if size < MIN_MOTION * plant.spec.feature.scale:
            return "the feature hardly moves at the start, so the true Jacobian cannot be judged"
        if not wrong <= JACOBIAN_TOLERANCE * size:
            raise CheckFailed(
                f"truth().jacobian misses {wrong / size:.0%} of a small motion of truth().feature"
            )
        return None

    def save(self) -> str | None:
        """A restored state continues with the same bits."""
        plant, commands = self._plant, self._commands()
        plant.reset(5)
        try:
            state = plant.save()
        except ValueError as error:
            return f"it cannot be saved: {error}"
        first = [_bits(plant.step(command)) for command in commands]
        plant.restore(state)
        if first != [_bits(plant.step(command)) for command in commands]:
            raise CheckFailed(
                "after restore the run goes on otherwise: save must return all that step changes"
            )
        return None

    def closing(self) -> None:
        """Closing twice is allowed and closes no other plant."""
        other, _ = self._build()
        other.close()
        other.close()
        self._plant.reset(0)

    def _build(self, name: str = "ur5", period: float = PERIOD) -> tuple[Plant, PlantSetup]:
        if self.entry.own_robot:
            setup = PlantSetup(None, None, period)
            return self.entry.build(self.entry.config(), setup), setup
        robot = find_robot(name)
        model, _ = sample_mismatch(Mismatch.parse(MISMATCH), robot, 1)
        start = np.array([TURN, *np.zeros(robot.n - 1)]) + robot.workspace.home
        setup = PlantSetup(model, start, period, robot)
        return self.entry.build(self.entry.settings_for(robot), setup), setup

    def _commands(self) -> list[Command]:
        spec = self._plant.spec
        drawn = np.random.default_rng(2).uniform(-SHARE, SHARE, (STEPS, spec.n))
        return [Command(u) for u in drawn * spec.joint_velocity_limit]


def _bits(observation: Observation) -> tuple[bytes, bytes, bytes, bool]:
    return (
        observation.joint_position.tobytes(),
        observation.feature.tobytes(),
        np.float64(observation.capture_time).tobytes(),
        bool(observation.feature_valid),
    )


def _drive(plant: Plant, setup: PlantSetup) -> tuple[FloatArray, FloatArray, Truth]:
    """Move all joints, and return joint positions, measured feature and truth at rest after it."""
    spec, period, start = plant.spec, setup.period, setup.start
    if not np.isclose(spec.period, period, rtol=1e-9):
        raise CheckFailed(
            f"spec.period must be the period of the setup, {period:g} s, got {spec.period:g} s"
        )
    if start is not None and spec.n != len(start):
        raise CheckFailed(
            f"spec has {spec.n} joints and the start {len(start)}: take their number from setup.robot()"
        )
    if setup.model is not None and len(setup.model.channel.names) != spec.m:
        has, camera = (
            f"{', '.join(each.names)} in {each.unit}"
            for each in (spec.feature, setup.model.channel)
        )
        raise CheckFailed(
            f"spec has the features {has}, and the camera of the setup has {camera}, of which controllers get "
            "the Jacobian: measure these, or set own_robot = True and bring arm and start"
        )
    first = plant.reset(0).joint_position
    if start is not None and not np.abs(first - start).max() <= START_TOLERANCE:
        raise CheckFailed(
            f"reset must begin at setup.start, {start.round(3).tolist()} rad, got {first.tolist()}"
        )
    inwards = np.where(first < (spec.joint_lower + spec.joint_upper) / 2.0, 1.0, -1.0)
    room = np.minimum(MOTION_TIME * spec.joint_velocity_limit, spec.joint_upper - spec.joint_lower)
    wanted = inwards * np.minimum(np.linspace(*MOTION, spec.n), SHARE * room)
    moving, resting = round(MOTION_TIME / period), round(REST_TIME / period)
    commands = [Command(wanted / MOTION_TIME)] * moving + [Command(np.zeros(spec.n))] * resting
    seen = [plant.reset(0), *map(plant.step, commands)]
    for k, observation in enumerate(seen):
        if abs(observation.time - k * period) > 1e-12:
            raise CheckFailed(
                f"after {k} steps time must be {k * period:g} s, got {observation.time!r}"
            )
    joints = seen[-1].joint_position
    least, most = FOLLOWING
    for name, moved, asked in zip(spec.joint_names, joints - first, wanted, strict=True):
        if not least <= moved / asked <= most:
            raise CheckFailed(
                f"{name} moves by {moved:.3g} rad under commands for {asked:.3g} rad: commands are in rad/s, in the "
                f"order of spec.joint_names, and held for a period, {period:g} s; positions are in rad. Friction, slow "
                "drives and delays beyond a second are taken for such mistakes, too"
            )
    return joints, np.median([each.feature for each in seen[-SAMPLES:]], axis=0), plant.truth()


def _compare(
    spec: PlantSpec, setup: PlantSetup, joints: FloatArray, seen: FloatArray, truth: Truth
) -> None:
    """Hold the true feature at rest against the measured one and that of the robot that the plant was given."""
    unit, true = spec.feature_unit, truth.feature
    tolerance = FEATURE_TOLERANCE * max(spec.feature.scale, float(np.linalg.norm(true)))
    said = f"at rest truth().feature is {true.round(4).tolist()} {unit}"
    if not np.linalg.norm(seen - true) <= tolerance:
        remedy = "both are of one camera, in one order and unit"
        raise CheckFailed(
            f"{said}, and the measured feature {seen.round(4).tolist()} {unit}; {remedy}"
        )
    if setup.model is None or setup.nominal is None:
        return
    model, nominal = (each.feature(joints) for each in (setup.model, setup.nominal.nominal))
    wrong = np.linalg.norm(true - model)
    if wrong > tolerance or np.linalg.norm(true - nominal) < NOMINAL_SHARE * wrong:
        remedy = (
            "the plant has to be the robot and camera that setup.robot() returns, mismatch included"
        )
        raise CheckFailed(
            f"{said}, and that of setup.model {model.round(4).tolist()} {unit}; {remedy}"
        )
