"""A run as an MCAP file with messages of ROS 2, for Foxglove, rerun, `ros2 bag` and `servobench identify`.

It has the signals of the run and, where a film of the run could be made, the true arm in 3-D: the URDF has a link for
the ball, and two that fly, for the ball as it was measured and for its reference; markers are the way of the reference
and the error. Frames are the links of the URDF, `base` first, and `camera`. Times begin at 1 s, as a stamp of 0 stands
for none in ROS.
"""

import math
import re
from collections.abc import Hashable, Iterable, Mapping
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from mcap_ros2.writer import Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from servobench.harness.apps.films.replay import LoggedRun, Replay, logged_run
from servobench.plant.contract.checks import FloatArray, Triple
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import COMMAND
from servobench.plant.rendered import urdf
from servobench.plant.robot.camera import PinholeCamera

MOST = 3  # features that a message of a point holds
UNTURNED = np.eye(3)  # a rotation
CAMERA = "camera"  # frame: z along the optical axis, x right and y down in the image
SIGNALS = ("reference", "true_feature", "feature")
GROUPS = (COMMAND, "joint_position", *SIGNALS)  # kinds of columns
MESH = re.compile(r'<mesh filename="ball.obj" scale="(\S+) [^>]*>')
FLYING = """
  <link name="measured"><visual><geometry><sphere radius="{radius}" /></geometry>
    <material name="yellow"><color rgba="1.0 0.8 0.1 0.6" /></material></visual></link>
  <link name="reference"><visual><geometry><sphere radius="{radius}" /></geometry>
    <material name="green"><color rgba="0.1 0.7 0.3 0.6" /></material></visual></link>
  <joint name="measured" type="floating"><parent link="base" /><child link="measured" /></joint>
  <joint name="reference" type="floating"><parent link="base" /><child link="reference" /></joint>
</robot>"""
KINDS = {  # topic, or its first part, -> kind of message
    "robot_description": "std_msgs/msg/String",
    "joint_states": "sensor_msgs/msg/JointState",
    "forward_velocity_controller": "std_msgs/msg/Float64MultiArray",
    "tf": "tf2_msgs/msg/TFMessage",
    "image": "sensor_msgs/msg/CompressedImage",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "marker": "visualization_msgs/msg/Marker",
    "steps": "std_msgs/msg/Float64",
    **dict.fromkeys(SIGNALS, "geometry_msgs/msg/PointStamped"),
}
LINE_STRIP = 4  # types of markers
LINE_LIST = 5
LINE_WIDTH = 0.003  # [m]
GREEN = (0.1, 0.7, 0.3)
RED = (0.9, 0.1, 0.1)
Message = dict[str, Any]  # fields by name; those that are missing are 0 or empty


