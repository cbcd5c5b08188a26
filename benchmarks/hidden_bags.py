"""Identify hidden robots from streams with stamps of their own, and from what a careful user makes of them.

Joints come at 125 Hz in alphabetical order, features at 30 Hz, both with stamps in ns that jitter by ± 2 ms, by clocks
that are 37 ms apart; 2 % of both are lost. Tables (--kind csv) tell the sum of latency and offset, bags each of them.

python benchmarks/hidden_bags.py --robots 200
python benchmarks/hidden_bags.py --robots 20 --kind mcap
python benchmarks/hidden_bags.py --robots 1 --kind sqlite3 --image 160000    # with a picture a frame, to be skipped
"""

import resource
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from hidden_plants import draw_hidden, judged, print_summary
from scipy.interpolate import CubicSpline

import servobench
from measuring import options
from servobench.harness.apps.twin.joining import joined
from servobench.harness.apps.twin.log import read_log
from servobench.harness.config.sensing import find_sensing
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.sampling import draw_robot
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import PlantSpec, column_names
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.mismatch import Mismatch

START = 1_700_000_000_000_000_000  # [ns]
PERIOD, FRAME = 0.008, 1.0 / 30.0  # [s]
JITTER, OFFSET, LOST = 2e-3, 0.037, 0.02  # [s], [s], [1]
TRANSPORT = 5e-4  # [s] least time to a recorder
NOISE = 1.5e-3  # [m]
MAP = """
[joints]
time = "%time"
unit = "ns"
[features]
time = "stamp"
unit = "ns"
fields = ["x", "y", "z"]
"""


class Recording(NamedTuple):
    """What happened, by the true time from the beginning."""

    robot: str
    mismatch: str
    true: RobotModel
    latency: float  # [s]
    commands: FloatArray  # (k, n) [rad/s]
    sampled: FloatArray  # (k,) [s]
    joints: FloatArray  # (k, n) [rad]
    exposed: FloatArray  # (f,) [s]
    features: FloatArray  # (f, 3) [m]
    times: dict[str, float]  # delay and lag of the drive [s]


def record(seed: int) -> Recording:
    """Run a hidden robot for a minute, and see it at 30 Hz."""
    robot, mismatch, sections = draw_hidden(seed, "kinematic")
    sensing = sections["sensing"]
    latency = sensing["latency"]
    sections["sensing"] = {"latency": 0.0}
    settings = {
        "run": {"period": PERIOD},
        "kinematic": sections,
        "random": {"duration": 60.0},
        "Excite": {"swing": 0.25},
    }
    chosen: dict[str, Any] = {"robot": robot, "mismatch": mismatch, "seed": seed}
    excite = "docs/examples/excite.py"
    made = servobench.run(excite, "kinematic", task="random", settings=settings, **chosen)
    steps = made.steps
    instants = steps["time_s"].to_numpy()
    draws = np.random.default_rng([seed, 7])
    exposed = np.arange(0.0, instants[-1], FRAME)
    exposed = exposed[draws.random(len(exposed)) > LOST]
    clean = CubicSpline(instants, steps.filter(like="true_feature_").to_numpy())(exposed)
    shape = np.diag(sensing["noise_shape"])
    features = clean + NOISE * np.sqrt(shape) * draws.normal(size=clean.shape)
    kept = draws.random(len(instants)) > LOST
    request = RunRequest(
        "kinematic", "constant", "random", Mismatch.parse(mismatch), seed, robot=robot
    )
    return Recording(
        robot=robot,
        mismatch=mismatch,
        true=draw_robot(request)[0],
        latency=latency,
        commands=steps.filter(like="joint_velocity_command_").to_numpy(),
        sampled=instants[kept],
        joints=steps.filter(like="joint_position_").to_numpy()[kept],
        exposed=exposed,
        features=features,
        times={"command_delay": sections["command_delay"], "lag": sections["lag"]},
    )


