"""The elements of a URDF that describe an arm, checked, so that nothing that may carry geometry is lost in silence.

yourdfpy reads a copy of the file with the elements and attributes of `ATTRIBUTES` alone. Of the rest, shapes and the
parts of other programs are left out; an attribute or element that may carry geometry is refused, one that does not is
named in a remark.

Source: URDF 1.0 to 1.2 as urdfdom reads it, https://github.com/ros/urdfdom. 1.1 adds `quat_xyzw` to `origin`, in place
of `rpy`, 1.2 adds three limits that do not concern geometry.
"""

import difflib
import re
from collections import Counter
from collections.abc import Iterable
from io import BytesIO
from math import hypot, isfinite
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree import ElementTree as ET

from servobench.plant.contract.facts import read_facts
from servobench.plant.contract.faults import configuration_errors, one_line
from servobench.plant.contract.files import accessing
from servobench.plant.contract.settings import listed, remark, suggest
from servobench.plant.robot.arm import rpy_from_rotation

# An element of lxml, and the robot that yourdfpy makes of a URDF; neither is typed.
Element: TypeAlias = Any
Tree: TypeAlias = Any

RUN_XACRO = "run xacro first, and give what it prints: `xacro FILE > arm.urdf`"
READ_QUATERNION = 'quat_xyzw of <origin>, which is read; ROS reads it in <robot version="1.1"> only'
URDF = read_facts("urdf")
ATTRIBUTES = URDF["attributes"]
CHILDREN = URDF["children"]
SIMILAR = URDF["similar"]
REQUIRED = URDF["required"]
OF_OTHERS = URDF["of_others"]
OF_XACRO = URDF["of_xacro"]
ENDS = ("parent", "child")
# Elements of a joint whose values are geometry
GEOMETRY = ("origin", "axis", "limit", "mimic")
LIMITING = ("limit", "safety_controller")  # elements whose numbers may be infinite
TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
MOMENTS = {"ixx", "iyy", "izz"}
EXPRESSION = re.compile(r"\$[{(].*?[})]")  # xacro would replace it
# In names of limits without geometry
DYNAMIC = re.compile(r"effort|torque|current|velocity|accel|decel|jerk|damp|frict|stiff")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
INFINITE = re.compile(r"[-+]?inf(inity)?", re.IGNORECASE)
ZEROS = re.compile(r"[-+.0\s]*")
# Mark in a word that is no number, and remedy
REMEDIES = (
    (re.compile(r"[${}()*/]|pi"), RUN_XACRO),
    (re.compile(","), "numbers have a decimal point and blanks between them"),
    (
        re.compile("[a-zA-Zµ°]"),
        "units cannot be written: lengths are in m, angles in rad, masses in kg",
    ),
)
# Faults of XML that ROS tolerates as well
TOLERATED = ("NS_ERR_UNDEFINED_NAMESPACE", "ERR_UNKNOWN_VERSION", "ERR_RESERVED_XML_NAME")
LIKENESS = 0.75  # least ratio of difflib between a misspelt word and the one that is meant
MAX_TURN = 7.0  # [rad] largest usual angle of an rpy
ROUNDED_UNIT = 0.01  # largest deviation of a quaternion's norm from 1


def read_elements(path: Path) -> Tree:
    """Return links and joints of a URDF, as yourdfpy reads them.

    Raises:
        ValueError: the file is missing, malformed, no URDF, or has something that may carry geometry and is not known.
    """
    try:
        import yourdfpy  # noqa: PLC0415 - only the extra urdf brings it
    except ImportError as error:
        raise ValueError(
            f"robot file {path}: a URDF needs yourdfpy: pip install 'servobench[urdf]'"
        ) from error
    with accessing(path, "robot file", "read"):
        content = path.read_bytes()
    with configuration_errors(f"robot file {path} is no URDF: "):
        root = _parse(content)
    passed = dict[str, None]()
    with configuration_errors(f"robot file {path}: "):
        _refuse_xacro(root)
        robot = _copy_robot(root, passed)
    if root.get("version", "1.0") != "1.0":
        passed.pop(READ_QUATERNION, None)
    _remark_on_degrees(path, robot)
    if passed:
        remark(f"robot file {path} has what URDF 1.0 has not: {listed(list(passed), 6)}")
    urdf = yourdfpy.URDF.load(
        BytesIO(ET.tostring(robot, encoding="utf-8")),
        build_scene_graph=False,
        load_meshes=False,
        build_collision_scene_graph=False,
    )
    return urdf.robot


def _remark_on_degrees(path: Path, robot: ET.Element) -> None:
    """Remark on an rpy that is too large for an angle in rad."""
    for origin in robot.iter("origin"):
        for angle in origin.get("rpy", "").split():
            if abs(float(angle)) > MAX_TURN:
                remark(f"robot file {path} has an rpy of {angle}, and angles of a URDF are in rad")
                return


