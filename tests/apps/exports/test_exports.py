"""Steps of runs for other tools, read back by readers that are not ours."""

import json
import tomllib
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pandas as pd
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from servobench.harness.apps.exports.exports import export_folder
from servobench.harness.apps.twin.identification import PRIORS, kind_of
from servobench.harness.batch.api import compare, load
from servobench.harness.batch.results import ResultsFolder
from servobench.plant.contract.faults import ConfigurationError

SHORT = {"target": {"duration": 0.5}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("exports") / "results"
    compare(
        ["constant", "broyden"],
        tasks=["target"],
        seeds=[1],
        out=out,
        settings={"target": {"duration": 1.0}, "kinematic": {"sensing": {"stamps": True}}},
    )
    return out


def test_csv_holds_every_digit_of_every_run(folder, tmp_path):
    files = export_folder(ResultsFolder(folder), tmp_path / "csv", "csv")
    assert [file.suffix for file in files] == [".csv"] * 3
    whole = load(folder).steps
    for name, steps in whole.groupby("run_id"):
        back = pd.read_csv(tmp_path / "csv" / f"{name}.csv")
        pd.testing.assert_frame_equal(
            back, steps.reset_index(drop=True), check_dtype=False, check_exact=True
        )
    assert (
        pd.read_csv(tmp_path / "csv" / "runs.csv")["run_id"].tolist()
        == load(folder).runs["run_id"].tolist()
    )


def messages_of(file):
    """Return the messages of each topic by a reader that did not write them, and when they were recorded."""
    found = {}
    with AnyReader([file]) as bag:
        for connection, time, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((time, message))
    return found


def places(messages):
    return np.array([[each.point.x, each.point.y, each.point.z] for _, each in messages])


def matrix(transform):
    pose = np.eye(4)
    turn, place = transform.rotation, transform.translation
    pose[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    pose[:3, 3] = place.x, place.y, place.z
    return pose


def test_another_reader_finds_the_signals_of_a_run_as_messages_of_ros(folder, tmp_path):
    export_folder(ResultsFolder(folder), tmp_path / "mcap", "mcap")
    runs, whole = load(folder).runs, load(folder).steps
    assert json.loads((tmp_path / "mcap" / "foxglove_layout.json").read_text())["layout"]
    for run_id in runs["run_id"]:
        steps = whole[whole["run_id"] == run_id]
        found = messages_of(tmp_path / "mcap" / f"{run_id}.mcap")
        times = [time for time, _ in found["/joint_states"]]
        assert times == [10**9 + 50_000_000 * k for k in range(len(steps))]
        _, first = found["/joint_states"][0]
        assert first.name[:2] == ["shoulder_pan", "shoulder_lift"]
        joints = [each.position for _, each in found["/joint_states"]]
        np.testing.assert_array_equal(joints, steps.filter(like="joint_position_"))
        sent = [each.data for _, each in found["/forward_velocity_controller/commands"]]
        np.testing.assert_array_equal(sent, steps.filter(like="joint_velocity_command_"))
        for kind in ("reference", "true_feature"):
            wanted = steps.filter(regex=f"^{kind}_[xyz]_m")
            np.testing.assert_array_equal(places(found[f"/{kind}"]), wanted)
        new = steps[steps["feature_valid"]]
        np.testing.assert_array_equal(places(found["/feature"]), new.filter(regex="^feature_[xyz]"))
        stamps = [each.header.stamp for _, each in found["/feature"]]
        captured = [each.sec - 1 + 1e-9 * each.nanosec for each in stamps]
        np.testing.assert_allclose(captured, new["capture_time_s"], atol=2e-9)
        errors = [each.data for _, each in found["/steps/error_norm"]]
        np.testing.assert_array_equal(errors, steps["error_norm"])


def test_transforms_along_the_urdf_lead_to_the_true_ball_in_the_camera(folder, tmp_path):
    run_id = load(folder).runs["run_id"].iloc[0]
    export_folder(ResultsFolder(folder), tmp_path / "mcap", "mcap")
    found = messages_of(tmp_path / "mcap" / f"{run_id}.mcap")
    ((_, description),) = found["/robot_description"]
    assert "mesh" not in description.data
    tree = ET.fromstring(description.data)
    links = {link.get("name") for link in tree.iter("link")}
    parents = {
        j.find("child").get("link"): j.find("parent").get("link") for j in tree.iter("joint")
    }
    tool = next(j for j in tree.iter("joint") if j.find("child").get("link") == "ball")
    offset = np.array(tool.find("origin").get("xyz").split(), dtype=float)
    for k in (0, 7):
        edges = {each.child_frame_id: each for each in found["/tf"][k][1].transforms}
        assert set(edges) - {"camera"} == links - {"base"}
        assert all(
            edges[name].header.frame_id == parents[name] for name in edges if name != "camera"
        )
        flange, name = np.eye(4), "flange"
        while name != "base":
            flange = matrix(edges[name].transform) @ flange
            name = parents[name]
        camera = matrix(edges["camera"].transform)
        ball = flange[:3, :3] @ offset + flange[:3, 3]
        seen = camera[:3, :3].T @ (ball - camera[:3, 3])
        np.testing.assert_allclose(seen, places(found["/true_feature"])[k], atol=1e-9)
        target = matrix(edges["reference"].transform)[:3, 3] - camera[:3, 3]
        np.testing.assert_allclose(
            camera[:3, :3].T @ target, places(found["/reference"])[k], atol=1e-9
        )


@pytest.mark.slow
def test_a_rendered_run_has_the_image_of_its_camera(tmp_path):
    pytest.importorskip("pybullet", reason="PyBullet has no wheel for this version of Python")
    settings = {"target": {"duration": 0.2}}
    compare(
        ["constant"],
        plants=["bullet"],
        tasks=["target"],
        seeds=[1],
        out=tmp_path / "run",
        settings=settings,
    )
    export_folder(ResultsFolder(tmp_path / "run"), tmp_path / "mcap", "mcap")
    (file,) = (tmp_path / "mcap").glob("*.mcap")
    _, image = messages_of(file)["/image"][-1]
    picture = cv2.imdecode(image.data, cv2.IMREAD_COLOR)
    blue, green, red = picture.astype(int).transpose(2, 0, 1)
    ball = red - np.maximum(blue, green) > 60
    assert ball.sum() > 20
    _, info = messages_of(file)["/camera_info"][-1]
    assert (info.height, info.width) == picture.shape[:2]
    seen = info.k.reshape(3, 3) @ places(messages_of(file)["/true_feature"])[-1]
    rows, columns = np.nonzero(ball)
    np.testing.assert_allclose(seen[:2] / seen[2], [columns.mean(), rows.mean()], atol=3.0)
    np.testing.assert_array_equal(info.p.reshape(3, 4)[:, :3], info.k.reshape(3, 3))


def test_markers_lead_from_the_ball_to_its_reference(folder, tmp_path):
    run_id = load(folder).runs["run_id"].iloc[0]
    export_folder(ResultsFolder(folder), tmp_path / "mcap", "mcap")
    found = messages_of(tmp_path / "mcap" / f"{run_id}.mcap")
    ((_, way),) = found["/marker/way"]
    errors = [message for _, message in found["/marker/error"]]
    assert len(way.points) == len(errors) == len(found["/tf"])
    for k, message in enumerate(errors):
        assert message.header.frame_id == "base"
        ball, reference = np.array([[p.x, p.y, p.z] for p in message.points])
        on_way = way.points[k]
        np.testing.assert_array_equal(reference, [on_way.x, on_way.y, on_way.z])
        shown = places(found["/true_feature"])[k] - places(found["/reference"])[k]
        assert np.linalg.norm(ball - reference) == pytest.approx(np.linalg.norm(shown), abs=1e-9)


def test_a_run_without_a_film_has_its_signals_alone(tmp_path, output_of):
    compare(
        ["constant"],
        sensings=["pixel"],
        tasks=["target"],
        seeds=[1],
        out=tmp_path / "run",
        settings=SHORT,
    )
    said = output_of("export", tmp_path / "run", "--out", tmp_path / "mcap", "--format", "mcap")
    assert "1 files" not in said
    (file,) = (tmp_path / "mcap").glob("*.mcap")
    found = messages_of(file)
    assert {"/tf", "/robot_description"}.isdisjoint(found)
    _, pixel = found["/feature"][0]
    assert pixel.point.x > 1.0
    assert pixel.point.z == 0.0


def test_features_that_a_point_has_no_room_for_are_numbers_of_a_bag(tmp_path):
    compare(
        ["constant"],
        sensings=["stereo"],
        tasks=["random"],
        seeds=[1],
        out=tmp_path / "run",
        settings=SHORT,
    )
    export_folder(ResultsFolder(tmp_path / "run"), tmp_path / "mcap", "mcap")
    (file,) = (tmp_path / "mcap").glob("*.mcap")
    found = messages_of(file)
    steps = load(tmp_path / "run").steps
    assert "/feature" not in found
    for kind in ("reference", "feature"):
        columns = steps.filter(regex=f"^{kind}_[uv][12]")
        assert len(columns.columns) == 4
        for name, values in columns.items():
            numbers = [each.data for _, each in found[f"/steps/{name}"]]
            np.testing.assert_array_equal(numbers, values)


@pytest.mark.slow
def test_the_twin_of_a_bag_is_that_of_its_folder(tmp_path, output_of):
    excite = Path(__file__).parents[3] / "docs" / "examples" / "excite.py"
    sensing = {"sensing": {"latency": 0.06, "feature_noise": 0.001}}
    settings = {"random": {"duration": 30.0}, "kinematic": sensing}
    compare([str(excite)], tasks=["random"], seeds=[2], out=tmp_path / "run", settings=settings)
    export_folder(ResultsFolder(tmp_path / "run"), tmp_path / "mcap", "mcap")
    (file,) = (tmp_path / "mcap").glob("*.mcap")
    output_of("identify", tmp_path / "run", "--out", tmp_path / "folder.toml")
    output_of("identify", "--joints", file, "--out", tmp_path / "bag.toml")
    own, same = (
        tomllib.loads((tmp_path / f"{name}.toml").read_text()) for name in ("folder", "bag")
    )
    assert own["parameters"] == same["parameters"]
    deviations = np.linalg.norm(own["factor"], axis=0)
    sizes = dict(zip(own["parameters"], deviations, strict=True))
    assert abs(own["camera"]["latency"] - same["camera"]["latency"]) < sizes["latency"]
    for name, value in own["mean"].items():
        # What the log does not tell is left to its prior.
        loose = 0.1 * PRIORS.get(kind_of(name), 1e-3)
        assert abs(value - same["mean"][name]) <= 0.5 * sizes[name] + loose


def test_what_cannot_be_exported_is_one_line(folder, tmp_path):
    with pytest.raises(ConfigurationError, match="format must be one of csv, mcap, got 'xls'"):
        export_folder(ResultsFolder(folder), tmp_path / "xls", "xls")
    with pytest.raises(ConfigurationError, match="exists already; name a new folder"):
        export_folder(ResultsFolder(folder), tmp_path, "csv")


def test_runs_and_controllers_are_chosen(folder, tmp_path, output_of, refusal_of):
    def exported(name, *words):
        output_of("export", folder, "--out", tmp_path / name, *words)
        return sorted(path.stem for path in (tmp_path / name).iterdir())

    run_id = load(folder).runs["run_id"].iloc[0]
    assert exported("one", "--run", run_id) == sorted([run_id, "runs"])
    broyden = exported("some", "--controllers", "broyden")
    assert len(broyden) == 2
    assert pd.read_csv(tmp_path / "some" / "runs.csv")["controller"].tolist() == ["broyden"]
    unknown = refusal_of("export", folder, "--out", tmp_path / "none", "--run", "mine")
    assert "has no run 'mine'" in unknown
    assert not (tmp_path / "none").exists()
