from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from kit.plants import factory_ur5, odd_ur5, setup
from servobench.plant.rendered.plants import BULLET
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.rendered.urdf import (
    arm_mechanics,
    arm_tree,
    bench_files,
    rectangles_obj,
    rpy_along,
    sphere_obj,
    text,
)
from servobench.plant.robot import ur5
from servobench.plant.robot.arm import SerialArm, rotation_from_rpy
from servobench.plant.robot.catalogue import find_robot

pybullet = pytest.importorskip(
    "pybullet", reason="PyBullet is not installed; from Python 3.12 on it has no wheel"
)

UR5 = find_robot("ur5")
BALL = 7  # link number: six joints, the flange, the ball


def arm_named_like_parts():
    return replace(ur5.ur5_arm(), joint_names=("flange", "ball", "base", "", "world", "base_link"))


ARMS = {
    "nominal": ur5.ur5_arm,
    "factory": factory_ur5,
    "odd": odd_ur5,
    "named": arm_named_like_parts,
}


@pytest.fixture(params=ARMS)
def arm(request) -> SerialArm:
    return ARMS[request.param]()


@pytest.fixture
def loaded(arm, tmp_path):
    """The arm in PyBullet: a function from reported joint positions to the state of a link."""
    (tmp_path / "arm.urdf").write_text(text(arm_tree(arm, UR5)), encoding="utf-8")
    (tmp_path / "ball.obj").write_text(sphere_obj(0), encoding="utf-8")
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    path = str(tmp_path / "arm.urdf")
    body = pybullet.loadURDF(path, useFixedBase=True, flags=flags, physicsClientId=client)

    def link_state(q, link):
        for joint, angle in enumerate(arm.joint_angle(q)):
            pybullet.resetJointState(body, joint, angle, physicsClientId=client)
        return pybullet.getLinkState(
            body, link, computeForwardKinematics=True, physicsClientId=client
        )

    link_state.dynamics = lambda link: pybullet.getDynamicsInfo(body, link, physicsClientId=client)
    yield link_state
    pybullet.disconnect(client)


def test_the_simulators_ball_joints_and_flange_are_where_the_arm_says(arm, loaded):
    postures = np.random.default_rng(0).uniform(-2 * np.pi, 2 * np.pi, (500, 6))
    simulated = np.array([loaded(pose, BALL)[4] for pose in postures])
    assert np.abs(simulated - arm.ball_position(postures)).max() <= 1e-6
    q = np.random.default_rng(1).uniform(-np.pi, np.pi, 6)
    frames = arm.frames(q)
    for link in range(7):
        state = loaded(q, link)
        np.testing.assert_allclose(state[4], frames[link, :3, 3], atol=1e-6)
        turned = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        np.testing.assert_allclose(turned, frames[link, :3, :3], atol=1e-5)


def test_the_centres_of_mass_are_those_of_the_data_sheet_in_the_dh_frames(arm, loaded):
    q = np.random.default_rng(2).uniform(-np.pi, np.pi, 6)
    for link, (frame, centre) in enumerate(zip(arm.frames(q), ur5.LINKS["centre"], strict=False)):
        in_joint = rotation_from_rpy(arm.rpy[link + 1]) @ centre + arm.translation[link + 1]
        np.testing.assert_allclose(
            loaded(q, link)[0], frame[:3, :3] @ in_joint + frame[:3, 3], atol=1e-6
        )


def test_masses_and_inertias_arrive_in_the_simulator(loaded):
    for link in range(6):
        info = loaded.dynamics(link)
        assert info[0] == pytest.approx(ur5.LINKS["mass"][link])
        across, along = ur5.LINKS["inertia"][link]
        np.testing.assert_allclose(sorted(info[2]), sorted([across, across, along]), rtol=1e-6)


def test_numbers_in_the_urdf_lose_no_digit():
    arm = odd_ur5()
    origins = arm_tree(arm, UR5).findall("joint/origin")
    written = np.array([[float(part) for part in origin.get("xyz").split()] for origin in origins])
    np.testing.assert_array_equal(written, np.vstack([arm.translation, arm.tool]))


