"""Size, matrix and distortion of a camera in the YAML of calibration tools.

`camera_info` of ROS, `FileStorage` of OpenCV, of which Autoware has other names, camera chains of kalibr, settings of
VINS (camodocal), where the fisheye's k₁ … k₄ are k2 … k5, and those of ORB-SLAM, whose names begin with `Camera.`.
"""

import re
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from servobench.plant.contract.facts import read_facts
from servobench.plant.contract.faults import one_line
from servobench.plant.contract.files import Record, read_text, yaml_loader
from servobench.plant.contract.settings import remark

FACTS = read_facts("cameras")
NAMES = FACTS["names"]
LENSES = FACTS["lenses"]
PARTS = ("projection_parameters", "distortion_parameters")  # sections of VINS
# Parts of names, or whole names, of keys that may hold a distortion
DISTORTION = re.compile(r"dist(?!ance)|coeff|radial|tangential|^kc$|^[kp]_?\d$", re.IGNORECASE)
# Numbers that PyYAML takes for texts
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+|[-+]\.\d+")


def plain_name(text: str) -> str:
    """Return a name without capitals, blanks, hyphens and underscores."""
    return re.sub(r"[\W_]+", "", text.lower())


def read_intrinsics(path: Path) -> Record:
    """Return size, matrix and distortion of a file, by the keys of `CameraFile`.

    Raises:
        ValueError: a file that cannot be read, or a key that is missing.
    """
    found = _parse(path)
    if not isinstance(found, dict):
        raise ValueError(f"{path.name} has no image_width")  # noqa: TRY004 - as of a mapping without it
    found = _flat(_first_camera(path, found))
    keys = _known_keys(path, found)
    _check_part(path, found, keys)
    projection = next((str(found[name]) for name in FACTS["projections"] if name in found), "")
    if projection and "matrix" not in keys:
        raise ValueError(
            f"{path.name} is of the projection {projection!r}, which is not known or lacks its numbers"
        )
    for name in ("width", "height", "matrix"):
        if name not in keys:
            raise ValueError(f"{path.name} has no {NAMES[name][0]}")
    others = _distortions(found)
    if "distortion" not in keys and others:
        raise ValueError(f"{path.name} has {others[0]!r}; wanted the name distortion_coefficients")
    if "distortion_model" in keys:
        # An empty one stands for none in ROS.
        keys["distortion_model"] = keys["distortion_model"] or "none"
    if projection and plain_name(projection) not in FACTS["pinholes"]:
        keys["distortion_model"] = projection
    if found.get("fisheye_model"):
        keys["distortion_model"] = "fisheye"
    return keys | {"matrix": in_rows(keys["matrix"])}


def _known_keys(path: Path, found: Record) -> Record:
    """Return the values that a file has under one of the `NAMES` of a key, by the keys of `CameraFile`."""
    keys = Record()
    for key, names in NAMES.items():
        given = {name: _data(found[name]) for name in names if name in found}
        for name, value in given.items():
            if value != keys.setdefault(key, value):
                first = next(iter(given))
                raise ValueError(f"{path.name} has {first} and another {name}; leave one out")
    return keys


def in_rows(value: Any) -> Any:  # noqa: ANN401 - a value of a file
    """Return a list of nine numbers as three rows, and anything else as it is."""
    if isinstance(value, list) and len(value) == 9:
        return [value[:3], value[3:6], value[6:]]
    return value


def _parse(path: Path) -> Any:  # noqa: ANN401 - any content
    """Return the first document of a YAML file."""
    import yaml  # noqa: PLC0415 - few runs have such a file

    # OpenCV's matrices are mappings, and numbers such as 1e-05 and -.2 are texts in YAML 1.1.
    loader_class = yaml_loader()

    def mapping(loader: Any, node: Any) -> Any:  # noqa: ANN401 - PyYAML's
        return loader.construct_mapping(node, deep=True)

    loader_class.add_implicit_resolver("tag:yaml.org,2002:float", NUMBER, list("-+.0123456789"))
    for tag in ("opencv-matrix", "opencv-nd-matrix"):
        loader_class.add_constructor(f"tag:yaml.org,2002:{tag}", mapping)
    text = read_text("file", path)
    if text.lstrip().startswith("<"):
        raise ValueError(
            f"{path.name} is XML; wanted YAML, which OpenCV writes where the name ends in .yml"
        )
    if text.startswith("%YAML"):
        # OpenCV writes a directive that PyYAML does not read.
        text = text.partition("\n")[2]
    try:
        documents = yaml.load_all(text, loader_class)
        # `ros2 topic echo` puts --- after each message.
        return next(documents, None)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{path.name} is not valid YAML: {one_line(error)}") from error


