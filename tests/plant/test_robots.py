"""Robots by name and by file: the makers' numbers, the readers of files, and the workspace that is found for them."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from kit.own import assert_remarks, write
from kit.robots import FOUR_JOINTS, calibration_text, odd_urdf
from servobench.plant.rendered.settings import DriveConfig, drives_for
from servobench.plant.rendered.urdf import arm_tree, text
from servobench.plant.robot import files, urdf_file
from servobench.plant.robot.arm import JointLimits, narrow_limits, rotation_from_rpy
from servobench.plant.robot.catalogue import ROBOTS, find_robot, random_robot
from servobench.plant.robot.makers import UNIVERSAL_ROBOTS, nearest_title, read_calibration
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.robot import at_far_end, estimate_links
from servobench.plant.robot.workspace import find_workspace, segment_distance

INERTIAL = '<inertial><mass value="2"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
HEAVY = re.sub(r'<link name="(\w+)"/>', rf'<link name="\1">{INERTIAL}</link>', odd_urdf())
RNG = np.random.default_rng(7)


def flange(arm, q):
    return arm.frames(q)[..., -1, :3, 3]


def robot_of(folder, name, content):
    return find_robot(str(write(folder, content, name)))


def found(robot):
    """Return the workspace of a robot, found once more."""
    return find_workspace(robot.arm, robot.limits, robot.links)


@pytest.fixture(scope="session")
def four_joints(tmp_path_factory):
    """The workspace of an arm of four joints."""
    return robot_of(tmp_path_factory.mktemp("four"), "four.toml", FOUR_JOINTS).workspace


@pytest.fixture
def known_workspace(four_joints, monkeypatch):
    """Let arms of four joints that are read have a known workspace, which takes a second to find."""
    for reader in (files, urdf_file):
        monkeypatch.setattr(reader, "find_workspace", lambda *_: four_joints)


@pytest.mark.parametrize("title", UNIVERSAL_ROBOTS)
def test_an_arm_of_universal_robots_stretches_as_its_table_says(title):
    row = UNIVERSAL_ROBOTS[title]
    # At zero the arm lies along −x, its wrist turned to −y: the sums of the table's lengths.
    expected = row.a2 + row.a3, -row.d4 - row.d6, row.d1 - row.d5
    np.testing.assert_allclose(flange(row.arm(), np.zeros(6)), expected, atol=1e-12)


def test_the_panda_stands_upright_at_zero_as_its_maker_draws_it():
    np.testing.assert_allclose(
        flange(find_robot("panda").arm, np.zeros(7)), (0.088, 0.0, 0.926), atol=1e-12
    )


def test_the_robot_without_a_name_is_the_ur5_of_the_bench():
    robot, above = find_robot("ur5"), (0.5, 0.0, 1.55)
    np.testing.assert_allclose(robot.nominal.X_BC[:3, 3], above, atol=1e-12)
    np.testing.assert_array_equal(robot.nominal.X_BC[:3, 2], (0.0, 0.0, -1.0))
    assert (robot.workspace.scale, robot.workspace.clear) == (1.0, None)


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_what_controllers_know_of_a_robot_is_read_only(name):
    work = find_robot(name).workspace
    kept = (
        work.centre,
        work.shoulder,
        work.home,
        work.lower,
        work.upper,
        work.stretched,
        *work.moves["exp1"],
    )
    for array in map(np.asarray, kept):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


@pytest.fixture(scope="module", params=["ur3e", "panda", "four.toml"])
def robot(request, tmp_path_factory):
    if request.param in ROBOTS:
        return find_robot(request.param)
    return robot_of(tmp_path_factory.mktemp("robots"), request.param, FOUR_JOINTS)


def test_a_workspace_is_fit_to_work_in(robot):
    work, arm = robot.workspace, robot.arm
    assert work.clear(work.home)
    box = RNG.uniform(work.lower, work.upper, (300, robot.n))
    assert work.clear(box).mean() > 0.5
    assert (work.lower >= robot.limits.lower).all()
    assert (work.upper <= robot.limits.upper).all()
    np.testing.assert_allclose(arm.ball_position(work.home)[:2], work.centre[:2], atol=1e-5)
    for start, target in work.moves.values():
        assert work.clear(np.stack([start, target])).all()
        assert (
            np.linalg.norm(arm.ball_position(target) - arm.ball_position(start)) > 0.2 * work.scale
        )
    gains = [
        np.linalg.svd(arm.ball_and_jacobian(q)[1], compute_uv=False)[-1]
        for q in (work.stretched, work.home)
    ]
    assert gains[0] < 0.4 * gains[1]
    postures = np.stack([work.moves["exp1"][1], work.moves["exp4"][0], work.moves["exp2"][0]])
    outside = ((postures < work.lower) | (postures > work.upper)).any(axis=1)
    assert outside.tolist() == [True, True, False]  # as on a UR5


def test_a_workspace_is_found_again_bit_for_bit():
    robot = find_robot("ur3e")
    again = found(robot)
    for name in ("home", "lower", "upper", "stretched"):
        np.testing.assert_array_equal(getattr(again, name), getattr(robot.workspace, name))


def test_an_arm_that_cannot_reach_its_bench_is_refused():
    robot = find_robot("panda")
    pinned = replace(robot.limits, lower=np.full(7, -0.01), upper=np.full(7, 0.01))
    with pytest.raises(
        ValueError, match="no posture in which its ball is over the table.*look at its joint limits"
    ):
        found(replace(robot, limits=pinned))
    planar, ur5 = replace(robot.arm, rpy=np.zeros_like(robot.arm.rpy)), find_robot("ur5")
    low = replace(ur5.arm, translation=ur5.arm.translation * (np.arange(7) != 1)[:, None])
    for wrong in (replace(robot, arm=planar), replace(ur5, arm=low)):
        with pytest.raises(
            ValueError,
            match="no posture .* look at order, units and signs of its lengths and twists",
        ):
            found(wrong)
    with pytest.raises(
        ValueError,
        match=r"three joints or more and links with lengths, got 7 joints and links of 0 m",
    ):
        found(
            replace(robot, arm=replace(robot.arm, translation=np.zeros_like(robot.arm.translation)))
        )


def test_the_distance_of_segments_is_that_of_the_nearest_of_many_points():
    first, second, share = (
        RNG.normal(size=(50, 2, 3)),
        RNG.normal(size=(50, 2, 3)),
        np.linspace(0.0, 1.0, 201),
    )
    points = [
        s[:, 0, None] + share[:, None] * (s[:, 1] - s[:, 0])[:, None] for s in (first, second)
    ]
    nearest = np.linalg.norm(points[0][:, :, None] - points[1][:, None], axis=-1).min((1, 2))
    np.testing.assert_allclose(segment_distance(first, second), nearest, atol=2e-3)


def test_a_maker_s_limits_hold_beside_those_that_are_set():
    limits = narrow_limits(find_robot("panda").limits, 7, 1.0, 2.0)
    assert (limits.speed == 1.0).all()
    np.testing.assert_array_equal(limits.upper, [2.0, 1.7628, 2.0, -0.0698, 2.0, 2.0, 2.0])
    with pytest.raises(ValueError, match="joint_lower must be below joint_upper"):
        JointLimits(np.zeros(2), np.array([0.0, 1.0]), np.ones(2))
    with pytest.raises(ValueError, match="joint_velocity_limit must be positive"):
        JointLimits(np.zeros(2), np.ones(2), np.array([1.0, 0.0]))


def test_estimated_links_are_of_the_size_of_published_ones():
    own, estimated = find_robot("ur5").links, estimate_links(find_robot("ur5").arm)
    assert 0.5 < estimated.mass.sum() / own.mass.sum() < 1.5
    assert 0.5 < estimated.torque[1] / own.torque[1] < 2.0


def test_drives_in_proportion_to_a_ur5_are_those_of_the_ur5():
    default, own = DriveConfig(), drives_for(find_robot("ur5"))
    assert (own.torque_limit, own.velocity_bandwidth) == (
        default.torque_limit,
        default.velocity_bandwidth,
    )
    assert own.coulomb_friction == pytest.approx(default.coulomb_friction)
    assert (own.payload, own.assumed_payload, own.rotor_inertia) == (2.5, 0.9, (0.1,))
    assert drives_for(find_robot("panda")).torque_limit == (87.0,) * 4 + (12.0,) * 3


def test_inertia_in_a_urdf_has_the_moments_of_its_tensor():
    robot = find_robot("panda")
    link = arm_tree(robot.arm, robot).findall("link")[3]
    written = [float(link.find("inertial/inertia").get(axis)) for axis in ("ixx", "iyy", "izz")]
    np.testing.assert_allclose(written, np.linalg.eigvalsh(robot.links.inertia[2]), rtol=1e-9)


def test_a_body_in_the_frame_of_its_joint_is_the_same_body_at_the_far_end():
    arm = find_robot("panda").arm
    centre, tensor = RNG.normal(size=(7, 3)), RNG.normal(size=(7, 3, 3))
    far, turned = at_far_end(arm, centre, tensor @ np.swapaxes(tensor, -1, -2))
    R = rotation_from_rpy(arm.rpy[1:])
    np.testing.assert_allclose(np.matvec(R, far) + arm.translation[1:], centre, atol=1e-12)
    moments = np.linalg.eigvalsh(tensor @ np.swapaxes(tensor, -1, -2))
    np.testing.assert_allclose(np.linalg.eigvalsh(turned), moments, rtol=1e-9)


# Files


@pytest.mark.parametrize("title", UNIVERSAL_ROBOTS)
def test_a_calibration_file_tells_whose_it_is(tmp_path, title):
    path = write(tmp_path, calibration_text(UNIVERSAL_ROBOTS[title], seed=1), "mine.yaml")
    found_title, deviation = nearest_title(read_calibration(path, np.zeros(3)))
    assert found_title == title
    assert deviation < 3e-3


def test_a_calibrated_robot_is_held_against_its_data_sheet(tmp_path):
    robot = robot_of(tmp_path, "mine.yaml", calibration_text(UNIVERSAL_ROBOTS["UR3e"], seed=1))
    assert "factory calibration of a UR3e" in robot.note
    np.testing.assert_array_equal(robot.arm.translation, find_robot("ur3e").arm.translation)
    true, _ = sample_mismatch(Mismatch.parse("none"), robot, 0)
    apart = np.linalg.norm(
        true.arm.ball_position(robot.workspace.home) - robot.arm.ball_position(robot.workspace.home)
    )
    assert 1e-5 < apart < 5e-3


def test_a_calibration_of_another_arm_is_refused_with_the_remedy(tmp_path):
    path = write(tmp_path, calibration_text(UNIVERSAL_ROBOTS["UR10e"], seed=1), "mine.yaml")
    with pytest.raises(
        ValueError, match="is that of a UR10e .* the robot is a UR5; use the robot ur10e"
    ):
        sample_mismatch(Mismatch.parse(f"factory={path}"), find_robot("ur5"), 0)
    with pytest.raises(ValueError, match="which a Panda does not have"):
        sample_mismatch(Mismatch.parse("factory"), find_robot("panda"), 0)
    with pytest.raises(ValueError, match="calibration of one real UR5, and the robot is a UR3e"):
        sample_mismatch(Mismatch.parse("factory"), find_robot("ur3e"), 0)
    longer = path.read_text().replace("x: -0.6", "x: -0.9")
    path.write_text(longer)
    said = r"looks like an arm of Universal Robots that is not in the catalogue: bring its URDF, "
    said += r"or a DH table with a2 = "
    said += r"-0\.91\d\d, a3 = -0\.57\d\d, d1 = 0\.18\d\d, .*; the UR10e comes nearest, and its flange is 3\d\d mm away"
    with pytest.raises(ValueError, match=said):
        find_robot(str(path))
    with pytest.raises(ValueError, match=said):  # although the UR10e comes nearest
        sample_mismatch(Mismatch.parse(f"factory={path}"), find_robot("ur10e"), 0)
    path.write_text(longer.replace("roll: 1.57", "roll: 0.57", 1))
    with pytest.raises(ValueError, match="fits no arm of Universal Robots; the"):
        find_robot(str(path))


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("d = [0.35, 0.0, 0.0, 0.0]\n", "", "the key 'd' is missing"),
        ("d = [0.35,", "d = [", "d must have shape"),
        ("joint_speed = [2.0", "joint_speed = [-2.0", "joint_speed.* must be above 0"),
        ("joint_upper", "joint_uper", "the key 'joint_upper' is missing"),
        ("convention =", "length = 3\nconvention =", "has no setting 'length'"),
        ("a = [", "a = [[", "is not valid TOML"),
        (
            "d = [0.35",
            "d = [350",
            "d.0 must be at most 20, got 350; if 350mm is meant, write the unit, too",
        ),
        (
            "joint_upper = [",
            "joint_upper = [170, ",
            "joint_upper.0 must be at most 30, got 170; if 170deg is meant",
        ),
        (
            "joint_speed = [2.0",
            "joint_speed = [180",
            "joint_speed.0 must be at most 60, got 180; if 180deg/s is meant",
        ),
        ('"standard"', '"craig"', "convention must be one of standard, modified"),
    ],
)
def test_a_wrong_dh_table_is_named(tmp_path, before, after, message):
    assert before in FOUR_JOINTS
    with pytest.raises(ValueError, match=f"robot file .*arm.toml.*{message}"):
        robot_of(tmp_path, "arm.toml", FOUR_JOINTS.replace(before, after))


@pytest.mark.usefixtures("known_workspace")
def test_an_unlikely_dh_table_is_remarked_on(tmp_path, caplog):
    cases = [
        (
            'convention = "standard"\n',
            "",
            'is read by the standard convention; write convention = "standard" or',
        ),
        (
            "\nd = [",
            "\nmass = [3700, 1, 1, 1]\nd = [",
            "mass is 3700, and usually at most 500 kg; if 3700g is meant",
        ),
        (
            "\nd = [",
            "\ntorque = [15e4, 1, 1, 1]\nd = [",
            "torque is 150000, and usually at most 20000 Nm",
        ),
        (
            "joint_speed = [2.0",
            "joint_speed = [0.003",
            "joint_speed is 0.003, and usually at least 0.01 rad/s",
        ),
    ]
    assert_remarks(caplog, partial(robot_of, tmp_path, "arm.toml"), FOUR_JOINTS, cases)


@pytest.mark.usefixtures("known_workspace")
def test_an_unlikely_urdf_is_remarked_on(tmp_path, caplog):
    pytest.importorskip("yourdfpy")
    cases = [
        (
            'lower="-2.5" upper="2.5" effort="50" velocity="2"',
            'upper="2.5"',
            "limits that the URDF lacks are taken as ±2π rad and π rad/s: lower of joint_1, velocity of joint_1",
        ),
        ('rpy="0.1', 'rpy="90', "has an rpy of 90, and angles of a URDF are in rad"),
        (
            'iyy="0.01"',
            'iyy="0.04"',
            "'link_1': no body has the principal moments 0.01, 0.01, 0.04 kg m², one above the",
        ),
        (
            '<mass value="2',
            '<mass value="2000',
            "link 'link_1': mass is 2000, and usually at most 500 kg; if 2000g is meant, write 2, as",
        ),
    ]
    assert_remarks(caplog, partial(robot_of, tmp_path, "arm.urdf"), HEAVY, cases)


@pytest.mark.usefixtures("known_workspace")
def test_a_body_of_a_urdf_has_the_nearest_possible_inertia(tmp_path):
    """Least squares: both small moments grow by a third of what they lack together, and the largest shrinks as much."""
    pytest.importorskip("yourdfpy")
    cases, content = {1: 0.02, 3: 0.04}, HEAVY  # link -> moment
    for link, yy in cases.items():
        changed = INERTIAL.replace('iyy="0.01"', f'iyy="{yy}"')
        content = content.replace(f'"link_{link}">{INERTIAL}', f'"link_{link}">{changed}')
    inertia = robot_of(tmp_path, "arm.urdf", content).links.inertia
    for link, yy in cases.items():
        moments, third = np.linalg.eigvalsh(inertia[link - 1]), (yy - 0.02) / 3.0
        np.testing.assert_allclose(moments, (0.01 + third, 0.01 + third, yy - third), rtol=2e-6)
        assert moments[0] + moments[1] > moments[2]


ODD = odd_urdf()
TWO_TREES = ODD.replace(*(f'<parent link="link_{i}"/><child link="link_{7 - i}"/>' for i in (3, 4)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            HEAVY.replace('<axis xyz="0 -1 0"/>', '<axis xyz="0 0 0"/>'),
            ": joint 'joint_2' turns about the axis 0 0 0; the usual one",
        ),
        (
            HEAVY.replace('<axis xyz="0 -1 0"/>', '<axis xyz="0 -1 0"/><mimic joint="joint_1"/>'),
            r".*joint 'joint_2' on the way to '.*' turns with another \(mimic\), which .*; write type=.fixed. if",
        ),
        (
            HEAVY.replace('"fixed"', '"prismatic"'),
            ".*joint 'bridge' on .* is of type prismatic.*; write type=.fixed. if",
        ),
        (
            HEAVY.replace("0.35 0 0", "350 0 0"),
            ": joint 'joint_4': origin.0 .* 350.0; if 350mm is meant, write 0.35, as",
        ),
        (
            HEAVY.replace("0 0 0.3", "0 0 300"),
            ": joint 'joint_1': origin.2 .* 300.0; if 300mm is meant, write 0.3, as",
        ),
        (
            HEAVY.replace("0 0 0.3", "0 0 30"),
            ".* got 30.0; if 30cm or 30mm is meant, write 0.3 or 0.03, as units",
        ),
        (
            HEAVY.replace("0 0 0.3", "0 0 -1.2"),
            r": the arm has no posture .* at \(0, 0, -1.2\) m; .* at \(0, 0, 0\)",
        ),
        (
            HEAVY.replace("0 0 0.3", "0 3 0.3"),
            r": the arm has no posture .* at \(0, 3, 0.3\) m; .* an arm at \(0, 0, 0\)",
        ),
        (
            HEAVY.replace('<mass value="2', '<mass value="-2'),
            ": link 'link_1': mass must be above 0, got -2.0",
        ),
        (TWO_TREES, ".*both foot and link_4 are without a parent: a joint is missing or turned"),
        (
            ODD.replace('<link name="link_1"/>', '<link name="dink_1"/>'),
            ".*joint 'joint_1' is between links of which the file has no 'link_1'",
        ),
        *(
            (text, r" is no URDF: .*line \d+, column \d+")
            for text in ("<", "<robot name='a'><link", ODD + "<")
        ),
    ],
)
def test_a_urdf_of_no_arm_is_refused_in_one_line_in_which_its_reader_says_why(
    tmp_path, caplog, text, message
):
    pytest.importorskip("yourdfpy")
    with pytest.raises(ValueError, match=rf"robot file .*arm\.urdf{message}"):
        robot_of(tmp_path, "arm.urdf", text)
    assert caplog.records == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("pandda", "unknown robot 'pandda': did you mean 'panda'"),
        ("nowhere.urdf", "robot file nowhere.urdf cannot be read"),
        (
            "random_arm:1000001",
            "the number of a random_arm must be from 0 to 1,000,000, got 1000001",
        ),
        *(
            (f"random_arm:{number}", "random_arm needs a colon and a number, such as random_arm:7")
            for number in ("", "-1", "two", "99999999")
        ),
    ],
)
def test_a_name_of_no_robot_is_refused_with_what_is_wanted(name, message):
    with pytest.raises(ValueError, match=message):
        find_robot(name)


def test_a_urdf_that_was_written_here_is_read_as_the_same_arm(tmp_path):
    pytest.importorskip("yourdfpy")
    own = find_robot("ur3e")
    written = text(arm_tree(own.arm, own)).replace('type="continuous">', 'type="continuous">\n')
    read = robot_of(tmp_path, "written.urdf", written)
    postures = RNG.uniform(-3.0, 3.0, (5, 6))
    np.testing.assert_allclose(flange(read.arm, postures), flange(own.arm, postures), atol=1e-9)
    # of flange and ball
    np.testing.assert_allclose(read.links.mass, own.links.mass + np.array([0.0] * 5 + [0.002]))
    np.testing.assert_allclose(read.links.centre[:-1], own.links.centre[:-1], atol=1e-9)
    assert "6 joints" in read.note
    assert "estimated: torque limits" in read.note


@pytest.mark.usefixtures("known_workspace")
def test_a_link_has_the_mass_of_all_that_hangs_on_it(tmp_path):
    pytest.importorskip("yourdfpy")
    links = robot_of(tmp_path, "arm.urdf", HEAVY).links
    np.testing.assert_allclose(links.mass, [2.0, 4.0, 2.0, 6.0])  # a bridge; a hand with a finger
    np.testing.assert_allclose(np.linalg.eigvalsh(links.inertia[0]), [0.01] * 3)
    # 0.1 m on both sides
    np.testing.assert_allclose(np.linalg.eigvalsh(links.inertia[1]), [0.02, 0.06, 0.06])
    massless = robot_of(
        tmp_path, "massless.urdf", HEAVY.replace(f'"link_3">{INERTIAL}', '"link_3">')
    )
    assert "estimated: masses, inertia (no mass or inertia of link_3)" in massless.note


@pytest.mark.slow
def test_a_urdf_with_odd_axes_moves_as_its_reader_says(tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy")
    path = write(tmp_path, odd_urdf(), "odd.urdf")
    read = find_robot(str(path))
    oracle = yourdfpy.URDF.load(str(path), load_meshes=False)
    q = np.array([0.3, -0.4, 0.5, 0.2])
    oracle.update_cfg({f"joint_{i}": value for i, value in enumerate(q.tolist(), 1)})
    np.testing.assert_allclose(
        flange(read.arm, q), oracle.get_transform("hand", "foot")[:3, 3], atol=1e-9
    )
    np.testing.assert_array_equal(read.limits.upper, [2.5, 1.5, 2.5, 2.5])
    sensor = '<link name="force"/><joint name="force_joint" type="fixed"><parent link="link_4"/><child link="force"/>'
    hand = f'{sensor}<origin rpy="3.14159 0 0"/></joint><link name="flange"/>'
    renamed = (
        odd_urdf().replace('<link name="hand"/>', hand).replace('link="hand"', 'link="flange"')
    )
    ros = find_robot(str(write(tmp_path, renamed, "ros.urdf")))
    np.testing.assert_allclose(ros.arm.frames(q)[-1], read.arm.frames(q)[-1], atol=1e-12)
    with pytest.raises(ValueError, match="has no link 'hnd'"):
        find_robot(f"{path}#hnd")
    with pytest.raises(
        ValueError, match="'finger_joint' on .* type prismatic.*; name another link, such as #hand"
    ):
        find_robot(f"{path}#finger")
    with pytest.raises(ValueError, match="no chain of at least three turning joints"):
        find_robot(f"{path}#link_1")


@pytest.mark.slow
def test_arms_that_are_drawn_differ_and_each_is_the_same_for_ever():
    one, again, other = find_robot("random_arm:1"), random_robot(1), random_robot(0)
    q = np.full(one.n, 0.3)
    np.testing.assert_array_equal(one.arm.ball_position(q), again.arm.ball_position(q))
    assert not one.known
    assert 3 <= one.n <= 7
    assert one.n != other.n or not np.allclose(one.arm.translation, other.arm.translation)
    assert set(one.arm.gear_ratio) <= {-1.0, 1.0}
    assert find_robot("random_arm:1") is one


@pytest.mark.usefixtures("known_workspace")
def test_a_robot_file_takes_units(tmp_path):
    plain = robot_of(tmp_path, "arm.toml", FOUR_JOINTS)
    written = robot_of(tmp_path, "units/arm.toml", FOUR_JOINTS.replace("d = [0.35", 'd = ["350mm"'))
    np.testing.assert_array_equal(plain.arm.translation, written.arm.translation)
