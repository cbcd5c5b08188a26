"""A made-up arm whose Jacobian is constant, so that whatever a controller of it promises can be checked exactly."""

import dataclasses
from collections import deque
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.networks.config import (
    ControllerTraining,
    JacobianTraining,
    TrainingConfig,
)
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.rbf import ControllerNetwork, JacobianNetwork, hidden_features
from servobench.controllers.stages.finish import Finish
from servobench.plant.contract.features import Derivatives, FeatureModel
from servobench.plant.contract.lanes import take
from servobench.plant.contract.signals import Observation, PlantSpec
from servobench.plant.robot.parametric import POSE

N, M, PERIOD, PREVIEW, LIMIT = 5, 3, 0.05, 10, 1.0
TRAINING = TrainingConfig(  # of the smallest networks of a plant of two joints
    (0.5, 0.5),
    (1.5, 1.5),
    jacobian=JacobianTraining(centres=8, samples=60),
    controller=ControllerTraining(hidden=4, samples=60),
)


def plant_spec(n, m, speed=1.0, reach=6.0):
    """Return a plant of which all joints have the same limits: speed, rad/s, and reach, rad."""
    names = (tuple(f"{letter}{i}" for i in range(size)) for letter, size in (("j", n), ("y", m)))
    return PlantSpec.of_joints(
        *names, np.full(n, speed), np.full(n, -reach), np.full(n, reach), PERIOD
    )


class SineModel(FeatureModel):
    """The parametric model of a made-up robot y = A sin(B ((1 + gear) q + zero)), whose camera changes nothing."""

    names = ()

    def __init__(self, A, B):
        self.A = A
        self.B = B
        self.n = len(B)
        joints = range(self.n)
        gears = [f"gear_j{i}" for i in joints]
        zeros = [f"zero_j{i}" for i in joints]
        pose = [f"camera_{each}" for each in POSE]
        self.names = (*gears, *zeros, *pose)

    def start(self, lead):
        return np.zeros((*lead, len(self.names))), np.broadcast_to(np.eye(4), (*lead, 1, 4, 4))

    def moved(self, theta, cameras, step):
        theta = theta + step
        theta[..., self.pose_columns] = 0.0
        return theta, cameras

    def derivatives(self, theta, cameras, joints, turn=None):
        gear = 1.0 + theta[..., None, : self.n]
        angle = self.B * (gear * joints + theta[..., None, self.n : 2 * self.n])
        slope = self.A * (self.B * np.cos(angle))[..., None, :]
        pose = np.zeros((*slope.shape[:-1], 6))
        by_parameter = np.concatenate([slope * joints[..., None, :], slope, pose], axis=-1)
        return Derivatives(
            np.matvec(self.A, np.sin(angle)), slope * gear[..., None, :], by_parameter
        )


def seen(q, y, valid=True, k=0):
    """Return what is observed in period k."""
    return Observation(k * PERIOD, np.asarray(q, dtype=float), np.asarray(y, dtype=float), valid)


def motion(dq, dy, e=None, q=None, duration=PERIOD):
    """Return a motion of the joints by dq and of the feature by dy."""
    dq, dy = np.asarray(dq, dtype=float), np.asarray(dy, dtype=float)
    return Motion(
        np.zeros(dq.size) if q is None else q,
        dq,
        dy,
        np.zeros(dy.size) if e is None else e,
        duration,
    )


class Recorded(NamedTuple):
    """The state of a `Recorder`."""

    J: np.ndarray


class Recorder(Estimator):
    """An estimator that keeps the motions it is given and learns nothing."""

    def __init__(self):
        self.motions = []

    def start(self, jacobian):
        return Recorded(jacobian)

    def update(self, state, motion):
        self.motions.append(motion)
        return state

    def diagnostics(self, state):
        return {"motions": len(self.motions)}


class Learning:
    """An estimator with the state of one run, or of several side by side."""

    def __init__(self, estimator, jacobian):
        self.estimator, self.state = estimator, estimator.start(jacobian)

    def update(self, motion):
        self.state = self.estimator.update(self.state, motion)

    def jacobian(self, q=None):
        return self.estimator.jacobian(self.state, q)

    def diagnostics(self):
        return self.estimator.diagnostics(self.state)


def jacobian_features(q, centres, widths):
    """Return the hidden layers θ of all joint columns by the plain formula, (..., n, L), at q, (..., n), rad."""
    layers = [
        hidden_features(q, *column, "gaussian") for column in zip(centres, widths, strict=True)
    ]
    return np.stack(layers, axis=-2)


def jacobian_network(n=3, m=2, units=4, seed=0):
    """Return a random Jacobian network."""
    rng = np.random.default_rng(seed)
    shapes = rng.normal(size=(n, units, n)), rng.uniform(1.0, 2.0, (n, units))
    return JacobianNetwork(*shapes, rng.normal(size=(n, m, units)))


def planar_jacobian(q):
    """Return that of the tip of a planar arm with two or three links, of 0.5, 0.4 and 0.3 m."""
    lengths, angle = np.array([0.5, 0.4, 0.3])[: q.shape[-1]], np.cumsum(q, axis=-1)
    x, y = lengths * np.sin(angle), lengths * np.cos(angle)
    return np.stack(
        [np.stack([-x[..., i:].sum(-1), y[..., i:].sum(-1)], -1) for i in range(len(lengths))], -1
    )


