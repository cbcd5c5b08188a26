"""URDFs as others write them: nothing of the chain is lost in silence, and a gripper is no joint of the arm."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.own import write
from kit.plants import configure, setup
from kit.robots import arm_joints, odd_urdf, urdf_of
from servobench.plant.contract.settings import remark
from servobench.plant.rendered.plants import MUJOCO
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.urdf_chain import find_chain
from servobench.plant.robot.urdf_elements import read_elements
from servobench.plant.robot.urdf_file import _arm, _limits, _links, read_urdf_robot

pytest.importorskip("yourdfpy")

ODD = odd_urdf()
ORIGIN, AXIS, LIMIT = (
    '<origin xyz="0.35 0 0" rpy="0 0.2 0"/>',
    '<axis xyz="0 -1 0"/>',
    'lower="-1.5" upper="1.5"',
)
INERTIAL = '<inertial><mass value="2"/><inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
HEAVY = re.sub(r'<link name="(\w+)"/>', rf'<link name="\1">{INERTIAL}</link>', ODD)


@pytest.fixture(autouse=True)
def _remarks_anew():
    remark.cache_clear()


def chain_of(folder, text, tip=""):
    return find_chain(read_elements(write(folder, text, "arm.urdf")), tip)


def links_of(folder, text):
    """Return the links of a URDF's robot, and what no body has of them."""
    tree = read_elements(write(folder, text, "arm.urdf"))
    chain = find_chain(tree, "")
    flaws = []
    return _links(tree, chain.joints, _arm(chain), flaws)[0], flaws


def flange(chain):
    poses = np.eye(4)
    for each in (*(joint.origin for joint in chain.joints), chain.flange):
        poses = poses @ each
    return poses


@pytest.mark.parametrize("joint", ["joint_4", "bridge", "hand_joint"])
def test_a_quaternion_turns_a_joint_as_its_rpy(tmp_path, caplog, joint):
    plain = flange(chain_of(tmp_path, ODD))
    turn = re.search(rf'name="{joint}".*?(rpy="([^"]*)")', ODD)
    numbers = Rotation.from_euler("xyz", [float(word) for word in turn[2].split()]).as_quat()
    text = f"{ODD[: turn.start(1)]}quat_xyzw='{' '.join(map(repr, (1.005 * numbers).tolist()))}'{ODD[turn.end(1) :]}"
    np.testing.assert_allclose(flange(chain_of(tmp_path, text)), plain, atol=1e-9)
    assert 'ROS reads it in <robot version="1.1"> only' in caplog.text
    caplog.clear()
    chain_of(tmp_path, text.replace("<robot ", '<robot version="1.1" '))
    assert not caplog.text


def test_a_quaternion_turns_an_inertia_as_its_rpy(tmp_path):
    def inertia(origin):
        text = HEAVY.replace("<inertial>", f"<inertial><origin {origin}/>")
        return links_of(tmp_path, text)[0].inertia

    turn = " ".join(map(repr, Rotation.from_euler("xyz", [0.4, -0.3, 1.1]).as_quat().tolist()))
    np.testing.assert_allclose(
        inertia(f'quat_xyzw="{turn}"'), inertia('rpy="0.4 -0.3 1.1"'), atol=1e-12
    )


