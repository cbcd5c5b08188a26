"""The aids of a composed controller: optional stages that any estimator and any law can have beside their papers' own.

An aid is a stage of the chain that can be left out; all of them are off by default, which is a method as published.

An aid is declared once, by the field of `AidsConfig` that switches it: name, type, default and help as for any setting,
and in its type a `Switch` with the value that a best equipped method has and the values that tuning tries. The tables
of methods, the study of the aids and the spaces of tuning are made from these declarations. A number that has an effect
with some aids alone says so in its type, too: `Only`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NoReturn, TypeAlias

from annotated_types import Le

from servobench.plant.contract.dependence import Only, declared
from servobench.plant.contract.settings import (
    Delay,
    Deviation,
    NonNegative,
    Positive,
    Section,
    Share,
    settings,
)

Known: TypeAlias = Literal["ignored", "identified", "given"]
"""Whether a quantity is left out, identified from the motions of the run, or given by a number."""


@dataclass(frozen=True)
class Switch:
    """Declares a setting that switches an aid; its default leaves the aid out."""

    equipped: object  # its value in a best equipped method
    # the values among which tuning chooses; empty where tuning has no choice
    tuned: tuple[object, ...] = ()


@dataclass(frozen=True)
class Tuned:
    """Declares the range in which a number is tuned, in the type of its field.

        gain: Annotated[float, Tuned(1.0, 20.0, log=True)] = 3.0

    Raises:
        ValueError: the range is not two numbers, is empty, or reaches 0 where it is searched by factor.
    """

    low: float  # smallest value
    high: float  # largest value
    log: bool = False  # whether it is searched by factor

    def __post_init__(self) -> None:
        """Refuse a range that cannot be searched."""
        numbers = isinstance(self.low, int | float) and isinstance(self.high, int | float)
        fit = numbers and -math.inf < self.low < self.high < math.inf
        if not fit or (self.log and self.low <= 0.0):
            raise ValueError(
                f"wanted two finite numbers, the lower one first, and above 0 with log=True; got {self}"
            )


@settings
class AidsConfig:
    """The aids of a composed controller; by default there are none."""

    delay: Annotated[Known, Switch("identified", tuned=("ignored", "identified"))] = "ignored"
    """Compensate the camera's latency: pair feature and joint motions, predict the feature."""
    response: Annotated[Known, Switch("identified", tuned=("ignored", "identified"))] = "ignored"
    """Smith predictor: the law acts on the state after all commands sent."""
    noise: Annotated[
        Literal["given", "identified"], Switch("identified", tuned=("given", "identified"))
    ] = "given"
    """The feature's standard deviation: `feature_noise`, or identified."""
    filter: Annotated[bool, Switch(equipped=True, tuned=(False, True))] = False
    """Subtract the noise that the regression finds in the last frame."""
    model: Annotated[
        Literal["own", "nominal", "regression", "arm"],
        Switch("regression", tuned=("own", "nominal", "regression")),
    ] = "own"
    """What the estimator learns: the Jacobian, or its deviation from the nominal one, from a regression on it, or from
    the nominal arm whose parameters are fitted ("arm", self-calibration) while that predicts better."""
    feedforward: Annotated[bool, Switch(equipped=True, tuned=(False, True))] = False
    """Feedforward of the reference's motion; needs a preview."""
    posture: Annotated[bool, Switch(equipped=True)] = False
    """Null-space centring: move towards the middle of the working region."""
    limit: Annotated[
        Literal["scale", "clip", "redistribute"],
        Switch("redistribute", tuned=("scale", "clip", "redistribute")),
    ] = "scale"
    """Saturation of a command: scaled, clipped by joint, or redistributed."""
    calming: Annotated[bool, Switch(equipped=True)] = False
    """Slow down where the command turns back at its limit in each period, as at targets out of reach."""
    longest_delay: Annotated[NonNegative, Le(1.0), Only(delay="identified")] = 0.25
    """[s] longest delay considered, if identified."""
    latency: Annotated[Delay, Only(delay="given")] = 0.0
    """[s] of the camera, if the delay is given; methods that get the truth get the true one."""
    command_delay: Annotated[Delay, Only(response="given")] = 0.05
    """[s] from command to joint motion, if the response is given."""
    lag: Annotated[Delay, Only(response="given")] = 0.05
    """[s] time constant of the joints, if the response is given."""
    response_length: Annotated[Positive, Le(2.0), Only(response="identified")] = 0.6
    """[s] length of the joints' response, if identified."""
    feature_noise: Annotated[
        Deviation,
        Only(
            delay=("identified", "given"),
            response=("identified", "given"),
            noise="identified",
            filter=True,
            model=("nominal", "regression", "arm"),
        ),
    ] = 0.001
    """[m] standard deviation, of pixels too; the first guess if identified."""
    delay_margin: Annotated[NonNegative, Only(delay="identified")] = 6.0
    """[1] lead in −2 log likelihood at which a new delay is adopted."""
    score_memory: Annotated[Share, Only(delay="identified")] = 1.0
    """[1] share of a delay's score kept from motion to motion; below 1 for a changing latency."""
    posture_gain: Annotated[NonNegative, Tuned(0.1, 1.0, log=True), Only(posture=True)] = 0.6
    """[1/s] of `posture`."""
    damping: Annotated[Positive, Only(feedforward=True, posture=True, limit="redistribute")] = 0.02
    """[m/rad] of the pseudo-inverse in feedforward, `posture` and redistribution."""

    @property
    def needs_past(self) -> bool:
        """Whether a stage needs past joint positions."""
        away = (self.delay, self.response, self.noise, self.filter, self.model)
        return away != ("ignored", "ignored", "given", False, "own")


SWITCHES: Mapping[str, Switch] = declared(AidsConfig, Switch)
"""The aids by name."""
RANGES: Mapping[str, Tuned] = declared(AidsConfig, Tuned)
"""The numbers of the aids that are tuned, by name."""


class _Fixed(dict[str, Any]):
    """A dictionary that cannot be changed."""

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError(
            "servobench.EQUIPPED is shared; change a copy, {**servobench.EQUIPPED, 'posture': False}"
        )

    __setitem__ = __delitem__ = update = setdefault = pop = popitem = clear = __ior__ = _refuse

    def __reduce__(self) -> tuple[type, tuple[dict[str, Any]]]:
        """Return how a copy is made, which is a plain one."""
        return dict, (dict(self),)


EQUIPPED: Section = _Fixed({name: switch.equipped for name, switch in SWITCHES.items()})
"""The value of each aid in a best equipped method."""


def describe_aids(values: Section) -> str:
    """Return which aids a controller has by its settings, whose keys have dots: with all, without, with some."""
    none = AidsConfig()
    on = []
    for name in SWITCHES:
        default = getattr(none, name)
        if values.get(f"aids.{name}", default) != default:
            on.append(name)
    off = [name for name in SWITCHES if name not in on]
    if not on:
        return "without aids"
    if not off:
        return "with all aids"
    if len(on) < len(off):
        return f"with the aids {', '.join(on)} alone"
    return f"with all aids but {', '.join(off)}"
