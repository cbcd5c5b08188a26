"""A controller of the bench on a UR, or on its double: servobench serve --robot ur5e --task target --mismatch severe.

python on_a_ur.py ukf_mfac --out log --dry-run; conformance with ur-rtde 1.6.5 is checked on the double, safety nowhere.
"""

import faulthandler
import gc
import json
import socket
import sys
import time
from dataclasses import dataclass
from select import select
from threading import Thread

import numpy as np
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface

import servobench
from servobench.harness.cli.main import main
from servobench.plant.rendered.detection import find_patch, locate_ball
from servobench.plant.robot.hand_eye import hand_eye_spec


@dataclass(frozen=True)
class URConfig:
    """Settings: --set UR.speed=0.5."""

    host: str = "127.0.0.1"
    speed: float = 0.25  # [rad/s] of every joint at most
    acceleration: float = 5.0  # [rad/s²]
    box: tuple[float, ...] = (
        -1.0,
        -1.0,
        0.0,
        1.0,
        1.0,
        1.5,
    )  # [m] lower and upper corner for the flange, base frame
    patience: float = 1.5  # [control periods] for a frame, the robot's clock and the controller
    dry_run: bool = False  # command nothing


class Served:
    """Features of `servobench serve`, lines of JSON.

    `read` returns (m,), whether it is valid, its time [s], and when it was exposed by the camera's clock [s], or NaN.
    """

    def __init__(self, host, patience):
        self.lines = socket.create_connection((host, 30020), timeout=patience).makefile(
            "rb", buffering=0
        )

    def read(self):
        frame = json.loads(self.lines.readline())
        while select([self.lines], [], [], 0.0)[0]:  # the last one, where some wait
            frame = json.loads(self.lines.readline())
        captured = frame.get("capture_time", np.nan)
        return np.array(frame["feature"]), all(frame["valid"]), frame["time"], captured


class ColourBall:
    """A red ball found with OpenCV.

    `grab()` returns RGB (h, w, 3), depth (h, w) [m], 0 for none, and when they were exposed by the camera's clock [s].
    """

    def __init__(self, grab, camera, radius):
        self.grab, self.camera, self.radius, self.last = grab, camera, radius, np.zeros(3)

    def read(self):
        rgb, depth, stamp = self.grab()
        patch = find_patch(np.where(depth[..., None] > 0.0, rgb, 0).astype(np.uint8))
        found = patch and locate_ball(
            patch, depth[patch.rows, patch.columns], self.camera, self.radius
        )
        self.last = found.centre if found else self.last
        return self.last, bool(found), stamp, stamp


class UR(servobench.Plant):
    """The robot and a detector as a plant of the bench, whose loop drives it and ends with a named reason."""

    def __init__(self, config: URConfig, setup):
        self.spec = hand_eye_spec(
            setup.model, setup.period, config.speed, 2.0 * np.pi, setup.limits
        )
        self.config, self.arm, self.control = config, setup.nominal.arm, None
        self.patience = config.patience * setup.period

    def reset(self, seed):
        gc.collect()
        gc.freeze()  # or Python looks through all that is imported, 40 ms, while the arm moves
        # Ends even a call that holds Python's lock
        faulthandler.dump_traceback_later(20.0, exit=True)
        self.k, self.seen, self.shown, self.stamp, self.before = -1, False, -1.0, -1.0, None
        self.receive = RTDEReceiveInterface(self.config.host)
        self.control = None if self.config.dry_run else RTDEControlInterface(self.config.host)
        # This connection may hear later than the other one that the program runs
        due = time.monotonic() + 1.0
        while self.control and not self.running() and time.monotonic() < due:
            time.sleep(0.002)
        # Or a ColourBall before your camera
        self.detector = Served(self.config.host, self.patience)
        return self.observe()

    def running(self):
        return bool(self.receive.getRobotStatus() & 2)

    def observe(self):
        faulthandler.dump_traceback_later(2.0 + self.patience, exit=True)
        (feature, valid, shown, captured), self.began, before = (
            self.detector.read(),
            time.monotonic(),
            self.before,
        )
        while (
            stamp := self.receive.getTimestamp()
        ) <= self.stamp and time.monotonic() < self.began + self.patience:
            pass
        alive = stamp > self.stamp and all(
            each.isConnected() for each in (self.receive, self.control) if each
        )
        # A `true` of a call proves nothing
        if not alive or (self.control and not self.running()):
            raise RuntimeError(
                "the control program has ended" if alive else "the robot cannot be heard any more"
            )
        q, same = np.array(self.receive.getActualQ()), before and (feature == before.feature).all()
        valid = (
            valid
            and shown > self.shown
            and not (self.seen and same and np.ptp(q - before.joint_position) > 1e-3)
        )
        self.k, self.seen, self.shown, self.stamp = (
            self.k + 1,
            self.seen or (before and not same),
            shown,
            stamp,
        )
        self.before = servobench.Observation(
            self.k * self.spec.period, q, feature, bool(valid), capture_time=captured
        )
        return self.before

    def step(self, command):
        spec, box, robot, rate = (
            self.spec,
            self.config.box,
            self.control,
            1.0 / (1.8 * self.spec.period),
        )
        v = np.clip(command.joint_velocity, -spec.joint_velocity_limit, spec.joint_velocity_limit)
        at = np.append(
            ahead := self.before.joint_position + 2.0 * spec.period * v,
            self.arm.frames(ahead)[-1][:3, 3],
        )
        low, high = np.append(spec.joint_lower, box[:3]), np.append(spec.joint_upper, box[3:])
        late = time.monotonic() - self.began > self.patience
        if late or (np.clip(at, low, high) != at).any():
            raise RuntimeError(
                "the controller is late" if late else f"the arm leaves its range at {at.round(3)}"
            )
        if robot and not (
            robot.setWatchdog(rate)
            and robot.speedJ(v.tolist(), self.config.acceleration, spec.period)
        ):
            # Ur-rtde loses its watchdog where it reconnects
            raise RuntimeError("the robot takes no command")
        return self.observe()

    def truth(self):
        return servobench.Truth(self.before.feature, None)  # as measured: nobody knows more

    def close(self):
        if self.control and self.control.isConnected():
            stop = Thread(
                target=lambda: (self.control.speedStop(10.0), self.control.stopScript()),
                daemon=True,
            )
            stop.start(), stop.join(1.0)
        faulthandler.dump_traceback_later(60.0, exit=True)


if __name__ == "__main__":
    if {"-h", "--help"} & {*sys.argv}:
        sys.exit(
            print(
                f"{__doc__}\n{URConfig.__doc__} All others are those of servobench run; see servobench run --help."
            )
        )
    usual = "run --no-isolate --robot ur5e --mismatch none --task target --set run.lost_after=0.1 --no-figures --plant"
    sys.argv[1:] = [
        *usual.split(),
        __file__,
        *(w.replace("--dry-run", "--set=UR.dry_run=true") for w in sys.argv[1:]),
    ]
    main()