JOINT = '<joint name="joint_9" type="fixed"><parent link="foot"/><child link="link_9"/></joint>'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        *(
            (ORIGIN, f"<origin xyz='0.35 0 0' {attribute}/>", rf"joint 'joint_4': origin.* {word}")
            for attribute, word in {
                'euler="0 0.2 0"': "'euler'",
                'quat_wxyz="1 0 0 0"': "'quat_wxyz'; valid: xyz, rpy, quat_xyzw",
                'RPY="0 0.2 0"': "'RPY'",
                'rpy="0 0.2 0" quat_xyzw="0 0 0 1"': "both rpy and quat_xyzw",
                'quat_xyzw="0 0 0 0"': "quat_xyzw must have a norm of 1, got 0",
                'quat_xyzw="0 11.5 0"': "quat_xyzw: the count of numbers must be 4, got '0 11.5 0'",
                'rpy="0 0,2 0"': "rpy has '0,2', which is no number; numbers have a decimal point",
                'rpy="0 11deg 0"': "rpy has '11deg', .*; units cannot be written",
                'rpy="0 0.2"': "rpy: the count of numbers must be 3, got '0 0.2'",
                'rpy="0 pi/16 0"': "rpy has 'pi/16', which is no number; run xacro",
                'rpy="0 1_0 0"': "rpy has '1_0', which is no number",
                'rpy="0 nan 0"': "rpy has 'nan', which is no number",
            }.items()
        ),
        (
            ORIGIN,
            "<Origin xyz='0.35 0 0'/>",
            "joint 'joint_4': joint has the element <Origin>; valid: .*origin",
        ),
        (ORIGIN, "<orgin xyz='0.35 0 0'/>", "joint 'joint_4': joint has the element <orgin>"),
        (ORIGIN, "<pose>0.35 0 0 0 0.2 0</pose>", "joint 'joint_4': joint has the element <pose>"),
        (ORIGIN, "<origin>0.35 0 0</origin>", "joint 'joint_4': origin holds the text '0.35 0 0'"),
        (ORIGIN, f"{ORIGIN}<origin/>", "joint 'joint_4': joint has two different <origin>"),
        (
            ORIGIN,
            f"<parent link='link_3'>{ORIGIN}</parent>",
            "joint 'joint_4': parent has the element <origin>",
        ),
        (
            f"{ORIGIN}<axis",
            f"<axis>{ORIGIN}</axis><axis",
            "joint 'joint_4': axis has the element <origin>",
        ),
        (
            'name="joint_4"',
            'name="joint_4" origin="0.35 0 0"',
            "joint 'joint_4': joint has the attribute 'origin'",
        ),
        (AXIS, "<axis/>", "joint 'joint_2': axis has no xyz"),
        (AXIS, '<axis XYZ="0 -1 0"/>', "joint 'joint_2': axis has the attribute 'XYZ'"),
        (AXIS, '<Axis xyz="0 -1 0"/>', "joint 'joint_2': joint has the element <Axis>"),
        (
            AXIS,
            f'{AXIS}<mimic joint="joint_1" ratio="2"/>',
            "joint 'joint_2': mimic has the attribute 'ratio'",
        ),
        (AXIS, f"{AXIS}<mimic/>", "joint 'joint_2': mimic has no joint"),
        (LIMIT, 'min="-1.5" max="1.5"', "joint 'joint_2': limit has the attribute 'min'"),
        (LIMIT, f'{LIMIT} unit="deg"', "joint 'joint_2': limit has the attribute 'unit'"),
        (
            LIMIT,
            'lower="-1,5" upper="1.5"',
            "joint 'joint_2': limit lower has '-1,5', which is no number",
        ),
        (
            'name="joint_2" type="revolute"',
            'name="joint_2" type="Revolute"',
            "'Revolute'; did you mean 'revolute'",
        ),
        ('name="joint_2"', 'name="joint_1"', "there is more than one joint 'joint_1'"),
        (
            '<link name="link_4"/>',
            '<link name="link_4"/>' * 2,
            "there is more than one link 'link_4'",
        ),
        ('<parent link="foot"/>', "", "joint 'joint_1' has no <parent>"),
        ('<child link="link_1"/>', "<child/>", "joint 'joint_1': child has no link"),
        (
            '<link name="link_4"/>',
            f'<link name="link_4">{JOINT}</link>',
            "link 'link_4': link has the element <joint>",
        ),
        (
            "</robot>",
            "<Joint name='joint_9'/></robot>",
            "<Joint> in line 1 is no element of a URDF",
        ),
        (
            "</robot>",
            f"<joints>{JOINT}</joints></robot>",
            "<joints> in line 1 is no element of a URDF",
        ),
        (
            "</robot>",
            f"<group>{JOINT}</group></robot>",
            "<group> in line 1 is no element of a URDF",
        ),
        (
            "</robot>",
            f"{JOINT.replace('link_9', 'link_2')}</robot>",
            "'link_2' is the child of both 'joint_2' and 'joint_9'",
        ),
        ('<robot name="odd">', "<robot>", "<robot> has no name"),
        ('<robot name="odd">', "<sdf>", "is no URDF: "),
        (
            '<mass value="2"/>',
            '<mass value="2kg"/>',
            "link 'foot': mass value has '2kg', which is no number",
        ),
        (
            "<inertial>",
            "<inertial><Origin xyz='0 0 1'/>",
            "link 'foot': inertial has the element <Origin>",
        ),
    ],
)
def test_what_may_carry_geometry_and_is_not_known_is_refused_by_name(tmp_path, old, new, message):
    text = ODD if old in ODD else HEAVY
    assert old in text
    with pytest.raises(ValueError, match=message):
        chain_of(tmp_path, text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (AXIS, '<axis xyz="0 -1 0" rpy="0 0 0"/>', "rpy of <axis>, which is left out"),
        (
            AXIS,
            f'{AXIS}<joint_properties damping="0.2"/>',
            "<joint_properties> in <joint>, which is left out",
        ),
        (LIMIT, f'{LIMIT} current="10"', "current of <limit>, which is left out"),
        (
            "<inertial>",
            '<inertial><density value="2"/>',
            "<density> in <inertial>, which is left out",
        ),
        ('ixx="0.02" ', "", "inertia without ixx in link 'foot'"),
        (
            '<link name="link_4"/>',
            '<link name="link_4"><origin xyz="0 0 1"/></link>',
            "<origin> in <link>, which",
        ),
        ("</robot>", '<link name="stray"/></robot>', "links without a joint are left out: stray"),
        *(
            ("</robot>", f"{other}</robot>", "")
            for other in (
                '<gazebo><joint name="a"><parent>b</parent></joint><p>${x}</p></gazebo>',
                '<material name="a"/><!-- <xacro:macro/> ${x} -->',
                '<transmission name="a"><joint name="joint_1"/></transmission>',
                '<drake:joint name="a"/>',
            )
        ),
        (LIMIT, f'{LIMIT} drake:acceleration="3" jerk="1"', ""),
        (
            "<robot ",
            '\n<?xml version="1.0"?><robot xmlns="http://a.org" xmlns:xacro="http://a.org/xacro" ',
            "",
        ),
        *(
            ('<link name="link_4"/>', f'<link name="link_4"><{use}>{shape}</{use}></link>', "")
            for use in ("visual", "collision")
            for shape in (
                "",
                "<geometry/>",
                "<geometry><plane/></geometry>",
                '<geometry><capsule radius="0.05" length="0.3"/></geometry>',
                '<geometry><ellipsoid radii="0.1 0.1 0.2"/></geometry><origin euler="1"/>',
                '<geometry><box size="1,1"/></geometry>',
            )
        ),
    ],
)
def test_what_carries_no_geometry_is_left_out(tmp_path, caplog, old, new, message):
    text = ODD if old in ODD else HEAVY
    assert old in text
    np.testing.assert_array_equal(
        flange(chain_of(tmp_path, text.replace(old, new))), flange(chain_of(tmp_path, ODD))
    )
    assert message in caplog.text
    assert bool(message) == bool(caplog.text)


