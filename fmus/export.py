"""Exports an arm with mismatched kinematics as an FMU: sources, libraries, description, documentation, reference run.

Equal inputs give equal bytes: no date, no path and no machine name enters the archive.
"""

from __future__ import annotations

import hashlib
import html
import os
import re
import string
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import numpy as np

from servobench.fmus.compile import CODE, Platform, compile_library, library_files, this_platform
from servobench.fmus.eye_variables import View
from servobench.fmus.generate import kinematics_source, layout_header
from servobench.fmus.model_description import (
    REFERENCES,
    Description,
    write_build_description,
    write_fmi2,
    write_fmi3,
    write_references,
)
from servobench.fmus.reference import INPUT_FILE, OUTPUT_FILE, input_csv, output_csv, reference_run
from servobench.fmus.variables import Actuation, Layout, arm_groups, parameters_of
from servobench.plant.eyes.model import EyeModel
from servobench.plant.eyes.registry import Sensing
from servobench.plant.robot.catalogue import UR5, find_robot
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.sensed import SensedArm

MODEL = "ur5_mismatched"  # folder of the model, which is that of any arm
MACHINERY = "fmi"  # folder of the FMI functions, which know no model
HEADERS = {
    2: ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    3: ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
FMI_SOURCES = {2: ("fmi2.c", "fmi2_exchange.c"), 3: ("fmi3.c", "fmi3_exchange.c", "fmi3_absent.c")}
INSTANCE_HEADERS = {2: "fmi2_instance.h", 3: "fmi3_instance.h"}
SHARED_SOURCES = ("model.c", "instance.c", "kinematics.c")
COMMITTED = {MACHINERY: ("instance.h", "instance.c"), MODEL: ("kinematics.h", "model.h", "model.c")}
RELATED_FILES = (
    (INPUT_FILE, "testcase", "Commands of the reference run, each held over the step that begins at its time."),
    (OUTPUT_FILE, "result", "Outputs of the reference run, computed by an independent implementation."),
)
PIXELS = "a point p in a camera appears at principal_point + focal_length (1 + distortion r²) (p_x, p_y) / p_z"
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date that a zip archive can hold


def default_actuation(robot: Robot | None = None) -> Actuation:
    """Return the default lag and limits of the kinematic plant and the home of a robot; without one of the UR5."""
    described = robot or find_robot(UR5)
    home = described.workspace.home
    return Actuation(lag=0.05, max_speed=1.0, joint_range=2 * np.pi, home=home, limits=described.limits)


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export.

    Attributes:
        fmi_version: 2 or 3; each has co-simulation and model exchange.
        model: arm and camera whose numbers become the start values.
        actuation: lag, limits and home that become start values.
        platforms: platforms to compile for.
        mismatch: text for the documentation that says how the model differs from the nominal one.
        robot: by its maker's description.
    """

    fmi_version: int = 2
    model: SensedArm = field(default_factory=lambda: find_robot(UR5).nominal)
    actuation: Actuation = field(default_factory=default_actuation)
    platforms: tuple[Platform, ...] = field(default_factory=lambda: (this_platform(),))
    mismatch: str = "none"
    robot: Robot = field(default_factory=lambda: find_robot(UR5))

    def __post_init__(self) -> None:
        """Check version and platforms."""
        if self.fmi_version not in FMI_SOURCES:
            raise ValueError(f"fmi_version must be 2 or 3, got {self.fmi_version}")
        if not self.platforms:
            raise ValueError("platforms must name at least one platform, got none")

    @property
    def view(self) -> View | None:
        """What cameras see; None for the ball in 3-D by a fixed one."""
        return View.of(self.model) if isinstance(self.model, EyeModel) else None

    @property
    def layout(self) -> Layout:
        """Layout of the variables."""
        return arm_layout(self.model.arm.n, self.view)

    @property
    def identifier(self) -> str:
        """Name of the libraries: that of the robot, and of another sensing than `position`, as a word of C."""
        view = self.view
        word = re.sub(r"[^A-Za-z0-9_]", "_", self.robot.name if view is None else f"{self.robot.name}_{view.word}")
        return f"{word if word[:1].isalpha() else f'arm_{word}'}_mismatched"

    @property
    def title(self) -> str:
        """Name of the model."""
        view = self.view
        seen = "" if view is None else f", seen by {view.eye.name}{' on the hand' if view.mount == 'hand' else ''}"
        return f"{self.robot.title} with mismatched kinematics{seen}"

    @property
    def summary(self) -> str:
        """What the model is."""
        title, view = self.robot.title, self.view
        seen = "with a ball on its flange under a fixed camera" if view is None else f"and its cameras: {view.setting}"
        return (
            f"{'An' if title[:1] in set('AEIO') else 'A'} {title} {seen}; "
            "every length, angle and offset is a tunable parameter."
        )


def nominal_options(fmi_version: int, robot: Robot, sensing: Sensing | None = None) -> ExportOptions:
    """Return the options of an export of a robot without mismatch, by default with the sensing `position`.

    Raises:
        ValueError: the arm has too few joints for the sensing.
    """
    model = robot.nominal if sensing is None else sensing.nominal(robot)
    return ExportOptions(fmi_version, model, default_actuation(robot), robot=robot)


def export_fmu(path: Path, options: ExportOptions) -> Path:
    """Write the FMU to `path` atomically.

    Args:
        path: the .fmu file; its folder must exist.
        options: version, model, platforms.

    Returns:
        The path.

    Raises:
        ValueError: the folder does not exist.
        CompilerMissing: no compiler for one of the platforms.
        CompilationFailed: a compiler rejected the sources.
    """
    if not path.parent.is_dir():
        raise ValueError(f"the folder {path.parent} for the FMU does not exist")
    texts = source_files(options) | _companion_files(options)
    contents = {name: text.encode() for name, text in texts.items()}
    token = _token(contents)
    layout_name = "sources/layout.h"
    contents[layout_name] = contents[layout_name].replace(_PLACEHOLDER.encode(), token.encode())
    contents |= _descriptions(options, token)
    with tempfile.TemporaryDirectory(prefix="servobench-export-") as folder:
        _compile(Path(folder), contents, options)
        _write_archive(path, contents)
    return path


def fingerprint(options: ExportOptions) -> str:
    """Return a hash of all that determines the behaviour of the FMU: sources, descriptions, compilation."""
    contents = {name: text.encode() for name, text in source_files(options).items()}
    contents |= _descriptions(options, _PLACEHOLDER)
    for platform in options.platforms:
        contents[f"binaries/{platform.name}"] = repr((CODE, platform)).encode()
    return _token(contents)


def source_files(options: ExportOptions) -> dict[str, str]:
    """Return the C files of the FMU by their path in the archive, with a placeholder for the token."""
    layout, start = options.layout, parameters_of(options.model, options.actuation)
    texts = {name: _committed(folder, name) for folder, names in COMMITTED.items() for name in names}
    texts |= {name: _committed(MACHINERY, name) for name in FMI_SOURCES[options.fmi_version]}
    header = INSTANCE_HEADERS[options.fmi_version]
    texts[header] = _committed(MACHINERY, header)
    texts |= {name: _fmi_header(name) for name in HEADERS[options.fmi_version]}
    texts["kinematics.c"] = _kinematics(layout)
    texts["layout.h"] = layout_header(layout, start, options.identifier, _PLACEHOLDER)
    return {f"sources/{name}": text for name, text in texts.items()}


def _companion_files(options: ExportOptions) -> dict[str, str]:
    """Return documentation, licence and reference run by their path in the archive."""
    layout = options.layout
    run = reference_run(options.model, options.actuation)
    return {
        INPUT_FILE: input_csv(run, layout),
        OUTPUT_FILE: output_csv(run, layout),
        f"extra/{REFERENCES}/fmi-ls-manifest.xml": write_references(
            (f"../{file.removeprefix('extra/')}", role, text) for file, role, text in RELATED_FILES
        ).decode(),
        "documentation/index.html": _documentation(layout, options),
        "documentation/licenses/license.txt": _committed(MODEL, "license.txt"),
    }


@cache
def arm_layout(n: int, view: View | None = None) -> Layout:
    """Return the layout of an arm with `n` joints, with the ball in 3-D by a fixed camera or with another view."""
    return Layout(arm_groups(n, view), view)


_PLACEHOLDER = "{token}"


@cache
def _kinematics(layout: Layout) -> str:
    return kinematics_source(layout)


def _committed(folder: str, name: str) -> str:
    return (files("servobench.fmus") / folder / name).read_text(encoding="utf-8")


def _fmi_header(name: str) -> str:
    return (files("fmpy") / "c-code" / name).read_text(encoding="utf-8")


def _descriptions(options: ExportOptions, token: str) -> dict[str, bytes]:
    """Return the XML files by their path in the archive."""
    description = _description(options)
    if options.fmi_version == 2:
        return {"modelDescription.xml": write_fmi2(description, token)}
    return {
        "modelDescription.xml": write_fmi3(description, token),
        "sources/buildDescription.xml": write_build_description(description),
    }


def _description(options: ExportOptions) -> Description:
    return Description(
        model_name=options.title,
        model_identifier=options.identifier,
        summary=options.summary,
        layout=options.layout,
        start=parameters_of(options.model, options.actuation),
        sources=(*FMI_SOURCES[options.fmi_version], *SHARED_SOURCES),
        tool=f"servobench {version('servobench')}",
    )


def _token(contents: Mapping[str, bytes]) -> str:
    """Return a GUID that is a hash of everything in the FMU except its libraries."""
    digest = hashlib.sha256()
    for name in sorted(contents):
        digest.update(name.encode() + b"\0" + contents[name] + b"\0")
    text = digest.hexdigest()
    return "{" + "-".join((text[:8], text[8:12], text[12:16], text[16:20], text[20:32])) + "}"


def _documentation(layout: Layout, options: ExportOptions) -> str:
    template, view = _committed(MODEL, "documentation.html"), options.view
    rows = [
        f"<tr><td><code>{html.escape(group.name)}</code></td><td>{' × '.join(map(str, group.shape))}</td>"
        f"<td>{group.role}</td><td>{group.unit}</td><td>{html.escape(group.description)}</td></tr>"
        for group in layout.groups
    ]
    return string.Template(template).substitute(
        title=html.escape(options.title),
        summary=html.escape(options.summary),
        joints=options.model.arm.n,
        seen=f" and cameras: {html.escape(view.setting)}" if view else " carries a ball; a fixed camera sees it",
        feature="y = R_BC' (p_B(theta) - p_BC)" if view is None else PIXELS,
        mismatch="the nominal model"
        if options.mismatch == "none"
        else f"the mismatch “{html.escape(options.mismatch)}”",
        rows="\n".join(rows),
    )


def _compile(folder: Path, contents: dict[str, bytes], options: ExportOptions) -> None:
    for name, content in contents.items():
        if name.startswith("sources/"):
            file = folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
    libraries = {}
    for target in options.platforms:
        library = folder / "library" / target.name / f"{options.identifier}{target.suffix}"
        compile_library(folder / "sources", (*FMI_SOURCES[options.fmi_version], *SHARED_SOURCES), target, library)
        libraries[target] = library.read_bytes()
    contents |= library_files(libraries, options.identifier, options.fmi_version)


def _write_archive(path: Path, contents: Mapping[str, bytes]) -> None:
    handle, name = tempfile.mkstemp(prefix=path.name, suffix=".part", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file, zipfile.ZipFile(file, "w") as archive:
            for inside in sorted(contents, key=lambda name: (name != "modelDescription.xml", name)):
                entry = zipfile.ZipInfo(inside, ZIP_EPOCH)
                entry.compress_type, entry.create_system = zipfile.ZIP_DEFLATED, 3
                entry.external_attr = 0o644 << 16
                archive.writestr(entry, contents[inside], compresslevel=9)
        Path(name).chmod(0o644)
        Path(name).replace(path)
    finally:
        Path(name).unlink(missing_ok=True)
