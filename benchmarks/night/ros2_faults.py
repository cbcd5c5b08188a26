"""Faults planted into a served robot of ROS 2, before docs/examples/on_ros2.py: does the arm stop in time, by name?

    ROS_DOMAIN_ID=9 PYTHONPATH=tests:benchmarks python -m night.ros2_faults --faults 210               simulated time
    ROS_DOMAIN_ID=9 PYTHONPATH=tests:benchmarks python -m night.ros2_faults --faults 42 --rate 20      real time

Robot and node are processes, which talk through ROS 2. It needs rclpy, and prints a line for each fault
and the sums. A run counts as stopped when the robot follows velocities of zero for good. A picture that is frozen is
seen once the joints have moved by a thousandth of a radian, so its time is not among those of the others.
"""

import argparse
import contextlib
import multiprocessing
import os
import re
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import servobench
from servobench.harness.apps.serve import ros2
from servobench.harness.apps.serve.served import Served
from servobench.harness.config.settings import Settings
from servobench.harness.run.loop import careful
from servobench.harness.run.request import RunRequest

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "on_ros2.py"
NAMES = {  # fault -> a part of the reason; empty for none
    "nothing": "",
    "joints_shuffled": "",
    "one_frame_lost": "",
    "joints_lost": "joint_states: late, lost or frozen",
    "joints_frozen": "joint_states: late, lost or frozen",
    "joints_nan": "joint_position must be finite",
    "joint_renamed": "KeyError",
    "ball_lost": "feature: late, lost or frozen",
    "stamps_frozen": "feature: late, lost or frozen",
    "ball_nan": "feature: not found",
    "ball_infinite": "feature: not found",
    "picture_frozen": "feature: not found",
    "robot_killed": "late, lost or frozen",
    # In simulated time its commands also move the clock, so that messages can be late first.
    "second_commander": "another node commands the robot|late, lost or frozen",
}
LIMIT = 0.25  # [rad/s], the example's own


class Faulty(ros2.Robot):
    """A robot whose messages go wrong from a period on."""

    def plant(self, fault, at, seed):
        """Say what goes wrong, and from which frame on."""
        self.fault, self.at, self.frame = fault, at, -1
        self.random = np.random.default_rng(seed)
        self.over = False
        self.log = []  # time of the plant [s] and velocities followed [rad/s]
        self.began = None
        self.kept = {}
        advance = self._served.advance

        def logged(velocity):
            self.log.append((self._served.rollout.observation.time, velocity.copy()))
            return advance(velocity)

        self._served.advance = logged

    def end(self):
        """End the robot."""
        self.over = True
        self._velocities.came = True

    def _messages(self, *, has_frame):
        if self.over:
            raise KeyboardInterrupt
        news = super()._messages(has_frame=has_frame)
        # Frames count from the first command on.
        commanded = self.frame >= 0 or any(v.any() for _, v in self.log[-1:])
        self.frame += bool(has_frame and commanded)
        if self.frame < self.at:
            self.kept.update((id(publisher), message) for publisher, message in news)
            return news
        if self.began is None:
            self.began = self._served.rollout.observation.time
        return [each for each in news if self._spoil(*each)]

    def _spoil(self, publisher, message):
        """Change a message in its place; return whether it is sent."""
        fault = self.fault
        if fault == "robot_killed":
            return publisher is self._clock
        if publisher is self._joints:
            if fault == "joints_frozen":
                message.header.stamp = self.kept[id(publisher)].header.stamp
            if fault == "joints_nan":
                message.position[self.frame % 6] = np.nan
            if fault == "joint_renamed":
                message.name = [*message.name[:5], "other_joint"]
            if fault == "joints_shuffled":
                order = self.random.permutation(6)
                message.name = [message.name[k] for k in order]
                message.position = [message.position[k] for k in order]
            return fault != "joints_lost"
        if publisher is self._ball:
            point = message.point
            if fault == "stamps_frozen":
                message.header.stamp = self.kept[id(publisher)].header.stamp
            if fault == "ball_nan" or (fault == "one_frame_lost" and self.frame == self.at):
                point.x = point.y = point.z = np.nan
            if fault == "ball_infinite":
                point.z = np.inf
            if fault == "picture_frozen":
                message.point = self.kept[id(publisher)].point
            return fault != "ball_lost"
        return True