def write_bag(path: Path, steps: pd.DataFrame, run: Mapping[Any, Any]) -> None:
    """Write one run as an MCAP file.

    Args:
        path: the file.
        steps: the run's table of steps.
        run: its row in the table of runs.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    shown = None
    try:
        shown = logged_run(dict(run), steps)
    except ConfigurationError as error:
        remark(f"without the arm in 3-D: {error}")
    numbers = steps.drop(columns="run_id").astype(np.float64)
    times = numbers["time_s"]
    captured = numbers.get("capture_time_s", times).fillna(times)
    with path.open("wb") as file, ExitStack() as stack:
        writer: Any = Writer(file)
        schemas = {
            kind: writer.register_msgdef(kind, store.generate_msgdef(kind, ros_version=2)[0])
            for kind in KINDS.values()
        }
        replay = None
        if shown is not None and run["plant"] in ("bullet", "mujoco"):
            replay = stack.enter_context(Replay(shown))
        for k, row in enumerate(numbers.to_dict("records")):
            time = row["time_s"]
            messages = _signals(row, captured[k])
            if shown is not None:
                messages |= _scene(shown, k, time)
            if replay is not None:
                messages["image"] = _image(replay, k, time)
                messages["camera_info"] = _camera_info(replay.camera, time)
            for topic, message in messages.items():
                schema = schemas[KINDS[topic.partition("/")[0]]]
                writer.write_message(f"/{topic}", schema, message, _nanoseconds(time))
        writer.finish()


def _nanoseconds(time: float) -> int:
    """Return a time of the run [s] as a stamp, which begins at 1 s."""
    return round((1.0 + time) * 1e9)


def _header(time: float, frame: str) -> Message:
    """Return a header at a time of the run [s]."""
    seconds, rest = divmod(_nanoseconds(time), 10**9)
    return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame}


def _vector(values: Iterable[float]) -> Message:
    return dict(zip("xyzw", values, strict=False))


def _signals(row: Mapping[Hashable, float], captured: float) -> dict[str, Message]:
    """Return the messages of a row: those of groups of columns, and a number for each column that is in none."""
    time = row["time_s"]
    groups: dict[str, dict[str, float]] = {kind: {} for kind in GROUPS}
    messages: dict[str, Message] = {}
    for name, value in row.items():
        column = str(name)
        kind = next((each for each in GROUPS if column.startswith(f"{each}_")), "")
        if kind and column != "feature_valid":
            groups[kind][column.removeprefix(f"{kind}_").removesuffix("_rad")] = value
        elif math.isfinite(value):
            messages[f"steps/{column}"] = {"data": value}
    speeds, joints, *places = groups.values()
    stamps = {"reference": time, "true_feature": time, "feature": captured}
    for (kind, stamp), place in zip(stamps.items(), places, strict=True):
        if len(place) > MOST:
            for name, value in place.items():
                messages[f"steps/{kind}_{name}"] = {"data": value}
        elif kind != "feature" or row["feature_valid"]:
            point = _vector(place.values())
            messages[kind] = {"header": _header(stamp, CAMERA), "point": point}
    header = _header(time, urdf.BASE_LINK)
    state = {"header": header, "name": list(joints), "position": list(joints.values())}
    return messages | {
        "joint_states": state,
        "forward_velocity_controller/commands": {"data": list(speeds.values())},
    }


def _scene(shown: LoggedRun, k: int, time: float) -> dict[str, Message]:
    """Return the messages of arm, camera, ball and reference in period `k`, and at first the URDF."""
    model = shown.model
    if shown.moved is not None and k >= shown.moved_from:
        model = shown.moved
    joints = model.arm.joint_names
    frames = [np.eye(4), *model.arm.frames(shown.joint_position[k])]
    links = [urdf.BASE_LINK, *(f"{name}_link" for name in joints), urdf.FLANGE_LINK]
    measured = model.to_base(shown.track.vectors("feature_")[k])
    edges = [
        ((urdf.BASE_LINK, CAMERA), model.X_BC[:3, 3], model.X_BC[:3, :3]),
        ((urdf.FLANGE_LINK, urdf.BALL_LINK), model.arm.tool, UNTURNED),
        ((urdf.BASE_LINK, "measured"), measured, UNTURNED),
        ((urdf.BASE_LINK, "reference"), shown.reference[k], UNTURNED),
    ]
    for edge, (before, frame) in zip(pairwise(links), pairwise(frames), strict=True):
        step = np.linalg.inv(before) @ frame
        edges.append((edge, step[:3, 3], step[:3, :3]))
    messages: dict[str, Message] = {
        "tf": {"transforms": [_transform(time, *each) for each in edges]}
    }
    if k == 0:
        messages["robot_description"] = {"data": _description(shown)}
        messages["marker/way"] = _line(time, LINE_STRIP, GREEN, shown.reference)
    error = np.stack([shown.ball[k], shown.reference[k]])
    messages["marker/error"] = _line(time, LINE_LIST, RED, error)
    return messages


def _line(time: float, kind: int, colour: Triple, points: FloatArray) -> Message:
    """Return a marker of lines through points of the base frame, (k, 3) m; it stays until the next one."""
    return {
        "header": _header(time, urdf.BASE_LINK),
        "type": kind,
        "pose": {"orientation": {"w": 1.0}},
        "scale": {"x": LINE_WIDTH},
        "color": {**dict(zip("rgb", colour, strict=True)), "a": 1.0},
        "points": [_vector(point) for point in points],
    }


def _transform(time: float, edge: tuple[str, str], place: FloatArray, R: FloatArray) -> Message:
    """Return a TransformStamped of an edge, parent and child: a place (3,) m and a rotation (3, 3)."""
    parent, child = edge
    turn = Rotation.from_matrix(R).as_quat()
    moved = {"translation": _vector(place), "rotation": _vector(turn)}
    return {"header": _header(time, parent), "child_frame_id": child, "transform": moved}


def _description(shown: LoggedRun) -> str:
    """Return the URDF of the arm, of primitives, with the ball as measured and its reference."""
    text = urdf.text(urdf.arm_tree(shown.model.arm, shown.robot))
    flying = FLYING.format(radius=shown.robot.workspace.ball_radius)
    return MESH.sub(r'<sphere radius="\1" />', text).replace("</robot>", flying)


def _image(replay: Replay, k: int, time: float) -> Message:
    """Return the image of the camera, with the detected ball marked."""
    replay.place(k)
    _, data = cv2.imencode(".jpg", np.flip(replay.camera_view(), axis=2))
    return {"header": _header(time, CAMERA), "format": "jpeg", "data": data.tobytes()}


def _camera_info(camera: PinholeCamera, time: float) -> Message:
    """Return the intrinsics of the image, that of an ideal pinhole; in ROS the centre of the first pixel is (0, 0)."""
    centre = (0.5 * camera.width - 0.5, 0.5 * camera.height - 0.5)
    projection = np.eye(3, 4)
    projection[[0, 1], [0, 1]] = camera.focal
    projection[:2, 2] = centre
    return {
        "header": _header(time, CAMERA),
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": projection[:, :3].ravel().tolist(),
        "r": UNTURNED.ravel().tolist(),
        "p": projection.ravel().tolist(),
    }
