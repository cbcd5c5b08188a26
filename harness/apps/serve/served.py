"""A plant that commands from elsewhere move, for every protocol: steps, clock, and the velocities that it follows."""

from collections.abc import Sequence
from dataclasses import replace
from typing import final

import numpy as np

from servobench.harness.apps.serve.wire import Say
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.feasibility import check_possible
from servobench.harness.run.loop import Rollout
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import check_settings, resolve
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_seed
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.signals import Command

RATE = 500.0  # [Hz] rate of the controller of an e-Series robot
BACKLOG = 0.1  # [s] behind the wall clock from which the backlog is dropped
WATCHDOG = 2.0  # [frames] without a command after which the arm stands


@final
class Served:
    """The plant's side of a run whose commands come from elsewhere.

    Attributes:
        plant: the plant.
        rollout: its run.
        frames: periods of the plant from one frame to the next.
    """

    def __init__(
        self,
        request: RunRequest,
        settings: Settings,
        say: Say,
        *,
        lockstep: bool,
        stamps: bool = False,
    ) -> None:
        """Begin a run. In real time its plant advances at the rate of a UR, and frames come once a control period.

        The controller of the request is not asked; `say` prints a line; with `stamps` frames carry their exposure.

        Raises:
            ConfigurationError: a name or setting that cannot be used.
            RunFault: the run cannot begin.
        """
        check_settings(settings, [request.plant, request.task])
        resolved = resolve(request, settings)
        sensing = getattr(resolved.plant, "sensing", None)
        frames = resolved.run.period
        if isinstance(sensing, SensingConfig):
            sensing = replace(sensing, stamps=stamps or sensing.stamps)
            if not lockstep:
                frames = sensing.frame_period or frames
                sensing = replace(sensing, frame_period=frames)
            resolved = replace(resolved, plant=replace(resolved.plant, sensing=sensing))
        if not lockstep:
            resolved = replace(resolved, run=replace(resolved.run, period=1.0 / RATE))
        experiment = build(resolved)
        check_possible(resolved, experiment.drawn, experiment.plant.spec)
        self.plant = experiment.plant
        first = self.plant.reset(named_seed(request.seed, "plant"))
        self.rollout = Rollout(self.plant, first, experiment.desired(), experiment.loop)
        self.frames = max(1, round(frames / self.plant.spec.period))
        self._say = say
        self._lockstep = lockstep
        self._untold = 0

    def advance(self, velocity: FloatArray) -> bool:
        """Hold joint velocities, (n,) rad/s, for a period; return whether a frame is due, found or missed.

        Raises:
            RunFault: the plant cannot go on.
        """
        self.rollout.advance(Command(velocity))
        self._untold += 1
        missed = self._untold > self.frames
        due = self._lockstep or missed or bool(self.rollout.observation.valid.any())
        if due:
            self._untold = 0
        return due

    def next_period(self, due: float, now: float) -> float:
        """Return when the next period of real time begins, after the one of `due` [s]; a backlog is dropped."""
        due += self.plant.spec.period
        late = now - due
        if late <= BACKLOG:
            return due
        self._say(f"the plant is slower than the wall clock: {1e3 * late:.0f} ms are left out")
        return now


@final
class Velocities:
    """The joint velocities that the arm follows: those that came last, and none after silence.

    Attributes:
        came: whether some came since this was last set to False.
    """

    def __init__(self, joints: int, patience: float, say: Say) -> None:
        """Take the number of joints, the longest silence [s], and a printer of lines."""
        self.came = False
        self._rest = np.zeros(joints)
        self._last = self._rest
        self._patience = patience
        self._until = 0.0
        self._say = say
        self._said = ""

    def take(self, numbers: Sequence[float], now: float) -> None:
        """Take joint velocities [rad/s] at a time [s]; where they are no such, the arm stands, with a line."""
        given = np.asarray(numbers, np.float64)
        if given.shape != self._rest.shape or not np.isfinite(given).all():
            self.stop(f"a command must hold {self._rest.size} finite numbers, got {given.tolist()}")
            return
        self.came = True
        self._last = given
        self._until = now + self._patience
        self._said = ""

    def at(self, now: float) -> FloatArray:
        """Return the velocities at a time [s], (n,) rad/s."""
        if now > self._until and self._last.any():
            self.stop(f"no command for {1e3 * self._patience:.3g} ms")
        return self._last

    def stop(self, why: str) -> None:
        """Let the arm stand until the next command, in place of one."""
        self.came = True
        self._last = self._rest
        if why != self._said:
            self._say(f"the arm stands: {why}")
        self._said = why
