"""Replay of a logged run: the rendered arm at its joint positions, from outside and in its own camera.

The true robot is sampled again from the run's mismatch and seed and compared with the values in the table. Nothing is
simulated: each frame has the logged joint positions, and the ball is detected in an image without noise.
"""

import json
import math
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import cv2
import numpy as np
import pandas as pd

from servobench.harness.apps.figures.tracks import Track, track_of, values_drawn
from servobench.harness.config.registry import rendered_plant
from servobench.harness.run.request import OWN_ROBOT
from servobench.harness.run.variations import Row
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.seeds import named_seed
from servobench.plant.contract.settings import remark
from servobench.plant.rendered.detection import ByteArray, draw_detection, find_ball
from servobench.plant.rendered.plants import load_engine
from servobench.plant.rendered.room import Overview, Room
from servobench.plant.robot.catalogue import DEFAULT_ROBOT, find_robot
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.robot import Robot

JOINT = re.compile(r"joint_position_.+_rad")  # a column of steps
# [m] Depth behind a surface at which a trail still counts as visible: it begins within the ball.
VISIBLE_DEPTH = 0.05
# [m] Distance of the logged ball from that of the rigid arm up to which a film needs no remark.
MAX_BALL_OFFSET = 0.01
ROUNDING = 1e-6  # [s] by which an instant may lie outside a stretch
HIDDEN_OPACITY = 0.3  # [1] opacity of the hidden parts of a trail
SUBPIXEL_BITS = 4  # binary digits after the point in the coordinates that OpenCV draws


class Trail(NamedTuple):
    """A line in space to be drawn into the overview."""

    points: FloatArray  # (k, 3) [m], base frame
    colour: tuple[int, int, int]  # red, green, blue
    width: int  # [px]


@dataclass(frozen=True, eq=False)
class LoggedRun:
    """A logged run with all that its pictures need."""

    track: Track  # its row in the table of runs, and its steps
    robot: Robot  # by its maker's description
    model: HandEyeModel  # the true arm and camera
    # The same after the camera was moved in the middle of the run; None if it was not.
    moved: HandEyeModel | None
    moved_from: int  # first period that the moved camera sees; the number of periods if none
    joint_position: FloatArray  # (k, n) [rad], as reported
    ball: FloatArray  # (k, 3) [m], base frame
    reference: FloatArray  # (k, 3) [m], base frame


def logged_run(row: Row, steps: pd.DataFrame | None) -> LoggedRun:
    """Prepare a run to be shown.

    Args:
        row: its row in the table of runs.
        steps: its rows in the table of steps, if any.

    Raises:
        ConfigurationError: a plant that brings its robot, a run without steps, or one whose robot is not found again.
    """
    run_id = row["run_id"]
    if row.get("robot") == OWN_ROBOT:
        raise ConfigurationError(
            f"run {run_id} cannot be shown: plant {row['plant']} brings a robot of its own"
        )
    sensing = row.get("sensing", DEFAULT_SENSING)
    if sensing != DEFAULT_SENSING:
        raise ConfigurationError(
            f"run {run_id} cannot be shown: films have the sensing position, not {sensing}"
        )
    if steps is None or steps.empty:
        raise ConfigurationError(f"run {run_id} has no steps: it ended before its first period")
    track = track_of(row, steps)
    robot = find_robot(str(row.get("robot", DEFAULT_ROBOT)))
    # A plant may call its joints as it likes
    names = [str(name) for name in track.table if JOINT.fullmatch(str(name))]
    if len(names) != robot.arm.n:
        raise ConfigurationError(
            f"run {run_id} has {len(names)} joint positions [rad]; wanted the {robot.arm.n} of a {robot.title}"
        )
    model, moved = _true_model(row, robot)
    q = track.table[names].to_numpy(dtype=np.float64)
    true_feature = track.vectors("true_feature_")
    moved_from = len(q) if moved is None else _first_seen_by(moved, model, q, true_feature)

    def in_base(points: FloatArray) -> FloatArray:
        before = model.to_base(points[:moved_from])
        after = (moved or model).to_base(points[moved_from:])
        return np.concatenate([before, after])

    ball = in_base(true_feature)
    drawn_ball = model.to_base(model.feature(q))
    offset = float(np.nanmax(np.linalg.norm(drawn_ball - ball, axis=1), initial=0.0))
    if offset > MAX_BALL_OFFSET:
        remark(
            f"run {run_id}: the ball was up to {offset:.2g} m from where it is drawn, as films have no play of "
            "gears, no flexible tool and no camera that turns"
        )
    return LoggedRun(
        track=track,
        robot=robot,
        model=model,
        moved=moved,
        moved_from=moved_from,
        joint_position=q,
        ball=ball,
        reference=in_base(track.vectors("reference_")),
    )


def stretch(run: LoggedRun, begin: float, length: float | None) -> LoggedRun:
    """Return the part of a run that begins at `begin` and is `length` long [s], or goes to its end.

    Raises:
        ConfigurationError: nothing of the run lies there.
    """
    time = run.track.time
    end = math.inf if length is None else begin + length
    inside = np.flatnonzero((time >= begin - ROUNDING) & (time <= end + ROUNDING))
    if not len(inside):
        run_id = run.track.row["run_id"]
        raise ConfigurationError(
            f"run {run_id} has no instant from {begin:g} to {end:g} s: it goes "
            f"from {time[0]:g} to {time[-1]:g} s"
        )
    part = slice(inside[0], inside[-1] + 1)
    table = run.track.table.iloc[part].reset_index(drop=True)
    return replace(
        run,
        track=Track(run.track.row, table),
        moved_from=max(0, run.moved_from - int(inside[0])),
        joint_position=run.joint_position[part],
        ball=run.ball[part],
        reference=run.reference[part],
    )


