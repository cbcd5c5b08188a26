"""A controller of the bench as a node of ROS 2, for a robot or for: servobench serve --protocol ros2 --task target.

python on_ros2.py ukf_mfac --out log --dry-run; conformance with the messages is checked on the bench, safety nowhere.
"""

import gc
import math
import os
import sys
import time
from collections import deque
from dataclasses import dataclass
from threading import Condition, Thread

import numpy as np

import servobench
from servobench.harness.cli.main import main
from servobench.plant.robot.hand_eye import hand_eye_spec

try:
    import rclpy
    from geometry_msgs.msg import PointStamped
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.serialization import deserialize_message
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray
except ImportError:
    rclpy = None
try:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore
except ImportError:
    Writer = None

JOINTS, BALL, COMMANDS = "joint_states", "feature", "forward_velocity_controller/commands"


@dataclass(frozen=True)
class ROS2Config:
    """Settings: --set ROS2.speed=0.5."""

    joints: tuple[str, ...] = (
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
    )
    """names in joint_states, in the arm's order"""
    speed: float = 0.25  # [rad/s] of every joint at most
    box: tuple[float, ...] = (-1.0, -1.0, 0.0, 1.0, 1.0, 1.5)
    """[m] lower and upper corner for the ball, base frame"""
    patience: float = 1.5  # [control periods] for messages and for the controller
    still: float = 1e-3  # [rad] by which joints may move while frames show the same to the last bit
    simulated: bool = False  # time is that of /clock
    dry_run: bool = False  # command nothing
    bag: str = ""  # folder of a new rosbag2 with all messages


class Link:
    """Decides from messages and their times [s], on one clock, what may be sent; it needs no ROS.

    `fault` is why it has ended, and empty before.
    """

    def __init__(self, config, spec, arm):
        self.config, self.spec, self.arm = config, spec, arm
        self.low = np.append(spec.joint_lower, config.box[:3])
        self.high = np.append(spec.joint_upper, config.box[3:])
        self.patience = config.patience * spec.period
        self.news = {}
        self.stamps = {}
        self.came = self.began = np.inf
        self.k = 0
        self.lost = 1
        self.sent = deque(maxlen=100)
        self.feature = None
        self.fault = ""

    @property
    def ready(self):
        """Whether joints and ball are newer than those of the last observation."""
        return len(self.news) == 2

    def end(self, why):
        """End, for the first reason."""
        self.fault = self.fault or why

    def hear_joints(self, message, now):
        """Take joints by name, in any order and among others."""
        at = dict(zip(message.name, message.position, strict=False))
        if not at.keys().isdisjoint(self.config.joints):
            self.hear(JOINTS, message, [at[name] for name in self.config.joints], now)

    def hear_ball(self, message, now):
        """Take the ball's centre in the camera frame [m]; NaN where the frame does not show it."""
        self.hear(BALL, message, [message.point.x, message.point.y, message.point.z], now)

    def hear(self, topic, message, numbers, now):
        """Take a message if its stamp is later than those before."""
        at = message.header.stamp
        stamp = at.sec + 1e-9 * at.nanosec
        if stamp > self.stamps.get(topic, -np.inf):
            self.stamps[topic] = stamp
            self.news[topic] = np.where(np.isinf(numbers), np.nan, numbers)
            if self.ready:
                self.came = self.stamps[JOINTS] if self.config.simulated else now

    def hear_command(self, message, now):
        """End where somebody else commands."""
        if tuple(message.data) not in self.sent:
            self.end("another node commands the robot")

    def watch(self, now):
        """End where a message or the controller is late."""
        if not self.ready and now - self.came > self.patience:
            self.end(f"{BALL if JOINTS in self.news else JOINTS}: late, lost or frozen")
        if self.sent and now - self.began > self.patience:
            self.end("the controller is late")

    def check(self):
        """Raise the fault."""
        if self.fault:
            raise RuntimeError(self.fault)

    def observe(self):
        """Return the next observation, or raise why there is none."""
        self.check()
        q = self.news.pop(JOINTS)
        ball = self.news.pop(BALL)
        self.began = self.came
        found = np.isfinite(ball).all()
        if found:
            if not np.array_equal(ball, self.feature):
                # By its latency the first picture stays while the arm begins to move [rad]
                self.still = 0.1 if self.feature is None else self.config.still
                self.posture = q
            self.feature = ball
            self.captured = self.stamps[BALL]
            # A picture that stays the same while the joints move is frozen
            found = not np.ptp(q - self.posture) >= self.still
        self.lost = 0 if found else self.lost + 1
        if self.lost > 1:
            raise RuntimeError("feature: not found, or the same in two frames as the joints move")
        self.q = q
        now = self.k * self.spec.period
        self.k += 1
        return servobench.Observation(now, q, self.feature, found, capture_time=self.captured)

    def send(self, velocity, now):
        """Return the joint velocities to publish, (n,) [rad/s], or raise why there are none."""
        self.watch(now)
        v = np.clip(velocity, self.spec.command.lower, self.spec.command.upper)
        ahead = self.q + 2.0 * self.spec.period * v
        ends = np.append(ahead, self.arm.ball(self.arm.frames(ahead)))
        if not np.array_equal(ends, np.clip(ends, self.low, self.high)):
            self.end(f"joints or ball leave their range: {ends.round(3)}")
        self.check()
        self.began = np.inf
        self.sent.append(tuple(v))
        return v


