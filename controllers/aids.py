"""The aids of a composed controller: what any estimator and any law can have in addition to what its paper gives it.

An aid is a stage of the chain that can be left out; all of them are off by default, which is a method as published.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, TypeAlias

from annotated_types import Le

from servobench.plant.contract.settings import NonNegative, Positive, Share, settings

Known: TypeAlias = Literal["ignored", "identified", "given"]
"""Whether a quantity is left out, identified from the motions of the run, or given by a number."""


@settings
class AidsConfig:
    """The aids of a composed controller; by default there are none."""

    delay: Known = "ignored"
    """The camera's latency: which joint motion belongs to a feature's motion, and where the feature is by now."""
    response: Known = "ignored"
    """How joints answer to commands: the law acts on where the arm will be when all of them are carried out."""
    noise: Literal["given", "identified"] = "given"
    """The standard deviation of the feature, as `feature_noise` or identified."""
    filter: bool = False
    """Filter the feature with the motion of the joints."""
    model: Literal["own", "nominal", "map"] = "own"
    """The estimator's own Jacobian, its deviation from the nominal one, or from the nominal one seen through a map."""
    feedforward: bool = False
    """Add the reference's own motion; needs a preview."""
    posture: bool = False
    """Move towards the middle of the working region in the null space of the Jacobian."""
    limit: Literal["scale", "clip", "redistribute"] = "scale"
    """A command beyond the limits is shrunk, cut joint by joint, or taken over by joints with room."""
    longest_delay: Annotated[NonNegative, Le(1.0)] = 0.25
    """[s] the longest delay that is considered; for an identified one."""
    latency: NonNegative = 0.0
    """[s] latency of the camera; for a given delay. A method that gets the truth gets the true one."""
    command_delay: NonNegative = 0.05
    """[s] until a command shows in the joints; for a given response, as the next one."""
    lag: NonNegative = 0.05
    """[s] time constant of the joints."""
    response_length: Annotated[Positive, Le(2.0)] = 0.6
    """[s] within which joints respond to a command; for an identified response."""
    feature_noise: Positive = 0.001
    """[unit of the feature] standard deviation of a feature; the first guess where it is identified."""
    map_deviation: Positive = 1.0
    """[1] of an entry of the map from the identity at first; 1: any camera is possible."""
    map_walk: NonNegative = 0.1
    """[1/√m] deviation of an entry of the map after the feature has moved by a metre."""
    map_error: NonNegative = 0.1
    """[1] share of a step that nominal model and map do not explain."""
    rotation_deviation: NonNegative = 0.2
    """[1] of an entry of the map from the nearest rotation; 0: the map is a rotation."""
    confidence: Positive = 0.5
    """[1] deviation of an entry of the map below which the estimator learns."""
    delay_margin: NonNegative = 6.0
    """[1] by which a delay must be better than the present one, in −2 log likelihood."""
    score_memory: Share = 1.0
    """[1] share of a delay's score that is kept from one motion to the next; below 1 for a latency that changes."""
    detect_moves: bool = True
    """Forget what is known of the map when the camera seems to have been moved."""
    move_gate: Positive = 12.0
    """[1] sum of innovations (CUSUM) beyond which it seems so."""
    filter_error: NonNegative = 0.2
    """[1] error of the Jacobian as a share of its size, as the filter sees it."""
    posture_gain: NonNegative = 0.6
    """[1/s] gain of the posture."""
    damping: Positive = 0.02
    """[m/rad] of the inverse in feedforward, posture and redistribution."""

    @property
    def looks_back(self) -> bool:
        """Whether a stage needs past joint positions."""
        away = (self.delay, self.response, self.noise, self.filter, self.model)
        return away != ("ignored", "ignored", "given", False, "own")


EQUIPPED: Final[dict[str, Any]] = {
    "delay": "identified",
    "response": "identified",
    "noise": "identified",
    "filter": True,
    "model": "map",
    "feedforward": True,
    "posture": True,
    "limit": "redistribute",
}
