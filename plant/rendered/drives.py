"""The joints' drives: a cascade of position and velocity loops, torque limits, friction and reflected rotor inertia.

A commanded velocity u is smoothed by a first-order lag and integrated to a reference; in every step h of 1 ms or less

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

import math
from typing import Any, NamedTuple, TypeAlias

import casadi
import numpy as np
from scipy.linalg.lapack import dposv

from servobench.plant.cameras.symbolic import SX, symbols
from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.settings import DriveConfig

Arrays: TypeAlias = tuple[FloatArray, ...]
PHYSICS_STEP = 0.001  # [s] where it divides the time to simulate, which otherwise has equal steps that are not longer
# Bandwidths of the outer loops over that of the velocity loop: the poles stay damped at twice the inertia.
POSITION_SHARE = 0.25  # [1]
INTEGRAL_SHARE = 0.1  # [1]
STICKING_SPEED = 1e-3  # [rad/s] below it Coulomb friction falls to 0 in proportion
MAX_FOLLOWING_ERROR = 0.1  # [rad] the reference waits for a joint that falls behind further


class DriveState(NamedTuple):
    """The joints and their loops; arrays (n,) never change."""

    angle: FloatArray  # θ [rad]
    speed: FloatArray  # ω [rad/s]
    reference: FloatArray  # r [rad]
    reference_speed: FloatArray  # c [rad/s]
    integral: FloatArray  # z [Nm]
    acceleration: FloatArray  # [rad/s²] from which MuJoCo's solver starts; 0 with PyBullet


class RigidBody(NamedTuple):
    """Inertia and torques of the links and the load in one state, as the drives have to overcome them."""

    inertia: FloatArray  # M, (n, n) [kg m²]
    bias: FloatArray  # b, (n,) [Nm]
    assumed_gravity: FloatArray  # ĝ, (n,) [Nm]


class InPlace:
    """A function of CasADi that reads its arguments and writes its results in place."""

    def __init__(self, function: casadi.Function, arguments: Arrays, results: Arrays) -> None:
        """Take arrays without gaps; no result shares memory with an argument."""
        self._arrays = *arguments, *results  # The function keeps pointers to these arrays.
        self._buffer: Any
        self._buffer, self._evaluate = function.buffer()
        for position, array in enumerate(arguments):
            self._buffer.set_arg(position, array.data)
        for position, array in enumerate(results):
            self._buffer.set_res(position, array.data)

    def __call__(self) -> None:
        """Evaluate the function."""
        self._evaluate()


class Drives:
    """The cascade of one arm, tuned to its inertia at the start of a run.

    The equations are one function of CasADi, which works in arrays: a step of all loops takes a few microseconds, where
    numpy takes twenty, most of them for calls. Attributes are those arrays, (n,): the caller of `step` writes the first
    four and reads the others.

    Attributes:
        command: [rad/s], commanded speed of the true angles.
        angle: θ [rad].
        speed: ω [rad/s].
        assumed_gravity: ĝ [Nm].
        torque: T [Nm].
        drag: friction over speed, times the physics step, h (B + F/max(|ω|, ω_s)) [kg m²].
    """

    def __init__(
        self,
        config: DriveConfig,
        lag: float,
        assumed_inertia: FloatArray,
        stops: Arrays,
        body: Arrays | None = None,
        physics_step: float = PHYSICS_STEP,
    ) -> None:
        """Compute the gains.

        Args:
            config: limits, friction, bandwidth.
            lag: τ [s], 0 for none.
            assumed_inertia: (n, n) [kg m²] of the links and the assumed load at the start.
            stops: (n,) and (n,) [rad], lower and upper stop of the true angles.
            body: arrays of the engine to be taken as `angle`, `speed` and `assumed_gravity`; None for own ones.
            physics_step: h [s].
        """
        n = len(assumed_inertia)
        h = self._h = physics_step
        config.check(n)
        self._lower, self._upper = stops
        blend = np.ones(1)  # [1] 1 − e^(−h/τ)
        if lag > 0.0:
            blend[0] = -math.expm1(-h / lag)
        rotor = np.broadcast_to(config.rotor_inertia, n)
        pole = 2 * np.pi * np.broadcast_to(config.velocity_bandwidth, n)
        self._velocity_gain = pole * (np.diagonal(assumed_inertia) + rotor)
        self._position_gain = POSITION_SHARE * pole
        self._integral_gain = h * INTEGRAL_SHARE * pole * self._velocity_gain
        self._diagonal = np.diag_indices(n)
        self._rotor = np.diag(rotor)
        self._limit = np.broadcast_to(config.torque_limit, n)
        self._compensation = config.friction_compensation / h
        self._viscous = h * np.broadcast_to(config.viscous_friction, n)
        self._coulomb = h * np.broadcast_to(config.coulomb_friction, n)
        own = (np.zeros(n), np.zeros(n), np.zeros(n))
        self.angle, self.speed, self.assumed_gravity = body or own
        self.command = np.zeros(n)
        self.torque = np.zeros(n)
        self.drag = np.zeros(n)
        # Rows of the loops: r, c, z. CasADi writes the next ones beside them: no result shares an argument's memory.
        self._loops = np.zeros((3, n))
        self._next = np.zeros((3, n))
        loops = self._loops.ravel()
        next_loops = self._next.ravel()
        commanded = (blend, self.command, loops)
        self._follow = InPlace(self._reference_law(n), commanded, (next_loops,))
        arguments = (*commanded, self.angle, self.speed, self.assumed_gravity)
        results = (next_loops, self.torque, self.drag)
        self._step = InPlace(self._law(n), arguments, results)

    def start(self, angle: FloatArray, body: RigidBody) -> DriveState:
        """Return joints at rest at `angle` (n,) [rad] whose integrals carry the rest of the gravity."""
        rest = np.zeros(len(angle))
        return DriveState(angle, rest, angle, rest, body.bias - body.assumed_gravity, rest)

    def take(self, state: DriveState, command: FloatArray) -> None:
        """Set the state of joints and loops, and the command (n,) [rad/s]."""
        self.command[:] = command
        self.angle[:] = state.angle
        self.speed[:] = state.speed
        self._loops[:] = (state.reference, state.reference_speed, state.integral)

    def give(self) -> DriveState:
        """Return the present state, as arrays that never change."""
        reference, speed, integral = self._loops.copy()
        rest = np.zeros(len(integral))
        return DriveState(self.angle.copy(), self.speed.copy(), reference, speed, integral, rest)

    def step(self) -> None:
        """Advance the loops by a physics step: joints stay where they are; `torque` and `drag` are for this step."""
        self._step()
        self._loops[:] = self._next

    def track(self) -> None:
        """Advance by a physics step joints that are exactly where their reference is."""
        self._follow()
        self._loops[:] = self._next
        self.angle[:], self.speed[:] = self._loops[:2]

    def drive(self, body: RigidBody) -> None:
        """Advance joints and loops by a physics step under the loops' torques.

        Args:
            body: inertia and torques of links and load in the present state.
        """
        self.assumed_gravity[:] = body.assumed_gravity
        self.step()
        h = self._h
        # Friction is implicit: it stands with the inertia on the left of (M + I + drag) ω₊ = momentum.
        inertia = body.inertia + self._rotor
        momentum = inertia @ self.speed + h * (self.torque - body.bias)
        inertia[self._diagonal] += self.drag
        _, speed, _ = dposv(inertia, momentum)
        moved = self.angle + h * speed
        self.angle[:] = np.minimum(np.maximum(moved, self._lower), self._upper)
        # A joint at its stop rests.
        self.speed[:] = np.where(self.angle == moved, speed, 0.0)

    def _reference_law(self, n: int) -> casadi.Function:
        """Return (blend, u, loops) -> loops with the reference one physics step later."""
        arguments = symbols(blend=1, u=n, loops=3 * n)
        blend, u, loops = arguments
        r, c, z = casadi.vertsplit(loops, n)
        r, c = self._followed(blend, u, r, c)
        return casadi.Function("reference", arguments, [casadi.vertcat(r, c, z)])

    def _law(self, n: int) -> casadi.Function:
        """Return (blend, u, loops, θ, ω, ĝ) -> loops a physics step later, torque and drag for this step."""
        arguments = symbols(blend=1, u=n, loops=3 * n, theta=n, omega=n, gravity=n)
        blend, u, loops, theta, omega, gravity = arguments
        r, c, z = casadi.vertsplit(loops, n)
        r, c = self._followed(blend, u, r, c)
        following_error = _clip(r - theta, MAX_FOLLOWING_ERROR)
        e = c + self._position_gain * following_error - omega
        friction = self._compensation * self._drag(c) * c
        wanted_torque = self._velocity_gain * e + z + gravity + friction
        torque = _clip(wanted_torque, self._limit)
        # The integral waits while the torque is clipped.
        z = z + self._integral_gain * e * (wanted_torque == torque)
        # The reference waits for a joint that falls behind further than the largest following error.
        next_loops = casadi.vertcat(theta + following_error, c, z)
        return casadi.Function("step", arguments, [next_loops, torque, self._drag(omega)])

    def _followed(self, blend: SX, u: SX, r: SX, c: SX) -> tuple[SX, SX]:
        """Return the reference r and its speed c one physics step later, limited to the stops.

        `blend`, 1 − e^(−h/τ), is no constant: without a lag it is 1, and CasADi would then simplify the sum.
        """
        c = c + blend * (u - c)
        wanted = r + self._h * c
        r = casadi.fmin(casadi.fmax(wanted, self._lower), self._upper)
        return r, casadi.if_else(r == wanted, c, 0.0)

    def _drag(self, speed: SX) -> SX:
        """Return friction over speed, times the physics step."""
        return self._viscous + self._coulomb / casadi.fmax(casadi.fabs(speed), STICKING_SPEED)


def _clip(value: SX, limit: float | FloatArray) -> SX:
    """Return a value limited to ± limit."""
    return casadi.fmin(casadi.fmax(value, -limit), limit)