@pytest.mark.parametrize(
    "text",
    [
        ODD.replace("0.35 0 0", "${a} 0 0"),
        ODD.replace('name="hand"', 'name="$(arg prefix)hand"'),
        ODD.replace('lower="-1.5"', 'lower="{-2*pi}"'),
        ODD.replace("</robot>", '<xacro:gripper parent="hand"/></robot>'),
        ODD.replace("</robot>", '<x:gripper xmlns:x="http://www.ros.org/wiki/xacro"/></robot>'),
        ODD.replace("</robot>", '<include filename="hand.xacro"/></robot>'),
        ODD.replace(
            '<link name="hand"/>', '<link name="hand"><xacro:insert_block name="shape"/></link>'
        ),
        ODD.replace(
            '<link name="hand"/>',
            '<link name="hand"><visual><mesh filename="$(find a)/b"/></visual></link>',
        ),
    ],
)
def test_a_xacro_that_was_not_run_is_called_so(tmp_path, text):
    with pytest.raises(
        ValueError, match="run xacro first, and give what it prints: `xacro FILE > arm.urdf`"
    ):
        chain_of(tmp_path, text)
    with pytest.raises(
        ValueError, match="robot 'arm.urdf.xacro#hand' is a xacro file: run xacro first"
    ):
        find_robot("arm.urdf.xacro#hand")


