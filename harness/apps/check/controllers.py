"""The contract of a controller, checked on made-up arms: `check_controller`."""

import contextlib
import io
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any, cast

import numpy as np

from servobench.controllers.aided import AidedController, with_aids
from servobench.controllers.aids import EQUIPPED, describe_aids
from servobench.controllers.controller import Controller, ControllerEntry
from servobench.controllers.servo import Servo, ServoState
from servobench.harness.apps.check.report import (
    Begin,
    Check,
    CheckFailed,
    Hear,
    Report,
    at,
    is_refusal,
    naming,
    report,
)
from servobench.harness.apps.check.rig import (
    PERIOD,
    PREVIEW,
    Driver,
    Rig,
    Shared,
    attributes,
    differing,
    watching_draws,
)
from servobench.harness.config.registry import choose_controller, find_controller, offering
from servobench.harness.config.settings import default_config, flatten
from servobench.harness.config.source import describe_at
from servobench.harness.run.contract import HeldController
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import Observation, trusted_observation

JOINTS, FEATURES = 6, 3
OTHER_SIZES = (7, 2)
STEPS = 24
STEPS_IF_SLOW = 4
SLOW = 0.02  # [s] a step, beyond which runs are short
LIMIT_TOLERANCE = 1e-9
APPROACH = 3.0  # [s] after which the error should have become smaller
OTHER_PERIOD = 0.02  # [s]
LOSSES = (range(1, 4), range(3), range(10, 20))  # periods in which the feature is lost
ROUGH = (1e-3, 1e3, 1e6)  # scales of features
ONE_BY_ONE = (
    "its runs go one by one; those of a Law and an Estimator in a Servo may advance together"
)
IN_LANES = "its parts must be pure and take arrays with leading axes, see servobench/plant/contract/lanes.py"
SEED_REMEDY = "make one in reset: self.rng = np.random.default_rng(seed)"


def check_controller(
    controller: str | type[Controller] | Controller | ControllerEntry,
    begin: Begin = lambda _name: None,
    found: Hear = lambda _finding: None,
) -> Report:
    """Check a controller against its contract, in this process.

    In a test: `report = servobench.check_controller(Mine); assert report.ok, report`.

    Args:
        controller: a name, a place such as "./mine.py:Mine", a class, an object or an entry; see `servobench.run`.
        begin: called with the name of each check before it is carried out.
        found: called with each finding.

    Returns:
        The finding of each check; each failure names the remedy.

    Raises:
        ConfigurationError: the controller cannot be loaded; it is a ValueError.
    """
    with offering():
        name = choose_controller(controller)
        return report(name, ControllerChecks(find_controller(name)).checks(), begin, found)


