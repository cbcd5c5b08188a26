"""A robot in messages with faults planted in them, in front of the logic of docs/examples/on_ros2.py."""

import math
import runpy
from types import SimpleNamespace

import numpy as np

from kit.documents import ROOT
from servobench.plant.contract.signals import Command
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import HandEyeModel, hand_eye_spec

EXAMPLE = ROOT / "docs" / "examples" / "on_ros2.py"
NODE = SimpleNamespace(**runpy.run_path(str(EXAMPLE)))
UR = find_robot("ur5e")
CAMERA = np.array(
    [[0.0, 0.0, -1.0, 2.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.4], [0.0, 0.0, 0.0, 1.0]]
)
MODEL = HandEyeModel(UR.arm, CAMERA)
START = np.array([0.1, -1.6, -2.0, -1.0, -1.5, 0.0])
WHOLE_WORLD = (-9.0, -9.0, -9.0, 9.0, 9.0, 9.0)


def link(period=0.05, **settings):
    """Return the logic of the node, for a UR5e."""
    config = NODE.ROS2Config(**{"box": WHOLE_WORLD, **settings})
    spec = hand_eye_spec(MODEL, period, config.speed, math.tau, UR.limits)
    return NODE.Link(config, spec, UR.arm)


def stamped(stamp, **fields):
    """Return a message with a stamp [ns]."""
    seconds, rest = divmod(stamp, 10**9)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=rest))
    return SimpleNamespace(header=header, **fields)


def joint_states(own, stamp, q, names=None):
    """Return joint states in alphabetical order, as drivers publish them."""
    at = dict(zip(names or own.config.joints, q, strict=True))
    ordered = sorted(at)
    return stamped(stamp, name=ordered, position=[at[name] for name in ordered])


def ball(stamp, point):
    """Return a point of the ball."""
    x, y, z = point
    return stamped(stamp, point=SimpleNamespace(x=x, y=y, z=z))


class Planted:
    """A robot whose messages go wrong from a period on, by the name of the fault.

    Attributes:
        sent: time [s] and velocities (n,) [rad/s] of each command.
        stopped: when the logic ended [s], or None.
        began: when the first message was wrong [s], or None.
    """

    def __init__(self, own, fault="", at=20, seed=0):
        self.own, self.fault, self.at = own, fault, at
        self.random = np.random.default_rng(seed)
        self.q, self.v = START.copy(), np.zeros(6)
        self.sent, self.stopped, self.began = [], None, None
        self.picture = None
        self.last = self.last_frame = 0  # stamps [ns]

    def play(self, periods=40):
        """Go through periods with four watches each, and return this."""
        T = self.own.spec.period
        for k in range(periods):
            wrong = self.fault if k >= self.at else ""
            if wrong and self.began is None:
                self.began = k * T
            self.q = self.q + T * self.v
            for quarter in range(4):
                self._quarter(k, quarter, wrong, (k + 0.25 * quarter) * T)
        return self

    def _quarter(self, k, quarter, wrong, now):
        if self.stopped is not None:
            return
        try:
            if quarter == 0:
                self._joints(k, wrong, now)
            if quarter == 1:
                self._ball(k, wrong, now)
                if wrong == "second_commander":
                    self.own.hear_command(SimpleNamespace(data=[0.5] * 6), now)
            self._control(wrong, now)
            self.own.watch(now)
            self.own.check()
        except (RuntimeError, ValueError, KeyError, TypeError) as error:
            self.own.end(repr(error))
            self.stopped = now
            self.v = np.zeros(6)

    def _joints(self, k, wrong, now):
        if wrong in {"joints_lost", "node_killed"}:
            return
        stamp = round(now * 1e9) + 10**18
        names = None
        q = self.q
        if wrong == "joints_frozen":
            stamp = self.last
        self.last = stamp
        if wrong == "joints_backwards":
            stamp -= 10**11
        if wrong == "joints_nan":
            q = np.where(np.arange(6) == k % 6, np.nan, q)
        if wrong == "joint_missing":
            names = [*self.own.config.joints[:5], "wrist_4_joint"]
        if wrong == "gripper":
            self.own.hear_joints(stamped(stamp + 5, name=["finger"], position=[0.4]), now)
        self.own.hear_joints(joint_states(self.own, stamp, q, names), now)

    def _ball(self, k, wrong, now):
        if wrong in {"ball_lost", "node_killed"} or (
            wrong == "ball_late" and (k - self.at) % 2 == 0
        ):
            return
        stamp = round(now * 1e9) + 10**18
        point = MODEL.feature(self.q) + 1e-4 * self.random.normal(size=3)
        if self.picture is None or wrong != "picture_frozen":
            self.picture = point
        if wrong == "stamps_frozen":
            stamp = self.last_frame
        self.last_frame = stamp
        if wrong == "ball_nan" or (wrong == "one_frame_lost" and k == self.at):
            self.picture = np.full(3, math.nan)
        if wrong == "ball_infinite":
            self.picture = np.array([math.inf, 0.0, 1.0])
        self.own.hear_ball(ball(stamp, self.picture), now)

    def _control(self, wrong, now):
        if self.own.ready and np.isinf(self.own.began):
            self.own.observe()
        if np.isinf(self.own.began) or wrong == "controller_late":
            return
        wanted = self.random.uniform(-3.0, 3.0, 6)
        if wrong == "command_nan":
            wanted[2] = math.nan
        if wrong == "runs_away":
            wanted = np.full(6, 3.0)
        command = Command(wanted).joint_velocity
        self.v = self.own.send(command, now)
        self.sent.append((now, self.v))