@pytest.mark.parametrize(
    ("limit", "wanted", "said"),
    [
        (
            'lower="-inf" upper="inf"',
            (-2 * np.pi, 2 * np.pi, 2.0),
            "unlimited .* ±2π .*: lower of joint_2, upper of",
        ),
        (
            'lower="-1e308" upper="1e9"',
            (-2 * np.pi, 2 * np.pi, 2.0),
            "unlimited .* ±2π .*: lower of joint_2, upper of",
        ),
        ('lower="-Infinity" upper="1"', (-2 * np.pi, 1.0, 2.0), "unlimited .*: lower of joint_2$"),
        (
            'lower="-1.5"',
            (-1.5, 2 * np.pi, 2.0),
            "limits that the URDF lacks are taken as ±2π .*: upper of joint_2$",
        ),
        (
            'upper="2"',
            (-2 * np.pi, 2.0, 2.0),
            "limits that the URDF lacks are taken as ±2π .*: lower of joint_2$",
        ),
        (
            'lower="-20" upper="20"',
            (-20.0, 20.0, 2.0),
            "limits beyond ±4π rad; angles .* in rad: joint_2$",
        ),
    ],
)
def test_a_limit_that_is_given_is_kept_and_any_other_is_said(tmp_path, caplog, limit, wanted, said):
    chain = chain_of(tmp_path, ODD.replace(LIMIT, limit))
    limits = _limits([link.joint for link in chain.joints])
    assert (limits.lower[1], limits.upper[1], limits.speed[1]) == wanted
    assert re.search(said, caplog.text.strip())


def test_six_velocities_in_degrees_are_one_remark(tmp_path, caplog):
    chain = chain_of(tmp_path, ODD.replace('velocity="2"', 'velocity="180"'))
    _limits([link.joint for link in chain.joints])
    assert "of a URDF are in rad/s: joint_1, joint_2, joint_3, joint_4" in caplog.text
    assert len(caplog.records) == 1


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        (
            'lower="-180" upper="180"',
            "'joint_2': limits.0 must be at least -30, got -180.0; if -180deg is meant, write -3",
        ),
        ('lower="1.5" upper="-1.5"', "'joint_2': lower must be below upper, got 1.5 and -1.5"),
        ('lower="0" upper="0"', "'joint_2': lower must be below upper, got 0 and 0"),
    ],
)
def test_limits_in_degrees_or_without_a_range_are_refused(tmp_path, limit, message):
    chain = chain_of(tmp_path, ODD.replace(LIMIT, limit))
    with pytest.raises(ValueError, match=message):
        _limits([link.joint for link in chain.joints])


ARM, SHORT = arm_joints(6), arm_joints(3)
MIMIC = '<mimic joint="drive"/>'
PALM = ("palm_joint", "fixed", "link_6", "palm")
DRIVE = ("drive", "revolute", "palm", "left")
PAIR = [(f"{side}_f", "prismatic", "palm", f"{side}_finger") for side in ("left", "right")]
QUILL = ("quill", "prismatic", "link_3", "tip")
STROKE = '<limit lower="0" upper="0.05" effort="1" velocity="1"/>'


