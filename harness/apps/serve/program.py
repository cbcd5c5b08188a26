"""The control program of `ur-rtde` as its script carries it out: commands in registers, motions, watchdog, stops.

A command that is not served is refused by name: the program ends, as on a robot after an error in its script.
"""

import hashlib
import math
import re
import time
from collections.abc import Callable, Iterator
from itertools import count
from typing import TypeAlias, final

import numpy as np

from servobench.harness.apps.serve.wire import CONTROLLER, Say
from servobench.plant.bench.plant import TrueModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.files import Record
from servobench.plant.contract.signals import PlantSpec

# The date that a control script has in it
STAMP = re.compile(rb"Script Loaded \(([\w.: -]{1,40})\)")
# Which no line of HTTP has, with any method
SCRIPT_START = re.compile(rb"def [A-Za-z_]\w*\(")
COMMAND = "input_int_register_0"
COMMANDS = CONTROLLER["commands"]["names"].split()
WITHOUT_ANSWER = frozenset(CONTROLLER["commands"]["without_answer"])
Motion: TypeAlias = Iterator[FloatArray]  # joint velocities [rad/s] of each period
STOP_DECELERATION = 10.0  # [rad/s²] deceleration of an arm whose program ended
LONGEST_MOVE = 300.0  # [s] with its settling
POSITION_GAIN = 5.0  # [1/s] gain of moveJ with which such a drive does not swing
POSITION_TOLERANCE = 1e-3  # [rad] within which moveJ has arrived
UNLOCK_AFTER = (
    5.0  # [s] that a protective stop lasts at least, by UR's page on the dashboard server
)


def script_version(script: bytes) -> tuple[str, bool]:
    """Return words for the version of `ur-rtde` that sends a control script, and whether this one is served."""
    digest = hashlib.sha256(script).hexdigest()
    known = CONTROLLER["scripts"]
    if digest in known:
        newest = next(iter(known))
        return f"ur-rtde {known[digest]}", digest == newest
    stamp = STAMP.search(script)
    date = stamp[1].decode() if stamp else "nowhere"
    return f"{len(script)} bytes, dated {date}, SHA-256 {digest[:12]}…", False


def begins_script(text: bytes) -> bool:
    """Return whether bytes are the beginning of a script, also while its first line has not come whole."""
    if b"\n" in text:
        return SCRIPT_START.match(text) is not None
    return b"def ".startswith(text[:4])


def profile(
    distance: float, speed: float, acceleration: float
) -> tuple[float, Callable[[float], float]]:
    """Return the duration [s] of a trapezoidal move in rad, rad/s and rad/s², and the share done at a time [s]."""
    rise = min(speed / acceleration, math.sqrt(distance / acceleration))
    top = acceleration * rise
    duration = rise + distance / max(top, 1e-300) if distance > 0.0 else 0.0

    def done(t: float) -> float:
        # The way of the second half is that of the first, backwards
        short = max(0.0, min(t, duration - t))
        way = top * (short - rise / 2.0) if short > rise else acceleration * short * short / 2.0
        share = way / distance if distance > 0.0 else 0.0
        if 2.0 * t < duration:
            return share
        return 1.0 - share

    return duration, done


