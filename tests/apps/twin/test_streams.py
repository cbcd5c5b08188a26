"""Logs of two streams with stamps of their own: tables and bags are read as they are, and no user resamples."""

from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from servobench.harness.apps.twin.identification import identify
from servobench.harness.apps.twin.joining import _in_rows, joined
from servobench.harness.apps.twin.log import Clocks, read_log
from servobench.harness.apps.twin.summary import remarks
from servobench.harness.config.sensing import find_sensing
from servobench.harness.run.experiment import build
from servobench.harness.run.resolution import ResolvedRun
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.twin import deviated

ROBOT = "ur5"
PERIOD, FRAME = 0.008, 1.0 / 30.0
LATENCY, OFFSET = 0.06, 0.037
START = 1_700_000_000_000_000_000
NAMES = find_robot(ROBOT).arm.joint_names
MAP = """
[joints]
time = "%time"
unit = "ns"
[features]
time = "stamp"
unit = "ns"
fields = ["x", "y", "z"]
"""
STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types


def motion(time):
    """Return joints at times, (k, 6) rad."""
    draws = np.random.default_rng(1)
    home = np.array([0.3, -1.1, 1.2, -0.6, 0.9, 0.4])
    pace = 2.0 * np.pi * draws.uniform(0.05, 0.4, (6, 3))
    phase = draws.uniform(0.0, 6.0, (6, 3))
    return home + 0.2 * np.sin(np.multiply.outer(time, pace) + phase).sum(axis=-1)


def recorded(seconds=40.0, seed=2, lost=0.02):
    """Return times of joints and of exposures, the features then, and random draws."""
    draws = np.random.default_rng(seed)
    sampled = np.arange(0.0, seconds, PERIOD)
    exposed = np.arange(0.5, seconds - 0.5, FRAME)
    sampled = sampled[draws.random(len(sampled)) > lost]
    exposed = exposed[draws.random(len(exposed)) > lost]
    nominal = find_sensing("position").nominal(find_robot(ROBOT))
    true = deviated(nominal, {"zero_elbow": 0.03, "gear_shoulder_pan": 0.01, "camera_x": 0.02})
    features = true.feature(motion(exposed)) + 1e-3 * draws.normal(size=(len(exposed), 3))
    return sampled, exposed, features, draws


def stamps(time, draws, jitter=2e-3):
    late = draws.uniform(-jitter, jitter, len(time))
    return START + np.rint(1e9 * (time + late)).astype(np.int64)


def write_tables(folder, seconds=40.0, seed=2, joint_jitter=2e-3, **changes):
    """Write joints and features as ROS has them, a day apart from nobody; `changes` replace columns of features."""
    sampled, exposed, features, draws = recorded(seconds, seed)
    joints = pd.DataFrame(motion(sampled), columns=[f"{name}_joint" for name in NAMES])
    joints = joints.sort_index(axis=1)
    joints.insert(0, "%time", stamps(sampled, draws, joint_jitter))
    frames = pd.DataFrame(features, columns=["x", "y", "z"])
    frames.insert(0, "stamp", stamps(exposed + LATENCY + OFFSET, draws))
    joints.to_csv(folder / "joints.csv", index=False)
    frames.assign(**changes).to_csv(folder / "features.csv", index=False)
    (folder / "map.toml").write_text(MAP)
    return folder / "joints.csv", folder / "features.csv", folder / "map.toml"