def shapes(urdf, kind) -> list[tuple[str, str, str]]:
    """Link, place and geometry of all parts of a kind, the ball as its radius."""
    parts = []
    for link in ET.fromstring(urdf).iter("link"):
        for part in link.findall(kind):
            geometry = part.find("geometry")[0]
            what = (
                dict(geometry.attrib)
                if geometry.tag != "mesh"
                else {"radius": geometry.get("scale").split()[0]}
            )
            parts.append((link.get("name"), str(part.find("origin").attrib), str(what)))
    return parts


def test_what_is_drawn_is_what_collides(arm):
    drawn, solid = text(arm_tree(arm, UR5)), arm_mechanics(arm, 1.0, robot=UR5, shapes=True)
    assert shapes(drawn, "visual") == shapes(solid, "collision")
    assert shapes(drawn, "collision") == shapes(solid, "visual") == []
    assert shapes(arm_mechanics(arm, 1.0, robot=UR5, shapes=False), "collision") == []


def test_nothing_but_the_ball_is_reddish():
    robot = arm_tree(ur5.ur5_arm(), UR5)
    bench = ET.fromstring(bench_files()["bench.urdf"])
    for visual in [*robot.iter("visual"), *bench.iter("visual")]:
        red, green, blue, _ = (
            float(part) for part in visual.find("material/color").get("rgba").split()
        )
        is_ball = (
            visual.find("geometry/mesh") is not None
            and visual.find("geometry/mesh").get("filename") == "ball.obj"
        )
        assert (red > 2 * max(green, blue)) == is_ball


@pytest.mark.parametrize(
    "direction", [(0, 0, 1), (0, 0, -2), (1, 0, 0), (0.3, -0.4, 0.1), (-1, -1, -1)]
)
def test_rpy_along_turns_z_into_the_direction(direction):
    turned = pybullet.getMatrixFromQuaternion(
        pybullet.getQuaternionFromEuler(rpy_along(direction).tolist())
    )
    np.testing.assert_allclose(
        np.reshape(turned, (3, 3))[:, 2], np.array(direction) / np.linalg.norm(direction), atol=1e-7
    )


def read_obj(text) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (k, 3) and triangles, counted from 0, of a Wavefront OBJ file."""
    rows = [line.split() for line in text.splitlines()]
    vertices = np.array([[float(x) for x in row[1:]] for row in rows if row[0] == "v"])
    return vertices, np.array(
        [[int(x.split("//")[0]) - 1 for x in row[1:]] for row in rows if row[0] == "f"]
    )


def test_the_sphere_is_closed_round_and_turned_outwards():
    vertices, triangles = read_obj(sphere_obj(3))
    from trimesh.creation import icosphere

    same = icosphere(3)
    assert (vertices == same.vertices).all()
    assert (triangles == same.faces).all()
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, atol=1e-12)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert {tuple(edge) for edge in edges} == {tuple(edge) for edge in edges[:, ::-1]}
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) > 0).all()
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 * np.pi / 3, rel=0.01)


def test_rectangles_face_up_and_have_their_area():
    vertices, faces = read_obj(rectangles_obj([(0.0, 0.0, 1.0, 2.0), (3.0, 3.0, 4.0, 4.0)], -0.5))
    a, b, c = vertices[faces].transpose(1, 0, 2)
    np.testing.assert_allclose(np.cross(b - a, c - a)[:, 2] / 2, [1.0, 1.0, 0.5, 0.5])
    assert (vertices[:, 2] == -0.5).all()


def test_a_gear_ratio_of_zero_is_refused():
    stuck = replace(UR5.nominal, arm=replace(UR5.nominal.arm, gear_ratio=np.eye(6)[0]))
    with pytest.raises(ValueError, match="gear_ratio must not be zero"):
        BULLET.build(RenderedConfig(), replace(setup(), model=stuck))


def test_an_arm_with_another_number_of_joints_is_refused():
    arm = SerialArm(
        ("one",),
        np.zeros((2, 3)),
        np.zeros((2, 3)),
        np.zeros(1),
        np.ones(1),
        np.array([0.0, 0.0, 0.1]),
    )
    with pytest.raises(ValueError, match="arm must have 6 joints like the UR5, got 1"):
        arm_tree(arm, UR5)