@final
class ControlProgram:
    """The control program, and the motion of the arm that it commands.

    Attributes:
        inputs: the input registers, by name.
        progress: the output register for it: 0 without a program, 1 ready, 2 done.
        running: whether a program runs.
        stopped_at: when a protective stop began, on the clock `time.monotonic` [s]; None without one.
        joints: (n,), as the arm reports them [rad]; the server writes them.
        velocity: (n,), the joint velocities that it commands now [rad/s].
        busy: whether a motion is under way that ends by itself.
    """

    def __init__(self, spec: PlantSpec, drive: TrueModel, say: Say, *, lockstep: bool) -> None:
        """Take spec and drive of the plant, and a printer of lines; in lockstep accelerations have no limit."""
        self._spec = spec
        self._drive = drive
        self._say = say
        self._lockstep = lockstep
        self.inputs: Record = {}
        self.stopped_at: float | None = None
        self._rest: FloatArray = np.zeros(spec.n)
        self.velocity = self.joints = self._rest
        self._actions: dict[int, Callable[[], Motion | None]] = {
            1: self._move, 9: self._speed, 11: self._servo, 15: self._halt, 16: self._halt, 35: self._watch,
            31: lambda: self.protect("asked for"), 99: lambda: None, 255: lambda: self.stop("by its client"),
        }  # fmt: skip
        self.begin(running=False)

    def begin(self, *, running: bool = True) -> None:
        """Begin the program anew, or forget the one that ran."""
        self.running = running
        self.progress = int(running)
        self.busy = False
        self._awaited = False
        self._executing = False
        self._silence = 0
        self._watchdog = math.inf
        self._motion: Motion | None = self._ramp(self._rest, STOP_DECELERATION)

    def stop(self, why: str) -> None:
        """End the program and bring the arm to rest, with a line for the user."""
        if self.running:
            self._say(f"control program ended {why}")
            self.begin(running=False)
            self.busy = True

    def protect(self, why: str) -> None:
        """Begin a protective stop: the arm stands at once, and the program ends."""
        self._say(f"protective stop: {why}")
        self.stopped_at = time.monotonic()
        self.stop("by a protective stop")
        self.velocity = self._rest
        self._motion = None
        self.busy = False

    def unlock(self) -> bool:
        """End a protective stop if it lasted long enough, and return whether none is left."""
        if self.stopped_at is not None and time.monotonic() - self.stopped_at >= UNLOCK_AFTER:
            self.stopped_at = None
        return self.stopped_at is None

    def write(self, values: Record) -> bool:
        """Write input registers, and return whether that of commands, which the watchdog waits for, is among them."""
        self.inputs |= values
        self._silence = 0 if COMMAND in values else self._silence
        return COMMAND in values

    def cycle(self) -> bool:
        """Carry out the command in the registers as the script's main loop does; return whether it is for a period."""
        command = self.inputs.get(COMMAND, 0)
        if not self.running or self._awaited:
            return False
        if command in WITHOUT_ANSWER:
            self._carry_out(command)
        elif command == 0:
            self._executing = False
            self.progress = 1
        elif not self._executing:
            self._executing = True
            self._carry_out(command)
            self._awaited = self.running and self.busy
            if self.running and not self.busy:
                self.progress = 2
        return self.running and command in (9, 11)  # speedJ and servoJ

    def advance(self) -> FloatArray:
        """Return the joint velocities of the next period, (n,) [rad/s], and count the time of the watchdog."""
        self._silence += 1
        limit = self._spec.joint_velocity_limit
        if (silent := self._silence * self._spec.period) > self._watchdog:
            self.stop(f"by its watchdog, after {silent:.3g} s without a command")
        if self._motion is not None:
            try:
                self.velocity = np.clip(next(self._motion), -limit, limit)
            except StopIteration:
                self._motion = None
                self.velocity = self._rest
                self._arrive()
        return self.velocity

    def _arrive(self) -> None:
        self.busy = False
        if self._awaited:
            self._awaited = False
            self.progress = 2

    def _carry_out(self, command: int) -> None:
        name = COMMANDS[command] if 0 < command < len(COMMANDS) else "-"
        try:
            self._motion = self._actions[command]() or self._motion
        except KeyError:
            self.stop(f"at {name} (command {command}), which is not served")
        except ValueError as error:
            self.stop(f"at {name}: {error}")

    def _numbers(self, first: int, count: int) -> FloatArray:
        numbers = np.array(
            [self.inputs.get(f"input_double_register_{first + k}", 0.0) for k in range(count)]
        )
        if not np.isfinite(numbers).all():
            raise ValueError(f"its numbers must be finite, got {numbers.tolist()}")
        return numbers

    def _rate(self, name: str, register: int) -> float:
        if (rate := float(self._numbers(register, 1)[0])) <= 0.0:
            raise ValueError(f"its {name} must be positive, got {rate:g}")
        return rate

    def _reachable(self) -> FloatArray:
        spec = self._spec
        target = self._numbers(0, spec.n)
        outside = (target < spec.joint_lower) | (target > spec.joint_upper)
        if outside.any():
            raise ValueError(
                f"its target must be within the joints' limits, got {target.tolist()} rad"
            )
        return target

    def _move(self) -> Motion:
        """Move along a trapezoidal profile, corrected by the distance from its present point."""
        if self.inputs.get("input_int_register_1", 0):
            raise ValueError("asynchronous moves are not served")
        start = self.joints
        target = self._reachable()
        period = self._spec.period
        fastest = float(self._spec.joint_velocity_limit.min())
        speed = min(self._rate("speed", 6), fastest)
        distance = float(np.abs(target - start).max())
        duration, done = profile(distance, speed, self._rate("acceleration", 7))
        if not duration < LONGEST_MOVE:
            raise ValueError(f"its move must take less than {LONGEST_MOVE:g} s, got {duration:g} s")
        self.busy = True

        def along() -> Motion:
            for k in range(math.ceil(LONGEST_MOVE / period)):
                if k * period >= duration:
                    if np.abs(target - self.joints).max() < POSITION_TOLERANCE:
                        return
                    # A UR answers at the end of the profile, and its drives follow.
                    if not self._lockstep:
                        self._arrive()
                now, then, later = (done((k + ahead) * period) for ahead in range(3))
                acceleration = (later - 2.0 * then + now) / period**2
                lag = self._drive.lag or 0.0
                rate = (then - now) / period + lag * acceleration
                # Where the arm should be by the commands that have acted.
                share = done(k * period - self._drive.command_delay)
                there = start + (target - start) * share
                yield (target - start) * rate + POSITION_GAIN * (there - self.joints)

        return along()

    def _speed(self) -> Motion:
        limit = self._spec.joint_velocity_limit
        wanted = np.clip(self._numbers(0, self._spec.n), -limit, limit)
        return self._ramp(wanted, self._rate("acceleration", 6), forever=True)

    def _servo(self) -> Motion:
        """Approach a position with the look-ahead time as time constant."""
        target = self._reachable()
        time_constant = max(self._rate("lookahead_time", 9), self._spec.period)
        return ((target - self.joints) / time_constant for _ in count())

    def _halt(self) -> Motion:
        self.busy = True
        return self._ramp(self._rest, self._rate("deceleration", 0))

    def _ramp(self, target: FloatArray, acceleration: float, *, forever: bool = False) -> Motion:
        """Yield velocities from the present one to a target; the joint that changes most has the acceleration."""
        change = math.inf if self._lockstep else acceleration * self._spec.period
        while forever or self.velocity.any():
            missing = target - self.velocity
            most = float(np.abs(missing).max())
            if most <= change and not forever:
                self._arrive()
            yield target if most <= change else self.velocity + missing * (change / most)

    def _watch(self) -> None:
        self._watchdog = 1.0 / self._rate("frequency", 0)