def _parse(content: bytes) -> Element:
    """Return the root of a URDF without comments; prefixes may be undefined, as in ROS."""
    from lxml import etree  # noqa: PLC0415 - comes with yourdfpy

    parser = etree.XMLParser(recover=True, remove_comments=True, remove_pis=True)
    try:
        root = etree.fromstring(content or b" ", parser)
    except etree.XMLSyntaxError as error:
        raise ValueError(one_line(error)) from error
    for fault in parser.error_log:
        if fault.type_name not in TOLERATED:
            message = one_line(fault.message)
            raise ValueError(f"{message}, line {fault.line}, column {fault.column}")
    if _tag(root) != "robot":
        raise ValueError(f"its root is <{_tag(root)}>, and that of a URDF is <robot>")
    return root


def _tag(element: Element) -> str:
    """Return the tag of an element with its prefix, if it has one."""
    name = str(element.tag).rpartition("}")[2]
    if element.prefix is None:
        return name
    return f"{element.prefix}:{name}"


def _refuse_xacro(root: Element) -> None:
    """Refuse elements of xacro, and its expressions but in the parts of other programs."""
    for part in root:
        for element in part.iter():
            tag = _tag(element)
            without_prefix = tag in OF_XACRO and element is part
            with_prefix = ":" in tag and "xacro" in element.tag
            found = ""
            if without_prefix or with_prefix:
                found = f"<{tag}>"
            elif _tag(part) not in OF_OTHERS:
                texts = (*element.attrib.values(), element.text or "")
                found = "".join(EXPRESSION.findall(" ".join(texts)))
            if found:
                raise ValueError(f"{found} in line {element.sourceline} is xacro: {RUN_XACRO}")


def _copy_robot(root: Element, passed: dict[str, None]) -> ET.Element:
    """Return a robot with the parts that an arm needs."""
    if not root.get("name"):
        raise ValueError("<robot> has no name")
    robot = ET.Element("robot", name=root.get("name"))
    for name in root.attrib:
        if ":" not in name and name not in ("name", "version"):
            passed[f"{name} of <robot>, which is left out"] = None
    names = list[str]()
    for part in root:
        tag = _tag(part)
        hidden = any(_tag(end.getparent()) == "joint" for end in part.iter("{*}parent"))
        if tag in ("link", "joint"):
            if not part.get("name"):
                raise ValueError(f"the <{tag}> in line {part.sourceline} has no name")
            names.append(f"{tag} {part.get('name')!r}")
            robot.append(_copy(part, names[-1], passed))
        elif tag in OF_OTHERS or ":" in tag:
            continue
        elif hidden or _is_like(tag, SIMILAR["robot"]):
            raise ValueError(
                f"<{tag}> in line {part.sourceline} is no element of a URDF; links and joints are <link> and "
                "<joint> directly in <robot>"
            )
        else:
            passed[f"<{tag}>"] = None
    for name, count in Counter(names).items():
        if count > 1:
            raise ValueError(f"there is more than one {name}")
    return robot


def _copy(source: Element, place: str, passed: dict[str, None]) -> ET.Element:
    """Return an element with the parts that an arm needs.

    Args:
        source: a link, a joint or an element in one.
        place: the link or joint, for messages.
        passed: takes parts that are left out and may matter to the user.

    Raises:
        ValueError: a value is malformed, something that may carry geometry is not known, or a needed part is missing.
    """
    tag = _tag(source)
    known = ATTRIBUTES[tag]
    copy = ET.Element(tag)
    for name, text in source.attrib.items():
        if name in known:
            _check_numbers(f"{place}: {tag} {name}", text, known[name], infinite=tag in LIMITING)
            copy.set(name, text)
        elif _attribute_matters(source, name, text):
            raise ValueError(
                f"{place}: {tag} has the attribute {name!r}; valid: {', '.join(known)}"
            )
        elif ":" not in name:
            passed[f"{name} of <{tag}>, which is left out"] = None
    text = (source.text or "").strip()
    if text and tag in GEOMETRY + ENDS:
        raise ValueError(f"{place}: {tag} holds the text {text!r}; its values are attributes")
    for part in source:
        _copy_part(part, copy, place, passed)
    if "quat_xyzw" in copy.attrib:
        _turn_by_quaternion(copy, place)
        passed[READ_QUATERNION] = None
    if tag == "joint":
        _check_joint(copy, place)
    return copy