@pytest.mark.parametrize(
    ("joints", "n", "tip", "said"),
    [
        (
            [*ARM, PALM, DRIVE, ("r", "revolute", "palm", "right", MIMIC)],
            6,
            "palm",
            r"drive \(mimicked by 1\).*#left wo",
        ),
        (
            [*ARM, DRIVE[:2] + ("link_6", "left"), ("l", "revolute", "left", "tip", MIMIC)],
            6,
            "link_6",
            "mimicked by 1",
        ),
        ([*ARM, PALM, *PAIR], 6, "palm", r"left_f \(prismatic\), right_f \(prismatic\)"),
        (
            [*ARM, PALM, *(("finger", "revolute", "palm", "tip"),)],
            6,
            "palm",
            r"finger \(by its name\); #tip would",
        ),
        ([*ARM, PALM, ("gripper_controller", "revolute", "palm", "tip")], 6, "palm", "by its name"),
        (
            [*ARM, PALM, ("6", "revolute", "palm", "moving_jaw")],
            6,
            "palm",
            r"6 \(by its name\); #moving_jaw would",
        ),
        (
            [
                *ARM,
                PALM,
                DRIVE,
                ("l", "revolute", "left", "tip"),
                ("r", "revolute", "palm", "right", MIMIC),
                ("rr", "revolute", "right", "end"),
            ],
            6,
            "palm",
            r"drive \(mimicked by 1\), r \(mimics drive\)",
        ),
        ([*ARM, PALM, ("gripper_roll", "revolute", "palm", "tip")], 7, "tip", "^$"),
        (
            [*ARM, PALM, *(("a", "revolute", "palm", "x"), ("b", "revolute", "palm", "y"))],
            6,
            "palm",
            r"a \(one of 2 fingers\), b \(one of 2 fingers\); #x would take it",
        ),
        (
            [*ARM, PALM, *(row for k in "abc" for row in arm_joints(3, k, "palm"))],
            6,
            "palm",
            r"ajoint_1 \(one of 3 fingers\)",
        ),
        (
            [*ARM, PALM, *(row for k in "ab" for row in arm_joints(7, k, "palm"))],
            13,
            "alink_7",
            "as many joints lead to #b",
        ),
        (
            [row for k in "ab" for row in arm_joints(6, k)],
            6,
            "alink_6",
            "as many joints lead to #blink_6",
        ),
        ([*ARM, ("camera", "revolute", "link_2", "eye")], 6, "link_6", "^$"),
        ([*ARM, ("pan", "revolute", "link_5", "eye")], 6, "link_6", "as many joints lead to #eye"),
        (
            [*ARM, ("bar", "revolute", "link_3", "rod"), ("end", "revolute", "rod", "rod_end")],
            6,
            "link_6",
            "^$",
        ),
        (
            [*ARM, ("bar", "revolute", "link_4", "rod"), ("end", "revolute", "rod", "rod_end")],
            6,
            "link_6",
            "#rod_end",
        ),
        (
            [*ARM, ("bar", "revolute", "link_1", "rod", '<mimic joint="joint_2"/>')],
            6,
            "link_6",
            "^$",
        ),
        (
            [*ARM, ("bar", "revolute", "link_3", "rod", '<mimic joint="joint_4"/>')],
            6,
            "link_6",
            "^$",
        ),
        ([*ARM, ("a", "fixed", "link_6", "ft"), ("b", "fixed", "ft", "flange")], 6, "ft", "^$"),
        (
            [*ARM, ("a", "fixed", "link_6", "ft"), ("b", "fixed", "link_6", "flange")],
            6,
            "flange",
            "^$",
        ),
        (
            [*SHORT, DRIVE[:2] + ("link_3", "left"), ("l", "revolute", "left", "tip", MIMIC)],
            3,
            "link_3",
            "mimicked",
        ),
        (
            [*SHORT[:2], DRIVE[:2] + ("link_2", "left"), ("l", "revolute", "link_2", "tip", MIMIC)],
            3,
            "left",
            "^$",
        ),
        ([*SHORT, (*QUILL, STROKE)], 3, "link_3", r"quill \(prismatic\)"),
    ],
)
def test_a_chain_ends_before_the_tool_and_says_why(tmp_path, joints, n, tip, said):
    chain = chain_of(tmp_path, urdf_of(*joints))
    assert (len(chain.joints), chain.tip) == (n, tip)
    assert re.search(said, chain.ending)