class Second:
    """Another node that commands, from the period of the fault on."""

    def __init__(self, robot):
        self.robot = robot

    def run(self):
        """Wait for the fault, and command until the robot ends."""
        rclpy = ros2.rclpy
        context = rclpy.Context()
        rclpy.init(context=context)
        node = rclpy.create_node("second", context=context)
        commands = node.create_publisher(
            ros2.Float64MultiArray, "forward_velocity_controller/commands", 10
        )
        while self.robot.began is None and not self.robot.over:
            time.sleep(0.001)
        if not self.robot.over:
            commands.publish(ros2.Float64MultiArray(data=[0.05] * 6))
        while not self.robot.over:
            time.sleep(0.01)
        context.try_shutdown()


def settings_of(rate):
    """Return the settings that robot and node share, and whether time is simulated."""
    period = 1.0 / (rate or 20.0)
    return {"run": {"period": period}, "target": {"duration": 60.0 * period}}, not rate


def robots(pipe, rate):
    """Serve a robot for each (fault, at, seed) that comes, until something else comes; send its log back."""
    ros2.SILENCE = 0.5
    common, lockstep = settings_of(rate)
    while (asked := pipe.recv()) is not None:
        fault, at, seed = asked
        request = RunRequest("kinematic", "constant", "target", "moderate", seed, robot="ur5e")
        with careful():
            served = Served(
                request, Settings(common), lambda _: None, lockstep=lockstep, stamps=True
            )
            robot = Faulty(served, lambda _: None, lockstep=lockstep)
        robot.plant(fault, at, seed)
        threads = [threading.Thread(target=serve, args=(robot,))]
        if fault == "second_commander":
            threads.append(threading.Thread(target=Second(robot).run))
        for each in threads:
            each.start()
        pipe.recv()
        robot.end()
        for each in threads:
            each.join()
        served.plant.close()
        pipe.send((robot.log, robot.began, served.plant.spec.period))


def serve(robot):
    """Serve a robot until it ends."""
    with careful(), contextlib.suppress(KeyboardInterrupt):
        robot.serve()


def episode(pipe, fault, at, seed, rate):
    """Return reason, time of the last motion after the fault [periods], and the largest velocity [rad/s]."""
    common, lockstep = settings_of(rate)
    period = common["run"]["period"]
    pipe.send((fault, at, seed))
    node = {"simulated": lockstep, "box": [-2.0, -2.0, -2.0, 2.0, 2.0, 2.0]}
    made = servobench.run(
        "ukf_mfac", plant=str(EXAMPLE), task="target", robot="ur5e", mismatch="none", seed=seed,
        settings={**common, "ROS2": node},
    )  # fmt: skip
    # The robot stands now; what it still follows is in its log.
    time.sleep(4.0 * period)
    pipe.send(None)
    log, began, step = pipe.recv()
    largest = max((np.abs(v).max() for _, v in log), default=0.0)
    moving = [time for time, v in log if v.any()]
    after = 0.0
    if began is not None and moving:
        after = (moving[-1] + step - began) / period
    return str(made.row["reason"] or ""), after, largest, began is not None


def main():
    """Plant faults in turn and print what came of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument(
        "--rate", type=float, default=0.0, help="Hz, of real time; 0: simulated time"
    )
    given = parser.parse_args()
    random = np.random.default_rng(0)
    sums = Counter()
    times = []
    names = list(NAMES)
    pipe, theirs = multiprocessing.Pipe()
    context = multiprocessing.get_context("spawn")
    other = context.Process(target=robots, args=(theirs, given.rate), daemon=True)
    other.start()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for k in range(given.faults):
            fault, at = names[k % len(names)], int(random.integers(5, 40))
            reason, after, largest, planted = episode(pipe, fault, at, k, given.rate)
            sums["within the limits"] += bool(largest <= LIMIT)
            sums["ended before its fault"] += not planted
            if planted:
                wanted = NAMES[fault]
                sums["planted"] += 1
                sums["named"] += bool(re.search(wanted, reason)) if wanted else not reason
                if wanted and fault != "picture_frozen":
                    times.append(after)
            print(
                f"{k:4d} {fault:18s} {at:3d} {after:7.2f} {largest:6.3f} {reason[:70]}", flush=True
            )
    pipe.send(None)
    other.join()
    stopped = sum(each <= 2.0 + 1e-9 for each in times)
    print(f"{given.faults} runs: {dict(sums)}")
    print(
        f"{stopped} of {len(times)} stopped within two periods, the longest after {max(times):.2f}"
    )


if __name__ == "__main__":
    main()