def _copy_part(part: Element, copy: ET.Element, place: str, passed: dict[str, None]) -> None:
    """Append a part of an element, as far as an arm needs it, to the element's copy."""
    tag = _tag(part)
    known = CHILDREN.get(copy.tag, ())
    if tag not in known:
        if _element_matters(copy.tag, part):
            raise ValueError(
                f"{place}: {copy.tag} has the element <{tag}>; valid: {', '.join(known) or 'none'}"
            )
        passed[f"<{tag}> in <{copy.tag}>, which is left out"] = None
    elif tag in ATTRIBUTES:
        own = _copy(part, place, passed)
        other = copy.find(tag)
        if other is not None and ET.tostring(other) != ET.tostring(own):
            raise ValueError(f"{place}: {copy.tag} has two different <{tag}>; keep one")
        if tag == "inertia" and not set(own.attrib) >= MOMENTS:
            passed[f"inertia without {min(MOMENTS - set(own.attrib))} in {place}"] = None
        elif other is None:
            copy.append(own)


def _attribute_matters(element: Element, name: str, text: str) -> bool:
    """Return whether an unknown attribute of an element may carry geometry."""
    tag = _tag(element)
    if ":" in name:
        return False
    if tag in ("origin", "axis"):
        return not ZEROS.fullmatch(text)
    if tag == "limit" and DYNAMIC.search(name):
        return not {"effort", "velocity"} <= set(element.attrib)
    if tag == "joint" or tag in ENDS:
        return _is_like(name, SIMILAR["joint"]) or _is_vector(text)
    return tag in GEOMETRY


def _element_matters(parent: str, part: Element) -> bool:
    """Return whether an unknown element in another one may carry geometry."""
    tag = _tag(part)
    if ":" in tag:
        return False
    if parent not in SIMILAR:
        return parent in GEOMETRY + ENDS
    if _is_like(tag, SIMILAR[parent]):
        return True
    texts = list[str]()
    for element in part.iter():
        texts += (*element.attrib.values(), element.text or "")
    return parent == "joint" and any(map(_is_vector, texts))


def _is_like(word: str, words: Iterable[str]) -> bool:
    """Return whether a word is one of others misspelt, or has a geometric one of them in it."""
    lower = word.lower()
    if any(each in lower for each in words if each in GEOMETRY):
        return True
    close = difflib.get_close_matches(lower, words, n=1, cutoff=LIKENESS)
    return bool(close)


def _is_vector(text: str) -> bool:
    """Return whether a text is three numbers or more, not all of them zero."""
    words = text.replace(",", " ").split()
    are_numbers = len(words) >= 3 and all(map(NUMBER.fullmatch, words))
    return are_numbers and not ZEROS.fullmatch(text)


def _check_numbers(what: str, text: str, count: int, *, infinite: bool) -> None:
    """Refuse a text of another count of numbers, and words that are none; a count of 0 is any text."""
    if count == 0:
        return
    words = text.split()
    for word in words:
        # A limit may be infinite by its size or by its name.
        is_number = NUMBER.fullmatch(word) or INFINITE.fullmatch(word)
        if not is_number or not (infinite or isfinite(float(word))):
            remedy = next((f"; {remedy}" for fault, remedy in REMEDIES if fault.search(word)), "")
            raise ValueError(f"{what} has {word!r}, which is no number{remedy}")
    if len(words) != count:
        raise ValueError(f"{what}: the count of numbers must be {count}, got {text!r}")


def _turn_by_quaternion(origin: ET.Element, place: str) -> None:
    """Give an origin the rpy that its quaternion x, y, z, w stands for."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - a quarter of a second, which lists do not need

    quaternion = [float(word) for word in origin.attrib.pop("quat_xyzw").split()]
    if "rpy" in origin.attrib:
        raise ValueError(f"{place}: origin has both rpy and quat_xyzw; keep one")
    norm = hypot(*quaternion)
    if abs(norm - 1.0) > ROUNDED_UNIT:
        raise ValueError(f"{place}: origin quat_xyzw must have a norm of 1, got {norm:.3g}")
    rpy = rpy_from_rotation(Rotation.from_quat(quaternion).as_matrix())
    origin.set("rpy", " ".join(map(repr, rpy.tolist())))


def _check_joint(joint: ET.Element, place: str) -> None:
    """Refuse a joint that lacks a required element or attribute, or has an unknown type."""
    kind = joint.get("type", "")
    if kind not in TYPES:
        raise ValueError(f"{place} has the type {kind!r}; {suggest(kind, TYPES)}")
    for tag, name in REQUIRED.items():
        part = joint.find(tag)
        if part is None:
            if tag in ENDS:
                raise ValueError(f"{place} has no <{tag}>")
            continue
        is_needed = kind != "fixed" or tag in ENDS
        if is_needed and not part.get(name):
            raise ValueError(f"{place}: {tag} has no {name}")
