"""The plant `fmu`: the exported UR5, built on first use and kept in the user's cache folder."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import platformdirs

from servobench.fmus.compile import CompilationFailed, CompilerMissing
from servobench.fmus.export import ExportOptions, export_fmu, fingerprint
from servobench.fmus.variables import Actuation, parameters_of
from servobench.plant.checks import as_vector, check_number
from servobench.plant.fmu.config import FmuConfig
from servobench.plant.fmu.entry import build_plant
from servobench.plant.fmu.fmu_plant import FmuPlant
from servobench.plant.fmu.mapping import FmuMapping
from servobench.plant.plant import PlantEntry, PlantSetup
from servobench.plant.robot.hand_eye import FEATURE_NAMES
from servobench.plant.sensing import vary_sensing


@dataclass(frozen=True)
class Ur5FmuConfig:
    """Settings of the exported UR5; the same as those of the kinematic plant."""

    fmi_version: Literal[2, 3] = 2  # of FMI
    max_joint_speed: float = 1.0  # rad/s, a cautious share of the vendor's limit of π
    joint_range: float = 2 * np.pi  # rad each way, vendor's range
    lag: float = 0.05  # s, time constant of the joints' velocity loops; 0 = none
    command_delay_periods: int = 1  # periods between a command and its first effect
    feature_noise: float = 0.001  # m, standard deviation an axis
    latency_periods: int = 0  # periods between exposure and delivery of the feature
    drop_probability: float = 0.0  # chance that a frame is lost

    def __post_init__(self) -> None:
        """Check the numbers that no part below checks."""
        if self.fmi_version not in (2, 3):
            raise ValueError(f"fmi_version must be 2 or 3, got {self.fmi_version}")
        check_number("max_joint_speed", self.max_joint_speed, above=0.0)
        check_number("joint_range", self.joint_range, above=0.0)
        check_number("lag", self.lag, at_least=0.0)
        self.around()

    def around(self) -> FmuConfig:
        """Return the settings of what lies around the FMU."""
        return FmuConfig(self.command_delay_periods, self.feature_noise, self.latency_periods, self.drop_probability)


@cache
def cached_fmu(fmi_version: int) -> Path:
    """Return the nominal UR5 as FMU, from the user's cache folder; it is built there if anything in it has changed.

    Raises:
        CompilerMissing: it has to be built and there is no compiler.
        CompilationFailed: it has to be built and the compiler refused it.
    """
    options = ExportOptions(fmi_version)
    folder = Path(platformdirs.user_cache_dir("servobench")) / "fmus"
    path = folder / f"ur5_mismatched-fmi{fmi_version}-{fingerprint(options).strip('{}')}.fmu"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        export_fmu(path, options)
    return path


def ur5_mapping(path: Path, config: Ur5FmuConfig, setup: PlantSetup) -> FmuMapping:
    """Return the mapping of the exported UR5, with the true model of `setup` as its parameters."""
    model, start = setup.robot()
    start = as_vector("start", start, model.arm.n)
    actuation = Actuation(config.lag, config.max_joint_speed, config.joint_range, start)
    parameters = parameters_of(model, actuation)
    del parameters["home"]
    return FmuMapping(
        path=path,
        inputs=("joint_velocity_command",),
        joints=("joint_position",),
        features=("ball_position",),
        true_jacobian=("jacobian",),
        home="home",
        camera=("camera_position", "camera_rpy"),
        parameters=parameters,
        max_joint_speed=config.max_joint_speed,
        clips_itself=True,
        joint_lower=-config.joint_range,
        joint_upper=config.joint_range,
        joint_names=model.arm.joint_names,
        feature_names=FEATURE_NAMES,
    )


def build_ur5(config: Ur5FmuConfig, setup: PlantSetup) -> FmuPlant:
    """Return the exported UR5 as a plant.

    Raises:
        ValueError: a setting out of its bounds, a start of the wrong size, or an FMU that has to be built and cannot:
            no compiler, or no place in the cache folder.
    """
    try:
        path = cached_fmu(config.fmi_version)
    except (CompilerMissing, CompilationFailed, OSError) as error:
        raise ValueError(f"the FMU cannot be built: {error}") from error
    return build_plant(config.around(), ur5_mapping(path, config, setup), setup)


ENTRY = PlantEntry(
    name="fmu",
    summary="the exported UR5 as a co-simulation FMU, built and cached on first use",
    config=Ur5FmuConfig,
    build=build_ur5,
    sense=vary_sensing,
)
