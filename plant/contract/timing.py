"""The clock of the bench: in which sub-step a command takes effect and a frame is exposed.

Command delay, latency and frame period are physical times. Where they are no multiples of the control period T, the
bench advances its world in equal sub-steps h, the greatest common divisor of all of them in whole milliseconds, so that
the physical world is the same at every control rate. With N = T/h, the command of period k − ⌈(d − j)/N⌉ acts in
sub-step j of period k, for a delay of d sub-steps.
"""

import math
from dataclasses import dataclass
from typing import Final, Self

from servobench.plant.contract.checks import check_number
from servobench.plant.contract.sensing import SensingConfig

TIME_TOLERANCE: Final = 1e-9  # [s] within which two times are equal


@dataclass(frozen=True)
class Timing:
    """Times of the bench in sub-steps of length h; sub-step i ends at the time i h."""

    steps: int  # in a control period, N
    delays: tuple[int, ...]  # [periods] age of the command that acts in each of the N sub-steps of a period
    latency: int  # between exposure and delivery of a frame
    frames: int  # between two exposures
    phase: int  # of the exposures, which happen after each sub-step i with i mod `frames` = `phase`

    @classmethod
    def of(cls, period: float, step: float, command_delay: float, sensing: SensingConfig) -> Self:
        """Return the times of a bench in sub-steps.

        Args:
            period: control period, s.
            step: sub-step, s.
            command_delay: between a command and its first effect, s.
            sensing: latency and frame period.

        Raises:
            ValueError: a time that is no multiple of the sub-step.
        """
        times = {"period": period, **delays_of(command_delay, sensing)}
        for name, value in times.items():
            if not _is_multiple(value, step):
                raise ValueError(f"{name} must be a multiple of the world's period of {step:g} s, got {value:g} s")
        steps, delay, latency, frames = (round(value / step) for value in times.values())
        delays = tuple(max(0, -((j - delay) // steps)) for j in range(steps))
        return cls(steps, delays, latency, frames or steps, 0 if frames else -latency % steps)

    def exposes(self, step: int) -> bool:
        """Return whether a frame is exposed after sub-step number `step`."""
        return step % self.frames == self.phase

    def under_way(self) -> list[int]:
        """Return the sub-steps, above 0, at which the frames are due that were exposed before the start."""
        begins = range(1 - self.latency, 1)
        return [begin + self.latency for begin in begins if self.exposes(begin)]


def delays_of(command_delay: float, sensing: SensingConfig) -> dict[str, float]:
    """Return the times [s] that a bench adds to a world, by the name of the setting."""
    return {"command_delay": command_delay, "latency": sensing.latency, "frame_period": sensing.frame_period}


def common_step(period: float, command_delay: float, sensing: SensingConfig) -> float:
    """Return the longest sub-step [s] of which the control period and all times of the bench are multiples.

    It is the control period itself where all others are multiples of it, else whole milliseconds.

    Raises:
        ValueError: neither is possible, or a control period that is not positive.
    """
    check_number("period", period, above=0.0)
    times = delays_of(command_delay, sensing)
    odd = [name for name, value in times.items() if not _is_multiple(value, period)]
    if not odd:
        return period
    for name, value in {"period": period, **times}.items():
        if not _is_multiple(value, 1e-3):
            raise ValueError(
                f"{name} must be a whole number of milliseconds, because {odd[0]} is no multiple of the control "
                f"period of {period:g} s; got {value:g} s"
            )
    return math.gcd(*(round(1000.0 * value) for value in (period, *times.values()))) / 1000.0


def _is_multiple(value: float, step: float) -> bool:
    return abs(round(value / step) * step - value) < TIME_TOLERANCE