TURN = Rotation.from_rotvec(np.radians(120.0) * np.array([0.36, 0.48, 0.8])).as_matrix()
NETWORK = jacobian_network(N, M, units=6)
NETWORK = dataclasses.replace(NETWORK, weights=0.3 * NETWORK.weights)


def path(duration, period=PERIOD, seed=1):
    """Return joint positions, rad, of an arm that speeds up, turns and brakes, at the begin of each period."""
    rng, t = np.random.default_rng(seed), period * np.arange(round(duration / period))[:, None]
    speed = (
        0.8
        * np.sin(2 * np.pi * t / rng.uniform(0.75, 2.0, N) + rng.uniform(0.0, 6.0, N))
        * np.minimum(1, t / 0.15)
    )
    return np.concatenate([np.zeros((1, N)), np.cumsum(period * speed, axis=0)])


def late_features(q, turn, delay=0, network=NETWORK):
    """Return features along a path, late by `delay` periods: summed in the very steps in which they are predicted."""
    J = network.jacobian(q)
    steps = np.matvec(turn @ (J[1:] + J[:-1]) / 2.0, np.diff(q, axis=0))
    y = np.concatenate([np.zeros((1, M)), np.cumsum(steps, axis=0)])
    return np.concatenate([np.repeat(y[:1], delay, axis=0), y[: len(y) - delay]])


def assert_lanes(run):
    """Check that each of three lanes has the same bits alone and among others, in any order; return all together."""
    order = np.array([2, 0, 1])
    together, permuted = run(np.arange(3)), run(order)
    for place, lane in enumerate(order):
        alone = run(lane)
        _assert_lane(together, lane, alone)
        _assert_lane(permuted, place, alone)
    return together


def _assert_lane(results, lane, alone):
    if isinstance(alone, dict):  # lanes may have more to tell together
        results, alone = [results[key] for key in alone], [*alone.values()]
    if isinstance(alone, list):
        for one, own in zip(results, alone, strict=True):
            _assert_lane(one, lane, own)
    else:
        np.testing.assert_equal(take(results, lane), alone)


A = 0.4 * np.random.default_rng(11).normal(size=(M, N))  # m/rad
SPEC = plant_spec(N, M, LIMIT)
KNOWLEDGE = RobotKnowledge(SPEC, PREVIEW, lambda q: np.broadcast_to(A, (*np.shape(q)[:-1], M, N)))


def networks():
    """Networks as after training within ±2 rad: units so wide that Ĵ_net = A everywhere; any controller network."""
    rng = np.random.default_rng(2)
    centres = np.broadcast_to(np.array([[-2.0], [2.0]]), (N, 2, N))
    jacobian = JacobianNetwork(
        centres, np.full((N, 2), 1e9), np.repeat(A.T[:, :, None] / 2.0, 2, axis=2)
    )
    centres = rng.normal(size=(8, M + N))
    weights = 0.02 * rng.normal(size=(N, M + N, 8))
    weights[:, M:] += np.eye(N)[:, :, None] / 8
    return TrainedNetworks(
        jacobian, ControllerNetwork(centres, np.full(8, 3.0), weights, 1, 1), 0.0, 0.0, ""
    )


def only_jacobian(network):
    """What an estimator takes, of trained networks of which it looks at the Jacobian network alone."""
    return SimpleNamespace(jacobian=network)


def only_controller(network):
    """What the law `rbfnn` takes, of trained networks of which it looks at the controller network alone."""
    return SimpleNamespace(controller=network)


class Commanding:
    """A law, and the last stages where `knowledge` is given, with the state of one run, or of several side by side."""

    def __init__(self, law, observation, knowledge=None, **aids):
        self.law, self.state, self.aids = law, law.start(observation), AidsConfig(**aids)
        self.finish = knowledge and Finish(self.aids, knowledge, type(law).__name__, law.owns)
        self.limited = np.full(observation.feature.shape[:-1], False)[()]

    def command(self, estimate, observation, reference):
        state, wanted = self.law.command(self.state, estimate, observation, reference)
        u = wanted
        if self.finish:
            forward = (
                reference[..., 1, :] - reference[..., 0, :]
                if self.aids.feedforward
                else np.zeros(())
            )
            u, self.limited = self.finish.finish(
                wanted, estimate.jacobian, observation.joint_position, forward
            )
            u = self.law.restrained(state, wanted, u)
        self.state = self.law.noted(state, u, self.limited)
        return u

    def diagnostics(self):
        return self.law.diagnostics(self.state)


class ToyArm:
    """q(k+1) = q(k) + Σ_i g_i dq(k−i), y(k) = turn A q(k − latency)."""

    def __init__(self, turn, response=(0.0, 1.0), latency=0):
        self.turn, self.response = turn, np.asarray(response)
        self.q, self.k = np.zeros(N), 0
        self.commands = deque([np.zeros(N)] * len(response), maxlen=len(response))
        self.seen = deque([np.zeros(M)] * (latency + 1), maxlen=latency + 1)

    def observe(self):
        return seen(self.q, self.seen[0], k=self.k)

    def step(self, u):
        self.commands.appendleft(u * PERIOD)
        self.q = self.q + self.response @ np.array(self.commands)
        self.k += 1
        self.seen.append(self.turn @ A @ self.q)
        return self.observe()

    def end(self):
        """Where the feature will be when all commands up to now are done."""
        left = np.append(np.cumsum(self.response[:0:-1])[::-1], 0.0)
        return self.turn @ A @ (self.q + left @ np.array(self.commands))