class Replay(AbstractContextManager["Replay"]):
    """The scene in which a logged run is shown; to be used in a `with` statement."""

    def __init__(self, run: LoggedRun, *, fineness: float = 1.0) -> None:
        """Open a world with the run's robot.

        Args:
            run: the logged run.
            fineness: pixels rendered for one pixel of the overview, along each side; above 1 edges become smooth.
        """
        self._run = run
        self._fineness = fineness
        engine = load_engine(rendered_plant(str(run.track.row["plant"])))
        self._scene = engine.scene(Room(run.model.arm, scenery=True, robot=run.robot))
        self.camera = run.robot.pinhole.reaching(run.robot.workspace.camera_distance)
        self._poses = [model.X_BC for model in (run.model, run.moved) if model]
        self._pose = self._poses[0]
        self._overview = Overview.of(run.robot.workspace.scale, fineness)

    def __exit__(self, *error: object) -> None:
        """Close the world."""
        self._scene.close()

    def place(self, k: int) -> None:
        """Put arm and camera where they were in period `k`."""
        camera_moved = k >= self._run.moved_from
        self._pose = self._poses[1 if camera_moved else 0]
        q = self._run.joint_position[k]
        self._scene.place(self._run.model.arm.joint_angle(q))

    def camera_view(self) -> ByteArray:
        """Return the image of the run's camera with the detected ball marked, (h, w, 3)."""
        rgba, buffer = self._scene.render(self.camera, self._pose)
        ball_radius = self._run.robot.workspace.ball_radius
        found = find_ball(rgba, buffer, self.camera, ball_radius)
        return draw_detection(rgba[..., :3], found, self.camera, ball_radius)

    def overview(self, trails: list[Trail]) -> ByteArray:
        """Return the arm from outside with trails, pale where they are hidden: (480, 640, 3) times the fineness."""
        rgba, buffer = self._scene.render(self._overview.camera, self._overview.X_BC)
        picture = np.ascontiguousarray(rgba[..., :3])
        depth = self._overview.camera.metric_depth(buffer)
        for trail in trails:
            self._draw(picture, depth, trail)
        return picture

    def _draw(self, picture: ByteArray, depth: FloatArray, trail: Trail) -> None:
        if len(trail.points) < 2 or not np.isfinite(trail.points).all():
            return
        camera = self._overview.camera
        pixels, far = self._overview.pixels(trail.points)
        if (far < camera.near).any():
            return
        last_pixel = [camera.width - 1, camera.height - 1]
        columns, rows = np.clip(pixels.astype(int), 0, last_pixel).T
        hidden_point = far > depth[rows, columns] + VISIBLE_DEPTH
        hidden = hidden_point[1:] | hidden_point[:-1]  # a value for each segment
        corners = np.round(pixels * 2**SUBPIXEL_BITS).astype(np.int32)
        width = max(1, round(trail.width * self._fineness))

        def draw(image: ByteArray, segments: np.ndarray) -> None:
            for i in np.flatnonzero(segments):
                begin = corners[i].tolist()
                end = corners[i + 1].tolist()
                cv2.line(image, begin, end, trail.colour, width, cv2.LINE_AA, SUBPIXEL_BITS)

        # The hidden segments shine through as one layer; the visible ones are drawn over it.
        layer = picture.copy()
        draw(layer, hidden)
        cv2.addWeighted(layer, HIDDEN_OPACITY, picture, 1 - HIDDEN_OPACITY, 0.0, dst=picture)
        draw(picture, ~hidden)


def _true_model(row: Row, robot: Robot) -> tuple[HandEyeModel, HandEyeModel | None]:
    """Return the run's true robot, and the one after its camera was moved; None if it was not.

    Raises:
        ConfigurationError: its mismatch cannot be sampled, or its values are not those of the table.
    """
    with configuration_errors(f"run {row['run_id']}: "):
        mismatch = Mismatch.parse(row["mismatch"])
        seed = int(row["seed"])
        model, sample = sample_mismatch(mismatch, robot, named_seed(seed, "mismatch"))
        if robot.twin is not None:
            twin = robot.twin.model(robot.nominal, DEFAULT_SENSING, seed, exact=True)
            model = cast("HandEyeModel", twin)
    if mismatch.size("camera_turn") > 0.0:
        raise ConfigurationError(
            f"run {row['run_id']} cannot be shown: films have no camera that turns"
        )
    logged = values_drawn(row)
    drawn = json.loads(json.dumps(sample.as_record()))  # as the table has it: lists, no tuples
    if any(logged.get(name) != value for name, value in drawn.items()):
        raise ConfigurationError(
            f"run {row['run_id']} was made on another robot than mismatch {row['mismatch']} and seed {row['seed']} "
            "give now; record it with the version of servobench that made it"
        )
    moved = sample.moved(model, robot)
    return model, moved if isinstance(moved, HandEyeModel) else None


def _first_seen_by(
    moved: HandEyeModel, model: HandEyeModel, q: FloatArray, feature: FloatArray
) -> int:
    """Return the first period in which the true feature (k, m) is that of the moved camera at q (k, n)."""
    distance_before = np.linalg.norm(model.feature(q) - feature, axis=1)
    distance_after = np.linalg.norm(moved.feature(q) - feature, axis=1)
    seen = np.flatnonzero(distance_after < distance_before)
    return int(seen[0]) if len(seen) else len(q)