class ControllerChecks:
    """The checks of one controller."""

    def __init__(self, entry: ControllerEntry) -> None:
        """Prepare the checks."""
        self.entry, self.steps = entry, STEPS
        self._times: list[float] = []
        self._printed = ""

    def checks(self) -> list[Check]:
        """Return the checks in their order."""
        alike = ("command", "repeatable")
        first = (self.limits, self.diagnostics, self.repeatable)
        last = (
            self.at_target,
            self.lost_feature,
            self.large_numbers,
            self.other_sizes,
            self.no_preview,
            self.approach,
            self.time,
            self.output,
            self.aids,
            self.side_by_side,
        )
        return [
            Check.of(self.constructor),
            Check.of(self.command, "constructor"),
            *(Check.of(each, "command") for each in first),
            Check.of(self.reset, *alike),
            Check.of(self.separate, *alike),
            Check.of(self.save, *alike, "separate"),
            *(Check.of(each, "command") for each in last),
        ]

    def constructor(self) -> None:
        """It can be built."""
        controller, _ = self._build()
        own = controller.law.own if isinstance(controller, AidedController) else controller
        self._shared = Shared(type(own))

    def command(self) -> None:
        """Each step returns n finite numbers."""
        driver, printed = self._driver(), io.StringIO()
        with contextlib.redirect_stdout(printed):
            driver.begin().run(STEPS_IF_SLOW)
            if np.median(driver.times) > SLOW:
                self.steps = STEPS_IF_SLOW
            driver.run(self.steps - STEPS_IF_SLOW)
        if driver.rig.farthest > 2.0 * driver.rig.spec.joint_upper.max():
            raise CheckFailed(
                f"{at(driver.controller.step)}: nominal_jacobian is called with {driver.rig.farthest:.3g}; joint "
                "positions are in rad"
            )
        self._times, self._printed = driver.times, printed.getvalue()

    def limits(self) -> None:
        """No joint is commanded faster than its limit."""
        driver = self._driver()
        ratio = np.max(
            np.abs(driver.begin().run(self.steps)) / driver.rig.spec.joint_velocity_limit
        )
        if ratio > 1.0 + LIMIT_TOLERANCE:
            raise CheckFailed(
                f"{at(driver.controller.step)}: a command is {ratio:.3g} times the joint-speed limit; shorten it: "
                "u / max(1.0, np.max(np.abs(u) / knowledge.spec.joint_velocity_limit))"
            )

    def diagnostics(self) -> None:
        """The log gets named numbers and a Jacobian."""
        driver = self._driver().begin()
        driver.run(1)
        held = HeldController(driver.controller, driver.rig.spec)
        held.diagnostics()
        J = held.estimated_jacobian()
        if J is not None and not np.isfinite(J).all():
            place = at(driver.controller.estimated_jacobian)
            raise CheckFailed(f"{place}: estimated_jacobian must return finite numbers or None")

    def repeatable(self) -> None:
        """The same seed gives the same commands."""
        with watching_draws() as draws:
            first, second = (self._driver().begin().run(self.steps) for _ in range(2))
        if np.array_equal(first, second):
            return
        if draws:
            raise CheckFailed(f"{draws[0]}; {SEED_REMEDY}")
        raise CheckFailed(
            "two new controllers command differently with the same seed: it depends on the clock, or on a variable "
            "of the module or the class; keep all state in attributes that reset sets"
        )

    def reset(self) -> None:
        """A run leaves nothing behind for the next."""
        fresh, used = self._driver().begin(), self._driver(seed=1)
        new = attributes(fresh.controller)
        first = fresh.run(self.steps)
        used.begin().run(self.steps)
        used.seed = 0
        kept = differing(new, attributes(used.begin().controller))
        again = used.run(self.steps)
        if not np.array_equal(first, again):
            place, name = (
                at(used.controller.reset),
                f" in self.{', self.'.join(kept)}" if kept else "",
            )
            raise CheckFailed(
                f"{place}: reset keeps values of an earlier run{name}; set it anew there"
            )

    def separate(self) -> None:
        """Two controllers in one process do not disturb each other."""
        alone = []
        for seed in range(2):
            self._shared.restore()
            alone.append(self._driver(seed).begin().run(self.steps))
        drivers = [self._driver(seed).begin() for seed in range(2)]
        together = [[each.run(1)[0] for each in drivers] for _ in range(self.steps)]
        changed = ", ".join(self._shared.restore())
        if not np.array_equal(np.stack(alone, axis=1), together):
            raise CheckFailed(
                "two controllers in one process disturb each other through a variable of the module or the class"
                f"{changed and f', {changed}'}; keep all state in attributes that reset sets"
            )

    def save(self) -> str | None:
        """A saved state continues as the run did."""
        driver = self._driver().begin()
        driver.run(2)
        try:
            saved = driver.controller.save()
        except Exception as error:  # noqa: BLE001 - of the user's attributes
            return (
                f"it cannot be saved and continued in several ways: {type(error).__name__}: {error}"
            )
        plant, rollout = driver.rig.save(), copy(driver.rollout)
        first = driver.run(2)
        driver.controller.restore(saved)
        driver.rig.restore(plant)
        driver.rollout = rollout
        if not np.array_equal(first, driver.run(2)):
            raise CheckFailed(
                "after restore it commands differently; save and restore must cover all that step changes"
            )
        return None

    def at_target(self) -> None:
        """At rest at the target, where the error and all motion are zero, commands are finite."""
        self._driver(at_goal=True).begin().run(self.steps)

    def lost_feature(self) -> None:
        """Commands are finite while the feature is lost, also from the start."""
        for lost in LOSSES:
            self._driver(lost=lost).begin().run(min(self.steps, lost.stop + 3))

    def large_numbers(self) -> None:
        """Commands are finite for small and large features."""
        for scale in ROUGH:
            self._driver(scale=scale).begin().run(min(self.steps, 6))

    def other_sizes(self) -> str | None:
        """It takes its sizes from `knowledge.spec`."""
        n, m = OTHER_SIZES
        what = f"{n} joints and {m} features"
        with naming(f"{what}: take n and m from knowledge.spec"):
            try:
                knowledge = Rig(n, m).knowledge(truth=self.entry.needs_truth)
                controller = self.entry.build(default_config(self.entry), knowledge)
            except ValueError as error:
                if is_refusal(error):
                    return f"it refuses {what}: {error}"
                raise
            Driver(controller, Rig(n, m)).begin().run(min(self.steps, 6))
        return None

    def no_preview(self) -> str | None:
        """It runs with a reference of one row."""
        try:
            self._driver(preview=0).begin().run(min(self.steps, 6))
        except (IndexError, ValueError, ConfigurationError) as error:
            return f"it needs a preview of the reference, run.preview_time: {' '.join(str(error).split())}"
        return None

    def approach(self) -> str | None:
        """It brings the feature nearer to its target."""
        for period in (PERIOD, OTHER_PERIOD):
            try:
                driver = self._driver(
                    period=period, preview=round(PREVIEW * PERIOD / period)
                ).begin()
                before = driver.rig.error()
                driver.run(1)
            except ValueError as error:
                if period == PERIOD or not is_refusal(error):
                    raise
                return f"it does not run with a period of {1e3 * period:g} ms: {' '.join(str(error).split())}"
            with naming(
                ""
                if period == PERIOD
                else f"a period of {1e3 * period:g} ms, knowledge.spec.period"
            ):
                driver.run(round(APPROACH / period) - 1 if self.steps == STEPS else self.steps)
            after, seconds = driver.rig.error(), driver.rollout.k * period
            if after > before:
                hint = (
                    "; is the error reference[0] - observation.feature?"
                    if after > 1.5 * before
                    else ""
                )
                return (
                    f"on a made-up arm the error grows from {before:.2g} to {after:.2g} m in {seconds:g} s with a "
                    f"period of {1e3 * period:g} ms{hint}"
                )
        return None

    def time(self) -> str | None:
        """A step fits into a control period."""
        # Beside other work a machine delays most steps, but not all of them.
        undisturbed = float(np.quantile(self._times, 0.1))
        longest = max(self._times[1:])
        period = f"the period of {1e3 * PERIOD:g} ms"
        if undisturbed > PERIOD:
            raise CheckFailed(
                f"a step takes {1e3 * undisturbed:.0f} ms, longer than {period}: "
                "a robot would get its commands too late; move work to the constructor, or choose a longer run.period"
            )
        if longest > PERIOD:
            return f"a step took {1e3 * longest:.0f} ms, longer than {period}"
        return None

    def output(self) -> str | None:
        """It prints nothing."""
        lines = len(self._printed.splitlines())
        if not lines:
            return None
        return f"it prints {lines} lines in {self.steps} steps; numbers for the log are returned by diagnostics"

    def aids(self) -> str | None:
        """It has the aids of the others, or could have them."""
        entry, values = self.entry, flatten(default_config(self.entry))
        words = describe_aids(values)
        if not words.startswith("without"):
            if words == "with all aids":
                return None
            return words
        if "aids.delay" in values or not isinstance(getattr(entry.build, "make", None), type):
            return (
                f"{words}; its settings `aids`, or the argument `aids` of its Servo, switch them on"
            )
        try:
            ControllerChecks(with_aids(entry, EQUIPPED)).command()
        except Exception as error:  # noqa: BLE001 - of the user
            return f"{words}, and it cannot have them as it is: {describe_at(error)}; reference has row 0 alone there"
        return f"{words}; `aids = servobench.EQUIPPED` in the class gives it those of the others"

    def side_by_side(self) -> str | None:
        """Runs that advance together have the commands of each alone, to the bit."""
        if not self.entry.side_by_side:
            return ONE_BY_ONE
        servo, state = getattr(self._build()[0], "servo", None), cast(ServoState | None, None)
        if not isinstance(servo, Servo):
            raise CheckFailed(
                "its entry says side_by_side=True, so that build must return a ServoController"
            )
        alone = [self._driver(seed, lost=range(2, 2 + 2 * seed)).begin() for seed in range(2)]
        for _ in range(self.steps):
            given = [(each.rollout.observation, each.rollout.reference) for each in alone]
            seen, reference = (
                _together([one for one, _ in given]),
                np.stack([one for _, one in given]),
            )
            state, u = servo.step(state or servo.start(seen), seen, reference)
            if not np.array_equal(u, np.concatenate([each.run(1) for each in alone])):
                raise CheckFailed(
                    f"two runs that advance together have other commands than each alone; {IN_LANES}"
                )
        return None

    def _build(self, period: float = PERIOD, **conditions: Any) -> tuple[Controller, Rig]:  # noqa: ANN401 - `Conditions`
        rig = Rig(JOINTS, FEATURES, period)
        rig.conditions = replace(rig.conditions, **conditions)
        knowledge = rig.knowledge(truth=self.entry.needs_truth)
        return self.entry.build(default_config(self.entry), knowledge), rig

    def _driver(self, seed: int = 0, period: float = PERIOD, **conditions: Any) -> Driver:  # noqa: ANN401 - as above
        return Driver(*self._build(period, **conditions), seed)


def _together(seen: Sequence[Observation]) -> Observation:
    names = "joint_position", "feature", "feature_valid", "valid", "capture_time"
    return trusted_observation(
        seen[0].time, *(np.stack([getattr(each, name) for each in seen]) for name in names)
    )
