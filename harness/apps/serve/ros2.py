"""A plant as the robot of ROS 2: joint states and the ball go out as messages, joint velocities come in.

    joint_states                            sensor_msgs/JointState        500 Hz; in lockstep once a period
    feature                                 geometry_msgs/PointStamped    a frame: the ball's centre, camera frame [m];
                                                                          NaN where it was not found
    clock                                   rosgraph_msgs/Clock           in lockstep
    forward_velocity_controller/commands    std_msgs/Float64MultiArray    joint velocities in the arm's order [rad/s]

The stamp of a ball is the exposure of its frame. In lockstep the clock waits for the command of each period, so that a
run is the same on every machine; what was published is repeated meanwhile, for nodes that come late. Nothing here keeps
an arm safe: it stands in for a robot that has its own limits.
"""

import math
import time
from typing import Any, TypeAlias, final

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PointStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header

from servobench.harness.apps.serve.served import WATCHDOG, Served, Velocities
from servobench.harness.apps.serve.wire import Say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import Observation

HEARTBEAT = 0.05  # [s] after which lockstep repeats what it published
SILENCE = 10.0  # [s] for which lockstep waits for a command by the wall clock, once one has come
QUEUE = 10  # messages that wait for a slow reader
NANOSECONDS = 1_000_000_000  # in a second
NEWER = 1_000  # [ns] by which the stamp of a frame without a ball is later than the last one
News: TypeAlias = list[tuple[Any, Any]]  # publishers, each with its message


@final
class Robot:
    """The node around a served plant."""

    def __init__(self, served: Served, say: Say, *, lockstep: bool) -> None:
        """Take a plant whose feature is a point, and a printer of lines.

        Raises:
            ConfigurationError: another feature.
        """
        spec = served.plant.spec
        if spec.m != 3 or spec.feature_unit != "m":
            raise ConfigurationError(
                f"--protocol ros2 sends a point in m: use --sensing position, got {spec.feature_names}"
            )
        self._served = served
        self._say = say
        self._lockstep = lockstep
        self._velocities = Velocities(spec.n, WATCHDOG * served.frames * spec.period, say)
        names = [_name_of(joint) for joint in spec.joint_names]
        self._order = np.argsort(names)  # since a driver's order is not that of the arm
        self._names = sorted(names)
        self._epoch = 0
        self._exposed = -(2**62)  # before any stamp

    def serve(self) -> None:
        """Keep the clock until interrupted.

        Raises:
            RunFault: the plant cannot go on.
        """
        context = rclpy.Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("servobench", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            self._serve(node, executor)
        finally:
            executor.shutdown()
            node.destroy_node()
            context.try_shutdown()

    def _serve(self, node: Any, executor: SingleThreadedExecutor) -> None:  # noqa: ANN401 - rclpy's
        commands = "forward_velocity_controller/commands"
        node.create_subscription(Float64MultiArray, commands, self._receive, QUEUE)
        self._clock = node.create_publisher(Clock, "/clock", QUEUE)
        self._joints = node.create_publisher(JointState, "joint_states", QUEUE)
        self._ball = node.create_publisher(PointStamped, "feature", QUEUE)
        due = time.monotonic()
        clocked = "lockstep"
        if not self._lockstep:
            self._epoch = node.get_clock().now().nanoseconds
            clocked = "real time"
        self._say(f"serving joint_states and feature, following {commands}, in {clocked}")
        self._say("conformance with these messages is checked, safety is not; Ctrl-C ends it")
        has_frame = True
        while True:
            news = self._messages(has_frame=has_frame)
            if self._lockstep:
                self._await_command(executor, news)
            else:
                _publish(news)
                due = self._served.next_period(due, time.monotonic())
                while (left := due - time.monotonic()) > 0.0:
                    executor.spin_once(left)
            has_frame = self._served.advance(self._velocities.at(time.monotonic()))

    def _receive(self, message: Float64MultiArray) -> None:
        self._velocities.take(message.data, time.monotonic())

    def _await_command(self, executor: SingleThreadedExecutor, news: News) -> None:
        """Publish the news until the command of this period comes; once one has come, not for ever."""
        began = time.monotonic()
        commanded = self._velocities.came
        self._velocities.came = False
        while not self._velocities.came:
            _publish(news)
            executor.spin_once(HEARTBEAT)
            if commanded and time.monotonic() - began > SILENCE:
                self._velocities.stop(f"no command for {SILENCE:g} s of the wall clock")

    def _messages(self, *, has_frame: bool) -> News:
        """Return what is to be published now."""
        seen = self._served.rollout.observation
        now = _message(self._nanoseconds(seen.time))
        joints = seen.joint_position[self._order].tolist()
        header = Header(stamp=now, frame_id="base")
        news = [(self._joints, JointState(header=header, name=self._names, position=joints))]
        if self._lockstep:
            news.append((self._clock, Clock(clock=now)))
        if has_frame:
            point = Point(x=math.nan, y=math.nan, z=math.nan)
            if seen.feature_valid:
                point.x, point.y, point.z = seen.feature.tolist()
            header = Header(stamp=_message(self._exposure(seen)), frame_id="camera")
            news.append((self._ball, PointStamped(header=header, point=point)))
        return news

    def _exposure(self, seen: Observation) -> int:
        """Return the stamp of the present frame [ns], which is newer than the last one also where it shows nothing."""
        exposed = float(seen.capture_time)
        if math.isnan(exposed):
            exposed = seen.time
        self._exposed = max(self._nanoseconds(exposed), self._exposed + NEWER)
        return self._exposed

    def _nanoseconds(self, seconds: float) -> int:
        return self._epoch + round(seconds * NANOSECONDS)


def _name_of(joint: str) -> str:
    """Return the name of a joint in `joint_states`: the bench's, with `_joint` as drivers have it."""
    if "joint" in joint:
        return joint
    return f"{joint}_joint"


def _message(nanoseconds: int) -> Time:
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)


def _publish(news: News) -> None:
    for publisher, message in news:
        publisher.publish(message)
