"""The joints' drives: a cascade of position and velocity loops, torque limits, friction and reflected rotor inertia.

A commanded velocity u is smoothed by a first-order lag and integrated to a reference; with h = 1 ms, in every step

    c ← c + (1 − e^(−h/τ)) (u − c),      r ← r + h c                        reference
    e = c + K_p (r − θ) − ω                                                 velocity error
    T = clip(K_v e + z + ĝ(θ) + κ d(c), ±T_max),   z ← z + h K_v ω_i e       torque; z waits while T is clipped
    d(c) = (B + F/max(|c|, ω_s)) c                                           friction
    (M(θ) + I + h (B + F/max(|ω|, ω_s))) ω₊ = (M(θ) + I) ω + h (T − b(θ, ω)),   θ₊ = θ + h ω₊

Symbols, (n,) unless stated: θ [rad] and ω [rad/s] true angle and speed; M (n, n) [kg m²] and b [Nm] inertia of the
links and load, and the torque of gravity, centrifugal and Coriolis forces; ĝ [Nm] gravity torque by the load that the
drives assume; I [kg m²] rotor inertia; B [Nm s/rad] viscous and F [Nm] Coulomb friction, the latter linear below ω_s; κ
[1] compensated share of friction. With ω_v = 2π × bandwidth: K_v = ω_v (M + I)_ii at the start under the assumed load,
K_p = ω_v/4, ω_i = ω_v/10. Friction is taken implicitly, so that a joint sticks instead of chattering.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dposv

from servobench.plant.checks import FloatArray
from servobench.plant.robot import ur5
from servobench.plant.robot.robot import Robot
from servobench.plant.settings import NonNegative, Positive, Share, settings

PHYSICS_STEP = 0.001  # [s] it divides every control period of 10, 20, 50, 125 and 250 Hz
POSITION_SHARE, INTEGRAL_SHARE = (
    0.25,
    0.1,
)  # [1] of the velocity loop's bandwidth; poles stay damped at twice the inertia
STICKING_SPEED = 1e-3  # [rad/s] below it Coulomb friction falls to 0 in proportion
RATED_PAYLOAD = 5.0  # [kg] of a UR5
MAX_FOLLOWING_ERROR = 0.1  # [rad] the reference waits for a joint that falls behind further


@settings
class DriveConfig:
    """Settings of the joints' drives: lists have one number for all joints or one for each."""

    dynamics: bool = True
    """Torque-driven joints; without it they follow the lag exactly, without mass, load and friction."""
    velocity_bandwidth: tuple[Positive, ...] = (15.0, 15.0, 15.0, 20.0, 20.0, 20.0)
    """[Hz] of each velocity loop; in no data sheet: chosen so that joints rise in about 50 ms, as on `kinematic`."""
    torque_limit: tuple[Positive, ...] = ur5.MAX_TORQUE
    """[Nm] of each joint, by its maker; these of Universal Robots, "Max. joint torques"."""
    rotor_inertia: tuple[NonNegative, ...] = (0.1,)
    """[kg m²] of the rotor, times the gear's ratio squared; that of the UR5e in MuJoCo Menagerie, in no data sheet."""
    coulomb_friction: tuple[NonNegative, ...] = (7.5, 7.5, 7.5, 1.4, 1.4, 1.4)
    """[Nm] 5 % of the torque limit; an order of magnitude for strain-wave gears, in no data sheet."""
    viscous_friction: tuple[NonNegative, ...] = (7.5, 7.5, 7.5, 1.4, 1.4, 1.4)
    """[Nm s/rad] at 1 rad/s as much as Coulomb friction; an order of magnitude, too."""
    friction_compensation: Share = 0.8
    """[1] of friction, by the reference's speed; 0.7 to 0.9 by default in Universal Robots' torque control."""
    payload: NonNegative = 2.5
    """[kg] true load, a point at the ball: half of the UR5's rated 5 kg, a gripper of 0.9 kg and what it holds."""
    assumed_payload: NonNegative = 0.9
    """[kg] load by which the drives compensate gravity: the gripper alone (0.9 kg, Robotiq 2F-85)."""

    def check(self, n: int) -> None:
        """Refuse lists that do not fit `n` joints.

        Raises:
            ValueError: a list of another length.
        """
        for name in ("velocity_bandwidth", "torque_limit", "rotor_inertia", "coulomb_friction", "viscous_friction"):
            if len(getattr(self, name)) not in {1, n}:
                raise ValueError(f"{name} must have 1 or {n} numbers, got {len(getattr(self, name))}")


def drives_for(robot: Robot) -> DriveConfig:
    """Return the settings of the drives of an arm: those of the UR5, in proportion to its joints' torques and its load.

    Joints of at least half the torque of the strongest one have the bandwidth of a shoulder, the others of a wrist.
    """
    own, default = robot.links.torque, DriveConfig()
    share = own / ur5.MAX_TORQUE[0]
    friction = default.coulomb_friction[0] * share
    slow, fast = default.velocity_bandwidth[0], default.velocity_bandwidth[-1]
    load = robot.links.payload / RATED_PAYLOAD
    return DriveConfig(
        velocity_bandwidth=tuple(np.where(own >= own.max() / 2.0, slow, fast).tolist()),
        torque_limit=tuple(own.tolist()),
        rotor_inertia=(default.rotor_inertia[0] * float(share.max()),),
        coulomb_friction=tuple(friction.tolist()),
        viscous_friction=tuple(friction.tolist()),
        payload=default.payload * load,
        assumed_payload=default.assumed_payload * load,
    )