def test_a_link_of_the_tool_that_is_named_takes_its_joints(tmp_path):
    text = urdf_of(*ARM, PALM, DRIVE, ("r", "revolute", "palm", "right", MIMIC))
    taken = chain_of(tmp_path, text, "left")
    assert [joint.joint.name for joint in taken.joints][-1] == "drive"
    assert len(taken.joints) == 7
    assert len(chain_of(tmp_path, text, "palm").joints) == 6


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (
            [*SHORT, QUILL],
            "'quill' after 'joint_3' is of type prismatic, which is not modelled; #link_3 leaves it out",
        ),
        (
            [*SHORT, QUILL, ("turn", "revolute", "tip", "end")],
            "'quill' on the way to 'end' is of type prismatic",
        ),
        (
            [("rail", "prismatic", "world", "base"), *ARM],
            "'rail' on the way to 'link_6' is of type prismatic",
        ),
        (
            [
                *SHORT,
                ("level", "revolute", "link_3", "bar", '<mimic joint="joint_2"/>'),
                ("w", "revolute", "bar", "end"),
            ],
            r"'level' on the way to 'end' turns with another \(mimic\).*#link_3",
        ),
        (
            [*ARM, ("a", "fixed", "x", "y"), ("b", "fixed", "y", "x")],
            "the joints before link 'x' form a circle",
        ),
    ],
)
def test_an_axis_of_the_arm_that_is_not_modelled_is_refused(tmp_path, joints, message):
    with pytest.raises(ValueError, match=message):
        chain_of(tmp_path, urdf_of(*joints))


@pytest.mark.parametrize(
    ("inertia", "message"),
    [
        (
            'ixx="20000" iyy="20000" izz="10000"',
            "inertia is implausible, as its largest moment is 2e.04 kg m²",
        ),  # kg mm²
        ('ixx="200" iyy="200" izz="100"', "inertia is implausible"),  # kg cm²
        ('ixx="68.3" iyy="68.3" izz="34.2"', "inertia is implausible"),  # lb in²
        (
            'ixx="1e-12" iyy="1e-12" izz="1e-12"',
            "inertia is implausible, as its largest moment is 1e-12 kg m²",
        ),
        ('ixx="2e-5" iyy="2e-5" izz="1e-5"', "inertia is implausible"),  # t m²
        ('ixx="1e-12" iyy="1e-12" izz="0.1"', "no body has the principal moments"),
        ('ixx="-0.02" iyy="0.02" izz="0.01"', "inertia must be positive definite"),
    ],
)
def test_an_inertia_that_no_body_has_is_named(tmp_path, inertia, message):
    plain = '"link_3">' + INERTIAL
    changed = plain.replace('ixx="0.02" iyy="0.02" izz="0.01"', inertia)
    _, flaws = links_of(tmp_path, HEAVY.replace(plain, changed))
    assert len(flaws) == 1
    assert re.match(f"link 'link_3': {message}", flaws[0])


def test_a_centre_of_mass_in_millimetres_is_named(tmp_path):
    _, flaws = links_of(tmp_path, HEAVY.replace("<inertial>", '<inertial><origin xyz="0 0 50"/>'))
    assert flaws[0] == "link 'link_1': its centre of mass is 50 m from joint 'joint_1'"
    assert links_of(tmp_path, HEAVY)[1] == []


def test_an_engine_does_not_take_a_robot_whose_inertia_no_body_has(tmp_path, caplog):
    pytest.importorskip("mujoco")
    text = HEAVY.replace('ixx="0.02"', 'ixx="20000"')
    robot = read_urdf_robot(write(tmp_path, text, "arm.urdf"), "")
    assert "link 'link_1': no body has" in caplog.text
    assert "; the physics engines refuse it" in caplog.text
    with pytest.raises(ValueError, match="robot arm: link 'link_1': no body has"):
        MUJOCO.build(configure(RenderedConfig), replace(setup(), nominal=robot))


def test_an_arm_that_finds_no_posture_says_what_was_left_out(tmp_path):
    fingers = [(f"finger_{i}", "revolute", "link_6", f"tip_{i}") for i in range(2)]
    lying = [(*joint[:4], '<origin xyz="0 0 0.001"/>') for joint in ARM]
    path = write(tmp_path, urdf_of(*lying, *fingers), "arm.urdf")
    with pytest.raises(ValueError, match=r"no posture .*; the tool, at rest, begins with finger_0"):
        find_robot(str(path))


def test_an_attribute_of_the_robot_that_may_scale_it_is_named(tmp_path, caplog):
    chain_of(tmp_path, ODD.replace("<robot ", '<robot scale="0.001" '))
    assert "scale of <robot>, which is left out" in caplog.text