def jittered(times: FloatArray, draws: np.random.Generator) -> np.ndarray:
    """Return stamps [ns]."""
    late = draws.uniform(-JITTER, JITTER, len(times))
    return START + np.rint(1e9 * (times + late)).astype(np.int64)


def names_of(made: Recording) -> list[str]:
    """Return the names of joints as ROS has them."""
    return [f"{name}_joint" for name in made.true.arm.joint_names]


def write_tables(made: Recording, folder: Path, draws: np.random.Generator) -> list[Path]:
    """Write two tables and their map; frames are stamped on arrival."""
    joints = pd.DataFrame(made.joints, columns=names_of(made)).sort_index(axis=1)
    joints.insert(0, "%time", jittered(made.sampled, draws))
    features = pd.DataFrame(made.features, columns=["x", "y", "z"])
    features.insert(0, "stamp", jittered(made.exposed + made.latency + OFFSET, draws))
    files = [folder / name for name in ("joints.csv", "features.csv", "map.toml")]
    joints.to_csv(files[0], index=False)
    features.to_csv(files[1], index=False)
    files[2].write_text(MAP, encoding="utf-8")
    return files


def write_bag(
    made: Recording, folder: Path, draws: np.random.Generator, kind: str, image: int
) -> list[Path]:
    """Write a bag with the times of recording by one clock; frames are stamped when they are exposed."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types: Any = store.types

    def header(stamp: int) -> Any:  # noqa: ANN401 - a message
        time_of = types["builtin_interfaces/msg/Time"]
        seconds, rest = divmod(int(stamp), 10**9)
        return types["std_msgs/msg/Header"](stamp=time_of(sec=seconds, nanosec=rest), frame_id="")

    order = np.argsort(names_of(made))
    names = [names_of(made)[i] for i in order]
    events: list[tuple[int, str, Any]] = []
    transport = TRANSPORT + draws.exponential(JITTER / 4.0, len(made.sampled))
    stamps = jittered(made.sampled, draws)
    nothing = np.zeros(0)
    for t, stamp, wait, q in zip(made.sampled, stamps, transport, made.joints, strict=True):
        message = types["sensor_msgs/msg/JointState"](
            header=header(stamp), name=names, position=q[order], velocity=nothing, effort=nothing
        )
        events.append((START + round(1e9 * (t + wait)), "/joint_states", message))
    stamps = jittered(made.exposed + OFFSET, draws)
    transport = TRANSPORT + draws.exponential(JITTER / 4.0, len(made.exposed))
    picture = np.frombuffer(draws.bytes(image), dtype=np.uint8)
    for t, stamp, wait, y in zip(made.exposed, stamps, transport, made.features, strict=True):
        recorded = START + round(1e9 * (t + made.latency + wait))
        place = types["geometry_msgs/msg/Point"](*y.tolist())
        message = types["geometry_msgs/msg/PointStamped"](header=header(stamp), point=place)
        events.append((recorded, "/feature", message))
        if image:
            message = types["sensor_msgs/msg/CompressedImage"](
                header=header(stamp), format="jpeg", data=picture
            )
            events.append((recorded, "/image", message))
    command_type = types["std_msgs/msg/Float64MultiArray"]
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    for k, u in enumerate(made.commands):
        moment = START + round(1e9 * (PERIOD * k + TRANSPORT))
        topic = "/forward_velocity_controller/commands"
        events.append((moment, topic, command_type(layout=layout, data=u.copy())))
    events.sort(key=lambda each: each[0])
    path = folder / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin[kind.upper()]) as writer:
        connections: dict[str, Any] = {}
        for moment, topic, message in events:
            kind_of = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind_of, typestore=store)
            writer.write(connections[topic], moment, store.serialize_cdr(message, kind_of))
    file = path / "bag.mcap" if kind == "mcap" else path
    return [file, file]


def resampled(made: Recording, files: list[Path]) -> pd.DataFrame:
    """Return the usual table as a careful user makes it: joints at equal steps, each frame in the nearest row."""
    joints = pd.read_csv(files[0])
    frames = pd.read_csv(files[1])
    start = joints["%time"].iloc[0]
    since = 1e-9 * (joints["%time"] - start).to_numpy()
    rows = np.arange(0.0, since[-1], PERIOD)
    names = column_names(run_spec(made))
    table = pd.DataFrame({"time_s": rows})
    for name, joint in zip(names["joint_position"], names_of(made), strict=True):
        table[name] = np.interp(rows, since, joints[joint])
    place = np.rint(1e-9 * (frames["stamp"] - start).to_numpy() / PERIOD).astype(int)
    inside = (place >= 0) & (place < len(rows))
    features = np.full((len(rows), 3), np.nan)
    features[place[inside]] = frames[["x", "y", "z"]].to_numpy()[inside]
    table[names["feature"]] = features
    return table


def run_spec(made: Recording) -> PlantSpec:
    """Return the spec of a log with rows at equal steps."""
    request = RunRequest("kinematic", "constant", "circle", Mismatch(), 0, robot=made.robot)
    settings = {"run": {"period": PERIOD}, "kinematic": {"command_delay": 0.0}}
    experiment = build(resolve(request, Settings(settings)))
    experiment.plant.close()
    return experiment.plant.spec


def main() -> None:
    """Print the tables."""
    given = options(
        __doc__,
        robots=200,
        first=91000,
        kind="csv",
        image=0,
        careful=(200, "robots whose logs are resampled by hand, too"),
        keep=("", "CSV file for a row a parameter"),
    )
    rows: list[dict[str, Any]] = []
    by_hand: list[dict[str, Any]] = []
    for seed in range(given.first, given.first + given.robots):
        made = record(seed)
        draws = np.random.default_rng([seed, 8])
        about: dict[str, Any] = {"seed": seed, "robot": made.robot, "mismatch": made.mismatch}
        nominal = find_sensing("position").nominal(find_robot(made.robot))
        told = made.times | {"latency": made.latency}
        with tempfile.TemporaryDirectory() as name:
            if given.kind == "csv":
                files = write_tables(made, Path(name), draws)
                told["latency"] += OFFSET
                if seed < given.first + given.careful:
                    own = read_log(run_spec(made), resampled(made, files))
                    by_hand += judged(own, nominal, made.true, told, dict(about))
            else:
                files = write_bag(made, Path(name), draws, given.kind, given.image)
                size = sum(each.stat().st_size for each in files[0].parent.rglob("*.*"))
                before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                began = time.perf_counter()
            columns = files[2] if len(files) > 2 else None
            chosen = (made.robot, "position")
            read = joined((files[0], files[1], columns), chosen, "constant")
            resolved, table, clocks = read
            if given.image:
                taken = time.perf_counter() - began
                grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
                print(
                    f"bag of {size / 1e6:.0f} MB: {taken:.1f} s, memory grows by {grown / 1e3:.0f} MB"
                )
        experiment = build(resolved)
        experiment.plant.close()
        log = read_log(experiment.plant.spec, table, clocks=clocks)
        found = judged(log, nominal, made.true, told, dict(about))
        if clocks.delivery is not None:
            error = [
                row["error"] + told["latency"] for row in found if row["parameter"] == "latency"
            ]
            for row in found:
                row["offset"] = error[0] - clocks.delivery - OFFSET if error else np.nan
        rows += found
    if given.keep:
        pd.DataFrame(rows).to_csv(given.keep, index=False)
        pd.DataFrame(by_hand).to_csv(f"{given.keep}.by_hand", index=False)
    print_summary(pd.DataFrame(rows))
    if given.kind != "csv":
        offset = pd.DataFrame(rows).drop_duplicates("seed")["offset"].abs()
        print(
            f"offset of the clocks within 5 ms: {(offset < 0.005).mean():.1%}, largest error {offset.max():.4f} s"
        )
    if by_hand:
        print("\nresampled by hand, frames in the nearest row:")
        print_summary(pd.DataFrame(by_hand))


if __name__ == "__main__":
    main()