class DriveState(NamedTuple):
    """The joints and their loops; arrays (n,) never change.

    Attributes:
        angle: θ [rad].
        speed: ω [rad/s].
        reference: r [rad].
        reference_speed: c [rad/s].
        integral: z [Nm].
    """

    angle: FloatArray
    speed: FloatArray
    reference: FloatArray
    reference_speed: FloatArray
    integral: FloatArray


class RigidBody(NamedTuple):
    """What the links and the load ask of the drives in one state.

    Attributes:
        inertia: M, (n, n) [kg m²].
        bias: b, (n,) [Nm].
        assumed_gravity: ĝ, (n,) [Nm].
    """

    inertia: FloatArray
    bias: FloatArray
    assumed_gravity: FloatArray


class Drives:
    """The cascade of one arm, tuned to its inertia at the start of a run."""

    def __init__(
        self, config: DriveConfig, lag: float, assumed_inertia: FloatArray, stops: tuple[FloatArray, FloatArray]
    ) -> None:
        """Compute the gains.

        Args:
            config: limits, friction, bandwidth.
            lag: τ [s], 0 for none.
            assumed_inertia: (n, n) [kg m²] of the links and the assumed load at the start.
            stops: (n,) and (n,) [rad], lower and upper stop of the true angles.
        """
        n, h = len(assumed_inertia), PHYSICS_STEP
        config.check(n)
        self._lower, self._upper = stops
        self._blend = -math.expm1(-h / lag) if lag > 0.0 else 1.0
        rotor = np.broadcast_to(config.rotor_inertia, n)
        pole = 2 * np.pi * np.broadcast_to(config.velocity_bandwidth, n)
        self._velocity_gain = pole * (np.diagonal(assumed_inertia) + rotor)
        self._position_gain = POSITION_SHARE * pole
        self._integral_gain = h * INTEGRAL_SHARE * pole * self._velocity_gain
        self._diagonal = np.diag_indices(n)
        self._rotor, self._limit = np.diag(rotor), np.broadcast_to(config.torque_limit, n)
        self._least = -self._limit
        self._compensation = config.friction_compensation / h
        self._viscous = h * np.broadcast_to(config.viscous_friction, n)
        self._coulomb = h * np.broadcast_to(config.coulomb_friction, n)

    def start(self, angle: FloatArray, body: RigidBody) -> DriveState:
        """Return joints at rest at `angle` (n,) [rad] whose integrals carry what gravity compensation lacks."""
        rest = np.zeros(len(angle))
        return DriveState(angle, rest, angle, rest, body.bias - body.assumed_gravity)

    def follow(self, state: DriveState, speed: FloatArray) -> DriveState:
        """Return the state with the reference one physics step further.

        Args:
            state: the present state.
            speed: (n,) [rad/s], commanded, of the true angles.
        """
        c = state.reference_speed + self._blend * (speed - state.reference_speed)
        wanted = state.reference + PHYSICS_STEP * c
        r = np.minimum(np.maximum(wanted, self._lower), self._upper)
        return DriveState(state.angle, state.speed, r, np.where(r == wanted, c, 0.0), state.integral)

    def track(self, state: DriveState) -> DriveState:
        """Return the state of joints that are exactly where their reference is."""
        return state._replace(angle=state.reference, speed=state.reference_speed)

    def torque(self, state: DriveState, assumed_gravity: FloatArray) -> tuple[FloatArray, DriveState]:
        """Return the torque for one physics step, (n,) [Nm], and the loops after it: joints where they were.

        Args:
            state: the state whose reference has just been advanced by `follow`.
            assumed_gravity: ĝ in the state, (n,) [Nm].
        """
        behind = np.minimum(np.maximum(state.reference - state.angle, -MAX_FOLLOWING_ERROR), MAX_FOLLOWING_ERROR)
        error = state.reference_speed + self._position_gain * behind - state.speed
        friction = self._compensation * self._drag(state.reference_speed) * state.reference_speed
        asked = self._velocity_gain * error + state.integral + assumed_gravity + friction
        torque = np.minimum(np.maximum(asked, self._least), self._limit)
        integral = state.integral + self._integral_gain * error * (asked == torque)
        return torque, DriveState(state.angle, state.speed, state.angle + behind, state.reference_speed, integral)

    def drive(self, state: DriveState, body: RigidBody) -> DriveState:
        """Return the state one physics step later under the loops' torques.

        Args:
            state: the state whose reference has just been advanced by `follow`.
            body: what the links and the load ask in the state.
        """
        torque, after = self.torque(state, body.assumed_gravity)
        angle, speed, h = state.angle, state.speed, PHYSICS_STEP
        inertia = body.inertia + self._rotor
        momentum = inertia @ speed + h * (torque - body.bias)
        inertia[self._diagonal] += self._drag(speed)
        speed = dposv(inertia, momentum)[1]
        moved = angle + h * speed
        angle_after = np.minimum(np.maximum(moved, self._lower), self._upper)
        speed = np.where(angle_after == moved, speed, 0.0)
        return DriveState(angle_after, speed, *after[2:])

    def _drag(self, speed: FloatArray) -> FloatArray:
        """Return friction over speed, times the physics step, at speeds (n,) [rad/s], (n,) [kg m²]."""
        drag: FloatArray = self._viscous + self._coulomb / np.maximum(np.abs(speed), STICKING_SPEED)
        return drag