class ROS2(servobench.Plant):
    """The robot as a plant of the bench, whose loop drives it; a thread hears, watches and lets the arm stand."""

    def __init__(self, config: ROS2Config, setup):
        if rclpy is None:
            raise ValueError(
                "it needs rclpy: on Python 3.12 pip install 'servobench[ros2]', "
                "or source an installed ROS 2"
            )
        self.spec = hand_eye_spec(setup.model, setup.period, config.speed, math.tau, setup.limits)
        self.link = Link(config, self.spec, setup.nominal.arm)
        self.config, self.turn, self.thread, self.bag = config, Condition(), None, None

    def reset(self, seed):
        gc.collect()
        gc.freeze()  # or Python looks through all that is imported, 40 ms, while the arm moves
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node(
            "controller",
            parameter_overrides=[rclpy.Parameter("use_sim_time", value=self.config.simulated)],
        )
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        if self.config.bag:
            self.bag = Writer(self.config.bag, version=9, storage_plugin=StoragePlugin.MCAP)
            self.bag.open()
        # First, as the next joints may wait beside the command that they answer
        self.listen(
            COMMANDS, "std_msgs/msg/Float64MultiArray", Float64MultiArray, self.link.hear_command
        )
        self.listen(JOINTS, "sensor_msgs/msg/JointState", JointState, self.link.hear_joints)
        self.listen(BALL, "geometry_msgs/msg/PointStamped", PointStamped, self.link.hear_ball)
        self.commands = self.node.create_publisher(Float64MultiArray, COMMANDS, 10)
        self.thread = Thread(target=self.spin, daemon=True)
        self.thread.start()
        return self.observe()

    def listen(self, topic, name, kind, take):
        if self.bag:
            store = get_typestore(Stores.ROS2_KILTED)
            connection = self.bag.add_connection(f"/{topic}", name, typestore=store)

        def hear(packed):
            with self.turn:
                take(deserialize_message(packed, kind), self.now())
                self.turn.notify()
                if self.bag:
                    at = time.time_ns()
                    if self.config.simulated:
                        at = round(1e9 * self.link.stamps.get(JOINTS, 0.0))
                    self.bag.write(connection, at, packed)

        # From any publisher, also from one that does not repeat lost messages
        self.node.create_subscription(kind, topic, hear, qos_profile_sensor_data, raw=True)

    def now(self):
        if self.config.simulated:
            return 1e-9 * self.node.get_clock().now().nanoseconds
        return time.monotonic()

    def spin(self):
        try:
            while not self.link.fault:
                self.executor.spin_once(timeout_sec=self.spec.period / 4.0)
                with self.turn:
                    self.link.watch(self.now())
        except Exception as error:  # noqa: BLE001 - whatever it is, the arm has to stand
            self.link.end(repr(error))
        with self.turn:
            self.publish(np.zeros(self.spec.n))
            self.turn.notify()

    def publish(self, velocity):
        if not self.config.dry_run:
            self.commands.publish(Float64MultiArray(data=velocity.tolist()))

    def observe(self):
        with self.turn:
            if not self.turn.wait_for(self.may_go_on, 20.0):  # [s] of the wall clock
                self.link.end("joints and ball do not come, or nobody follows commands")
            return self.link.observe()

    def may_go_on(self):
        # This node hears its own commands
        return self.link.fault or (self.link.ready and self.commands.get_subscription_count() > 1)

    def step(self, command):
        with self.turn:
            self.publish(self.link.send(command.joint_velocity, self.now()))
        return self.observe()

    def truth(self):
        return servobench.Truth(self.link.feature, None)  # as measured: nobody knows more

    def close(self):
        if self.thread:
            self.link.end("closed")
            self.thread.join(2.0)
            time.sleep(0.1)  # until the last command has come
            rclpy.try_shutdown()
        if self.bag:
            self.bag.close()


if __name__ == "__main__":
    # This machine alone, unless its user says otherwise
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    usual = "run --no-isolate --robot ur5e --mismatch none --task target --no-figures --plant"
    given = (word.replace("--dry-run", "--set=ROS2.dry_run=true") for word in sys.argv[1:])
    sys.argv[1:] = [*usual.split(), __file__, *given]
    main()
