"""Exports an arm with mismatched kinematics as an FMU."""

import hashlib
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

from servobench.fmus.compiler import CODE, Platforms, this_platform
from servobench.fmus.dialect import export_dialect
from servobench.fmus.model_description import Description, exporter
from servobench.fmus.product import Product, c_files, documentation, word
from servobench.fmus.reference import reference_run, tables
from servobench.fmus.sources import arm_constants, kinematics_source
from servobench.fmus.variables import ARM, ArmLayout, View, arm_groups, parameters_of
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.registry import SETUPS, Sensing
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.ur5 import UR5

CORE = "kinematics"
PACKAGES = tuple(Path(__file__).parents[1] / name for name in ("fmus", "plant"))
SOURCES = {
    ".py",
    ".pyc",
    ".c",
    ".h",
    ".html",
    ".txt",
    ".csv",
}  # .pyc of an installation without .py
STEP = 0.05  # [s] step of the default experiment
PIXELS = "a point p in a camera appears at principal_point + focal_length (1 + distortion r²) (p_x, p_y) / p_z"


def nominal_setup(robot: Robot | None = None, sensing: Sensing | None = None) -> PlantSetup:
    """Return a robot, by default the UR5, without mismatch at home, by default with the sensing `position`.

    Raises:
        ValueError: the arm has too few joints for the sensing.
    """
    robot = robot or find_robot(UR5)
    model = robot.nominal if sensing is None else sensing.nominal(robot)
    return PlantSetup(model, robot.workspace.home, STEP, robot)


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export."""

    fmi_version: int = 2  # 2 or 3; each has co-simulation and model exchange
    # Arm, cameras and home that become start values, and the step of default experiment and reference run.
    setup: PlantSetup = field(default_factory=nominal_setup)
    config: KinematicConfig = field(default_factory=KinematicConfig)  # lag, limits and mechanics
    platforms: Platforms = field(default_factory=lambda: (this_platform(),))  # to compile for
    # Text for the documentation that says how the model differs from the nominal one.
    mismatch: str = "none"

    def __post_init__(self) -> None:
        """Check version and platforms."""
        export_dialect(self.fmi_version)
        if not self.platforms:
            raise ValueError("platforms must name at least one platform, got none")

    @property
    def model(self) -> RobotModel:
        """Arm and cameras."""
        return self.setup.robot()[0]

    @property
    def robot(self) -> Robot:
        """The robot by its maker's description."""
        return self.setup.nominal or find_robot(UR5)

    @property
    def view(self) -> View | None:
        """The sensing set-up; None for the ball in 3-D by a fixed camera."""
        model = self.model
        if isinstance(model, SetupModel):
            return View.of(model)
        return None

    @property
    def layout(self) -> ArmLayout:
        """Layout of the variables."""
        return arm_layout(self.model.arm.n, self.view)

    @property
    def identifier(self) -> str:
        """Name of the libraries: that of the robot, and of another sensing than `position`, as a word of C."""
        name = self.robot.name
        view = self.view
        if view is not None:
            name = f"{name}_{view.word}"
        return f"{word(name, 'arm')}_mismatched"

    @property
    def title(self) -> str:
        """Name of the model."""
        title = f"{self.robot.title} with mismatched kinematics"
        view = self.view
        if view is None:
            return title
        place = " on the hand" if view.mount == "hand" else ""
        return f"{title}, seen by {view.setup.name}{place}"

    @property
    def summary(self) -> str:
        """The model in one sentence."""
        title = self.robot.title
        article = "An" if title[:1] in set("AEIO") else "A"
        seen = "with a ball on its flange under a fixed camera"
        view = self.view
        if view is not None:
            seen = f"and its cameras: {view.setting}"
        return f"{article} {title} {seen}; every length, angle and offset is a tunable parameter."


def export_fmu(path: Path, options: ExportOptions) -> Path:
    """Write the FMU to `path` atomically; see `Product.write`."""
    return product(options).write(path, options.platforms)


def fingerprint(options: ExportOptions) -> str:
    """Return a hash of all that an FMU is made from, without making it.

    These are the files of the packages `fmus` and `plant`, the versions of the exporter, CasADi and fmpy, the options
    and their numbers, and of a set-up that is not one of `plant.cameras` its equations.
    """
    view = options.view
    parts = [
        exporter(),
        version("casadi"),
        version("fmpy"),
        CODE,
        options.platforms,
        options.fmi_version,
        options.title,
        options.identifier,
        options.summary,
        None if view is None else view.size,
    ]
    if view is not None and view.setup not in SETUPS.values():
        parts += [options.layout.groups, kinematics_source(options.layout)]
    digest = hashlib.sha256(repr(parts).encode())
    for name, values in parameters_of(options.setup, options.config).items():
        digest.update(name.encode() + np.asarray(values).tobytes())
    root = PACKAGES[0].parent
    for path in _source_files():
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()[:32]


def _source_files() -> list[Path]:
    """Return the files that an FMU is made from, sorted."""
    paths = [path for folder in PACKAGES for path in folder.rglob("*")]
    return sorted(
        path for path in paths if path.suffix in SOURCES and path.parent.name != "__pycache__"
    )


def product(options: ExportOptions) -> Product:
    """Return the content of the FMU."""
    layout = options.layout
    seen = " carries a ball; a fixed camera sees it"
    feature = "y = R_BC' (p_B(theta) - p_BC)"
    view = options.view
    if view is not None:
        seen = f" and cameras: {view.setting}"
        feature = PIXELS
    mismatch = "the nominal model"
    if options.mismatch != "none":
        mismatch = f"the mismatch “{options.mismatch}”"
    return Product(
        fmi_version=options.fmi_version,
        folder=ARM,
        core=CORE,
        source=kinematics_source(layout),
        constants=arm_constants(layout),
        description=Description(
            model_name=options.title,
            model_identifier=options.identifier,
            summary=options.summary,
            layout=layout,
            start=parameters_of(options.setup, options.config),
            sources=c_files(options.fmi_version, CORE),
            step=options.setup.period,
        ),
        documentation=documentation(
            ARM,
            layout,
            title=options.title,
            summary=options.summary,
            joints=str(options.model.arm.n),
            seen=seen,
            feature=feature,
            mismatch=mismatch,
        ),
        reference=tables(reference_run(options.setup, options.config), layout),
    )


@cache
def arm_layout(n: int, view: View | None = None) -> ArmLayout:
    """Return the layout of an arm with `n` joints, with the ball in 3-D by a fixed camera or with another view."""
    return ArmLayout(arm_groups(n, view), view)