def header(stamp):
    seconds, rest = divmod(int(stamp), 10**9)
    moment = TYPES["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    return TYPES["std_msgs/msg/Header"](stamp=moment, frame_id="")


def write_bag(folder, plugin=StoragePlugin.MCAP, seconds=40.0):
    """Write a bag with stamps of two clocks and the times of recording, and with a gripper on the topic of joints."""
    sampled, exposed, features, draws = recorded(seconds)
    names = sorted(f"{name}_joint" for name in NAMES)
    order = np.argsort([f"{name}_joint" for name in NAMES])
    none = np.zeros(0)
    events = []
    state, point = TYPES["sensor_msgs/msg/JointState"], TYPES["geometry_msgs/msg/PointStamped"]
    for t, stamp, q in zip(sampled, stamps(sampled, draws), motion(sampled), strict=True):
        message = state(header(stamp), names, q[order], none, none)
        events.append((t + 0.003, "/joint_states", message))
        # A device may tell no positions at all.
        gripper = state(header(stamp), ["finger_joint"], np.zeros(len(events) % 4 // 2), none, none)
        events.append((t + 0.003, "/joint_states", gripper))
    for t, stamp, y in zip(exposed, stamps(exposed + OFFSET, draws), features, strict=True):
        place = TYPES["geometry_msgs/msg/Point"](*y.tolist())
        events.append((t + LATENCY + 0.003, "/feature", point(header(stamp), place)))
    with Writer(folder / "bag", version=9, storage_plugin=plugin) as writer:
        topics = {}
        for moment, topic, message in sorted(events, key=lambda event: event[0]):
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=STORE)
            time = START + round(1e9 * moment)
            writer.write(topics[topic], time, STORE.serialize_cdr(message, kind))
    return folder / "bag"


class Read(NamedTuple):
    resolved: ResolvedRun
    table: pd.DataFrame
    clocks: Clocks


def read(*files):
    return Read(*joined(files, (ROBOT, "position"), "constant"))


def log_of(whole):
    experiment = build(whole.resolved)
    experiment.plant.close()
    return read_log(experiment.plant.spec, whole.table, clocks=whole.clocks)


def identified(whole):
    log = log_of(whole)
    nominal = find_sensing("position").nominal(find_robot(ROBOT))
    return log, identify(log, nominal)


def check(robot, name, true, largest):
    value, deviation = robot.estimate(name)
    assert abs(value - true) < 4.0 * deviation
    assert deviation < largest


@pytest.mark.slow
def test_two_tables_tell_the_sum_of_latency_and_offset(tmp_path):
    whole = read(*write_tables(tmp_path))
    assert whole.resolved.run.period == pytest.approx(PERIOD, rel=2e-3)
    log, robot = identified(whole)
    check(robot, "latency", LATENCY + OFFSET, 0.002)
    check(robot, "zero_elbow", 0.03, 0.01)
    check(robot, "gear_shoulder_pan", 0.01, 0.01)
    assert "latency holds the offset of the clocks" in "\n".join(remarks(log, robot, None))


@pytest.mark.slow
def test_jitter_of_stamps_is_neither_a_soft_tool_nor_a_swing_of_the_latency(tmp_path):
    """The noise of the joints was differentiated twice, and the best of 120 swings was always taken."""
    errors = []
    for seed in range(3, 8):
        _, robot = identified(read(*write_tables(tmp_path, seed=seed)))
        for name in ("compliance", "swing_sin", "swing_cos"):
            value, deviation = robot.estimate(name)
            errors.append(value / deviation)
    # Of errors in units of their deviations, 15 squares are above 31 in one of a hundred cases.
    assert np.sum(np.square(errors)) < 31.0


@pytest.mark.slow
def test_jitter_of_joints_does_not_seem_to_tell_latency_from_play(tmp_path):
    """Velocities of a spline through such joints hold noise, which no play explains: intervals were too narrow."""
    ratios = []
    for seed in range(3, 6):
        exact, jittering = (
            identified(read(*write_tables(tmp_path, 25.0, seed, size)))[1] for size in (0.0, 3e-3)
        )
        # Jitter enlarges the noise of the residuals, which is told for itself.
        units = [np.sqrt(np.trace(robot.noise)) for robot in (exact, jittering)]
        value, deviation = exact.estimate("latency")
        other, wider = jittering.estimate("latency")
        ratios.append(wider / units[1] / (deviation / units[0]))
        assert abs(other - value) < deviation
    np.testing.assert_allclose(ratios, 1.0, atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("plugin", StoragePlugin)
def test_one_bag_tells_latency_and_offset_apart(tmp_path, plugin):
    bag = write_bag(tmp_path, plugin)
    whole = read(bag, bag, None)
    log, robot = identified(whole)
    check(robot, "latency", LATENCY, 0.002)
    assert robot.estimate("latency")[0] - whole.clocks.delivery == pytest.approx(OFFSET, abs=0.004)
    words = "\n".join(remarks(log, robot, None))
    assert "when exposed: +3" in words


def test_a_bare_mcap_file_has_what_its_folder_has(tmp_path):
    bag = write_bag(tmp_path, seconds=5.0)
    file = bag / "bag.mcap"
    whole, same = (read(each, each, None) for each in (bag, file))
    pd.testing.assert_frame_equal(whole.table, same.table)


def test_stamps_of_every_unit_and_format_are_the_same(tmp_path):
    joints, features, columns = write_tables(tmp_path, seconds=3.0)
    found = read(joints, features, columns)
    wanted = found.table
    # Floating-point numbers of stamps since 1970 are a quarter of a microsecond apart.
    rows = found.resolved.run.period * np.arange(len(wanted))
    np.testing.assert_allclose(wanted["time_s"], rows, atol=1e-9)
    whole = pd.read_csv(joints)
    elapsed = whole["%time"] - START
    features_of = ["capture_time_s", "feature_x_m"]
    kinds = {
        '"s"': elapsed / 1e9 + START // 10**9,
        '"ms"': elapsed / 1e6 + START // 10**6,
        '"µs"': elapsed / 1e3 + START // 10**3,
        '"s" ': pd.to_datetime(whole["%time"], utc=True).map(pd.Timestamp.isoformat),
    }
    for unit, column in kinds.items():
        whole.assign(**{"%time": column}).to_parquet(tmp_path / "joints.parquet")
        columns.write_text(MAP.replace('"ns"', unit, 1))
        table = read(tmp_path / "joints.parquet", features, columns).table
        np.testing.assert_allclose(table[features_of], wanted[features_of], atol=1e-5)
        joints_of = table.filter(like="joint_position_")
        np.testing.assert_allclose(joints_of, wanted[joints_of.columns], atol=1e-5)


def test_unevenly_sampled_joints_keep_their_stamps(tmp_path):
    joints, features, columns = write_tables(tmp_path, seconds=10.0)
    draws = np.random.default_rng(4)
    sampled = np.arange(0.0, 10.0, PERIOD)
    sampled += draws.uniform(-0.0038, 0.0038, len(sampled))
    own = pd.DataFrame(motion(sampled), columns=[f"{name}_joint" for name in NAMES])
    own.insert(0, "%time", START + np.rint(1e9 * sampled).astype(np.int64))
    own.to_csv(joints, index=False)
    table = read(joints, features, columns).table
    found = table.filter(like="joint_position_").to_numpy()
    np.testing.assert_allclose(found, motion(sampled[0] + table["time_s"].to_numpy()), atol=2e-4)


def test_frames_that_arrive_together_stand_in_rows_of_their_own():
    found = _in_rows(np.array([-5.0, 1.0, 1.1, 1.2, 4.5, 7.0]), np.arange(6.0)[:, None], 6)
    np.testing.assert_array_equal(found[:, 0], [np.nan, 1.0, 2.0, 3.0, np.nan, 4.0])


def test_frames_faster_than_joints_all_have_rows(tmp_path):
    joints, features, columns = write_tables(tmp_path, seconds=10.0)
    pd.read_csv(joints)[::12].to_csv(joints, index=False)
    whole = read(joints, features, columns)
    assert whole.table["capture_time_s"].notna().sum() >= len(pd.read_csv(features)) - 2


def test_frames_whose_joints_may_lie_outside_the_log_do_not_count(tmp_path):
    whole = read(*write_tables(tmp_path, seconds=20.0)).table
    time = whole["capture_time_s"]
    within = time.between(1.0, 19.0 - 2 * PERIOD)
    assert whole["feature_valid"][within].all()
    assert not whole["feature_valid"][~time.between(1.0, 19.0 + PERIOD)].any()


def test_a_controller_is_shown_a_bag_with_a_reference(tmp_path, output_of, refusal_of):
    joints, features, columns = write_tables(tmp_path, seconds=5.0, u=0.1, v=0.2, w=0.9)
    words = ("shadow", "--joints", joints, "--features", features, "--columns", columns)
    words = (*words, "--controller", "broyden", "--out", tmp_path / "seen.csv")
    assert "no column reference_x_m" in refusal_of(*words)
    columns.write_text(f'{MAP}[reference]\ntime = "stamp"\nunit = "ns"\nfields = ["u", "v", "w"]\n')
    output_of(*words)
    seen = pd.read_csv(tmp_path / "seen.csv")
    assert seen["reference_z_m"].eq(0.9).all()
    assert 0 < seen["feature_valid"].sum() < len(seen) / 3


TOPIC, POINT = (
    '[features]\ntopic = "/featur"\n',
    '[features]\nfields = ["point.x", "point.y", "{}"]\n',
)
KNEE = '[joints]\nfields = ["a", "b", "c", "d", "e", "f"]\n'
NAME, LATE = (
    "; name topic, time and fields in",
    MAP.replace("[features]", "[features]\noffset = 90.0"),
)
WRONG = {  # files, the changed map or file, words of the refusal
    "a missing file": (None, "", "does not exist; wanted a table or a bag"),
    "a topic": ("bag", TOPIC, "no topic /featur; name it in the map: did you mean '/feature'"),
    "a field": ("bag", POINT.format("point.d"), f"no point.d{NAME} [features] of the map: did you mean"),
    "a part": ("bag", POINT.format("point"), f"has no point{NAME} [features] of the map: did you mean"),
    "a count": ("bag", '[features]\nfields = ["point.x"]\n', f"features of {{}}/bag has no 3 fields of values{NAME}"),
    "a joint of a bag": ("bag", KNEE, f"has no a{NAME} [joints] of the map: valid: elbow_joint"),
    "a column": ("map", MAP.replace('"z"', '"d"'), f"has no d{NAME} [features] of the map: valid: stamp"),
    "stamps": ("map", MAP.replace("%time", "time"), f"no time{NAME} [joints] of the map: did you mean '%time'"),
    "another robot": ("robot", MAP, f"has no joint_position_joint_1_rad{NAME} [joints] of the map"),
    "a key": ("map", MAP + "topics = 1\n", "has no setting 'topics': did you mean 'topic'"),
    "a unit": ("map", MAP.replace('"ns"', '"ms"', 1), 's apart; write their unit, such as unit = "ns" or "s"'),
    "a unit of seconds": ("bag", '[joints]\nunit = "ns"\n', "e-12 s apart; write their unit"),
    "a date": ("map", MAP.replace('"stamp"', '"word"'), "word is neither numbers nor dates of ISO 8601"),
    "no overlap": ("map", LATE, "do not overlap: features run from 17"),
    "no bag": ("features.csv", "features.bag", "cannot be read as a bag"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_found_is_named_with_its_remedy(tmp_path, case):
    source, text, words = WRONG[case]
    joints, features, columns = write_tables(tmp_path, seconds=2.0, word="soon")
    robot = "panda" if source == "robot" else ROBOT
    if source == "bag":
        joints = features = write_bag(tmp_path, seconds=2.0)
    if source in ("bag", "map"):
        columns.write_text(text)
    elif source == "features.csv":
        features = (tmp_path / source).rename(tmp_path / text)
    elif source is None:
        features.unlink()
    with pytest.raises(ConfigurationError) as refused:
        joined((joints, features, columns), (robot, "position"), "constant")
    assert words.format(tmp_path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_stamps_out_of_order_and_doubled_end_with_code_1(tmp_path, output_of):
    joints, features, columns = write_tables(tmp_path, seconds=2.0)
    words = ("identify", "--joints", joints, "--features", features, "--columns", columns)
    whole = pd.read_csv(joints)
    for broken in (whole.iloc[[0, 2, 1, *range(3, len(whole))]], whole.iloc[[0, 1, 1, 2]]):
        broken.to_csv(joints, index=False)
        said = output_of(*words, "--robot", ROBOT, code=1)
        assert "is not later than the one before" in said
        assert "leave out doubled ones" in said


def test_a_pause_of_the_recording_and_a_clock_that_is_set_are_refused(tmp_path, refusal_of):
    joints, features, columns = write_tables(tmp_path, seconds=4.0)
    words = ("identify", "--joints", joints, "--features", features, "--columns", columns)
    whole = pd.read_csv(joints)
    later = whole["%time"] + 10**18 * (whole.index >= 100)
    broken = {"0.4": whole.drop(range(100, 150)), "1e+09": whole.assign(**{"%time": later})}
    for seconds, table in broken.items():
        table.to_csv(joints, index=False)
        said = refusal_of(*words, "--robot", ROBOT)
        assert f"joints of {joints}: none for {seconds}" in said
        assert (
            "s after stamp 100, as where a recording pauses or a clock is set: cut the log" in said
        )


def test_a_cameras_clock_that_is_set_by_less_is_named_by_what_follows(tmp_path, output_of):
    joints, features, columns = write_tables(tmp_path)
    table = pd.read_csv(features)
    table["stamp"] += 10**10 * (table.index >= len(table) // 2)
    table.to_csv(features, index=False)
    words = ("identify", "--joints", joints, "--features", features, "--columns", columns)
    assert "cut the log there" in output_of(*words, "--robot", ROBOT, code=1)


def test_a_stream_without_any_finite_feature_is_refused(tmp_path, refusal_of):
    joints, features, columns = write_tables(tmp_path, seconds=2.0, x=np.nan)
    words = ("identify", "--joints", joints, "--features", features, "--columns", columns)
    assert "has no rows; it needs stamp" in refusal_of(*words)


def test_frames_without_a_detection_are_no_frames(tmp_path):
    joints, features, columns = write_tables(tmp_path, seconds=5.0)
    table = pd.read_csv(features)
    table.loc[::3, "y"] = np.nan
    table.to_csv(features, index=False)
    found = read(joints, features, columns).table["capture_time_s"].notna().sum()
    assert found <= table["y"].notna().sum() < len(table)
    held = table.ffill().bfill().assign(feature_valid=table["y"].notna())
    held.to_csv(features, index=False)
    assert read(joints, features, columns).table["capture_time_s"].notna().sum() == found


def test_a_log_and_two_streams_are_not_given_together(tmp_path, refusal_of):
    joints, features, columns = write_tables(tmp_path, seconds=2.0)
    assert "--joints is in place of a log" in refusal_of("identify", joints, "--joints", joints)
    assert "missing argument 'LOG', or --joints" in refusal_of("identify", "--features", features)
    words = ("identify", "--joints", joints, "--features", features, "--columns", columns)
    assert "is the log itself; name another file" in refusal_of(*words, "--out", features)
    assert "--joints is in place of a log and --run" in refusal_of(*words, "--run", "a")


def with_commands(folder, stamps):
    """Write a bag with joints, features, and commands that were recorded at stamps [s]; joints come twice."""
    bag = write_bag(folder, seconds=5.0)
    kinds = {}
    with (
        AnyReader([bag], default_typestore=STORE) as old,
        Writer(folder / "more", version=9) as new,
    ):
        for connection in old.connections:
            kind = connection.msgtype
            kinds[connection.topic] = new.add_connection(connection.topic, kind, typestore=STORE)
        for connection, time, raw in old.messages():
            for late in (0, 1_000_000) if connection.topic == "/joint_states" else (0,):
                new.write(kinds[connection.topic], time + late, raw)
        kind = "std_msgs/msg/Float64MultiArray"
        topic = new.add_connection("/forward_velocity_controller/commands", kind, typestore=STORE)
        layout = TYPES["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        for number, stamp in enumerate(stamps):
            message = TYPES[kind](layout=layout, data=np.full(6, float(number)))
            new.write(topic, START + round(1e9 * stamp), STORE.serialize_cdr(message, kind))
    return folder / "more"


def test_repeated_messages_count_once_and_commands_hold_until_the_next(tmp_path):
    bag = with_commands(tmp_path, [0.5, 1.0, 2.0])
    whole = read(bag, bag, None)
    assert whole.resolved.run.period == pytest.approx(PERIOD, rel=5e-3)
    found = whole.table["joint_velocity_command_elbow_rad_s"]
    assert sorted(set(found)) == [0.0, 1.0, 2.0]
    assert found.iloc[-1] == 2.0


def test_a_broken_stream_of_commands_is_named_and_left_out(tmp_path, caplog):
    bag = with_commands(tmp_path, [0.5, 0.5, 1.0])
    whole = read(bag, bag, None)
    assert not any(name.startswith("joint_velocity_command") for name in whole.table)
    (said,) = [record.getMessage() for record in caplog.records]
    assert "commands of" in said
    assert "stamp 1 of 3 is not later than the one before" in said
    assert said.endswith("commands are left out")
    columns = tmp_path / "map.toml"
    columns.write_text('[commands]\nunit = "s"\ntopic = "/forward_velocity_controller/commands"\n')
    with pytest.raises(ConfigurationError, match="commands of .* stamp 1 of 3"):
        read(bag, bag, columns)


def test_a_log_without_commands_says_nothing_and_positions_are_none(tmp_path, caplog):
    bag = write_bag(tmp_path, seconds=3.0)
    read(bag, bag, None)
    joints, features, columns = write_tables(tmp_path, seconds=3.0)
    read(joints, features, columns)
    table = pd.read_csv(joints)
    table["time_s"] = 1e-9 * table.pop("%time")
    table.to_csv(joints, index=False)
    columns.write_text(MAP[MAP.index("[features]") :])
    whole = read(joints, features, columns)
    assert not any(name.startswith("joint_velocity_command") for name in whole.table)
    assert not caplog.records