def _first_camera(path: Path, found: dict[Any, Any]) -> dict[Any, Any]:
    """Return the first camera of a chain of kalibr, and the keys of any other file as they are."""
    cameras = []
    for name, value in found.items():
        if re.fullmatch(r"cam\d+", str(name)) and isinstance(value, dict):
            cameras.append(name)
    if not cameras:
        return found
    if len(cameras) > 1:
        remark(f"{path.name}: the camera {cameras[0]} of {', '.join(cameras)} is taken")
    return found[cameras[0]]


def _flat(found: dict[Any, Any]) -> Record:
    """Return keys with those of VINS, kalibr and ORB-SLAM under the names of ROS, where a file has them."""
    keys = {str(name): value for name, value in found.items()}
    for name, value in list(keys.items()):
        if name.startswith(("Camera.", "Camera1.")):
            keys.setdefault(name.partition(".")[2], value)
        if name in PARTS and isinstance(value, dict):
            keys |= value
    size = next((keys[name] for name in FACTS["sizes"] if name in keys), None)
    if isinstance(size, list) and len(size) == 2:
        keys["image_width"], keys["image_height"] = size
    numbers = keys.get("intrinsics")
    for names in FACTS["focal_names"]:
        if all(name in keys for name in names):
            numbers = [keys[name] for name in names]
    if isinstance(numbers, list) and len(numbers) == 4:
        fx, fy, cx, cy = numbers
        keys.setdefault("camera_matrix", [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
    given = {name: keys[name] for name in LENSES["rational_polynomial"] if name in keys}
    if "mu" in keys:
        names_in_vins = zip(LENSES["equidistant"], FACTS["fisheye_of_vins"], strict=True)
        given = {name: keys.get(other, 0.0) for name, other in names_in_vins}
    if given and not any(name in keys for name in NAMES["distortion"]):
        keys["distortion_coefficients"] = given
    return keys


def _distortions(found: Record) -> list[str]:
    """Return the names of keys, also in a section, that may hold a distortion and are not known."""
    known = (*NAMES["distortion_model"], *PARTS)
    names = list[str]()
    for name, value in found.items():
        names.append(name)
        if isinstance(value, dict):
            names += map(str, value)
    return [name for name in names if name not in known and DISTORTION.search(name)]


def _data(value: Any) -> Any:  # noqa: ANN401 - a value of a file
    """Return the numbers of a matrix as a flat list, and other values as they are.

    Raises:
        ValueError: a cell of a matrix is no finite number.
    """
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    if value is None:
        return []
    if isinstance(value, list):
        cells = np.array(value, dtype=object).ravel().tolist()
        for cell in cells:
            if not isinstance(cell, int | float) or not isfinite(cell):
                raise ValueError(f"a matrix must hold finite numbers, got {cell!r}")
        return cells
    return value


def _check_part(path: Path, found: Record, keys: Record) -> None:
    """Refuse a message of ROS about a part of a larger image."""
    roi = found.get("roi")
    if not isinstance(roi, dict):
        roi = {}
    given_and_whole = (
        (found.get("binning_x"), 1),
        (found.get("binning_y"), 1),
        (roi.get("width"), keys.get("width")),
        (roi.get("height"), keys.get("height")),
    )
    if any(given not in (None, 0, whole) for given, whole in given_and_whole):
        raise ValueError(
            f"{path.name} is of a larger image, of which binning or a region (roi) leaves a part; write size and "
            "matrix of the image as it comes into a TOML"
        )
