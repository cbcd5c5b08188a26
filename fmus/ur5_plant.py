"""The plant `fmu`: the exported arm, built on first use and kept in the user's cache folder."""

from functools import cache
from pathlib import Path

import numpy as np

from servobench.fmus.variables import BALL, FEATURE, SEEN, View, parameters_of
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantEntry, PlantSetup
from servobench.plant.cameras.registry import Sensing
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.cache import BUILT, cached
from servobench.plant.contract.faults import configuration_errors
from servobench.plant.contract.settings import Delay, NonNegative, settings
from servobench.plant.fmu.dialect import FmiVersion
from servobench.plant.fmu.mapping import FmuMapping, JointLimits, LogNames, TruthMapping
from servobench.plant.kinematic import ArmConfig, KinematicConfig
from servobench.plant.robot.robot import Robot


@settings
class Ur5FmuConfig(ArmConfig):
    """Settings of the exported arm."""

    fmi_version: FmiVersion = 2
    """Version of FMI."""
    joint_lags: tuple[Delay, ...] = ()
    """[s] τ of each joint in place of `lag`; empty: none."""
    encoder_resolution: NonNegative = 0.0
    """[rad] step of reported positions; 0: exact."""


@cache
def cached_fmu(
    fmi_version: int, robot: Robot | None = None, sensing: Sensing | None = None
) -> Path:
    """Return a nominal robot, by default the UR5, as FMU, from the user's cache folder.

    It is built there if anything in it has changed.

    Args:
        fmi_version: 2 or 3.
        robot: None for the UR5.
        sensing: set-up of cameras; None for the ball in 3-D by a fixed one.

    Raises:
        CompilerMissing: it has to be built and there is no compiler.
        CompilationFailed: it has to be built and the compiler refused it.
        ValueError: it has to be built and the cache folder cannot be written.
    """
    from servobench.fmus.export import ExportOptions, export_fmu, fingerprint, nominal_setup  # noqa: PLC0415 - CasADi

    options = ExportOptions(fmi_version, nominal_setup(robot, sensing))
    name = f"{options.identifier}.fmu"
    key = f"{options.identifier}-fmi{fmi_version}-{fingerprint(options)}"
    return cached(BUILT, key, lambda folder: export_fmu(folder / name, options)) / name


def ur5_mapping(path: Path, config: Ur5FmuConfig, setup: PlantSetup) -> FmuMapping:
    """Return the mapping of the exported arm, with the true model of `setup` as its parameters, (..., size)."""
    model, _ = setup.robot()
    view = View.of(model) if isinstance(model, SetupModel) else None
    n = model.arm.n
    lag = config.joint_lags or (config.lag,)
    if len(lag) not in {1, n}:
        raise ValueError(f"joint_lags must have {n} numbers or none, got {len(lag)}")
    resolution = config.encoder_resolution
    mechanics = config.mechanics
    mechanics.check(model)
    own = KinematicConfig(config.max_joint_speed, config.joint_range, mechanics=mechanics)
    parameters = parameters_of(setup, own)
    parameters["lag"] = np.resize(lag, n)
    parameters["encoder_resolution"] = np.full(n, resolution)
    del parameters["home"]
    limits = JointLimits(
        parameters["max_speed"], parameters["joint_lower"], parameters["joint_upper"]
    )
    joints = "encoder_position" if resolution > 0.0 else "joint_position"
    features: tuple[str, ...] = (BALL,)
    seen: tuple[str, ...] = ()
    if view is not None:
        features = (FEATURE,)
        seen = (SEEN,)
    return FmuMapping(
        file=path,
        inputs=("joint_velocity_command",),
        joints=(joints,),
        features=features,
        seen=seen,
        truth=TruthMapping(jacobian=("jacobian",)),
        home="home",
        camera=("camera_position", "camera_rpy"),
        parameters=parameters,
        limits=limits,
        names=LogNames(model.arm.joint_names, model.channel.names, model.channel.unit),
    )


def build_ur5(config: Ur5FmuConfig, setup: PlantSetup) -> Bench:
    """Return the exported arm as a plant.

    Raises:
        ValueError: a setting out of its bounds, a start of the wrong size, or an FMU that has to be built and cannot:
            no compiler, or no place in the cache folder.
    """
    from servobench.plant.fmu.world import build_fmu  # noqa: PLC0415 - loads CasADi

    model, _ = setup.robot()
    sensing = Sensing(model.setup, model.mount) if isinstance(model, SetupModel) else None
    with configuration_errors("the FMU cannot be built: "):
        path = cached_fmu(config.fmi_version, setup.nominal, sensing)
    lag = float(np.mean(config.joint_lags or config.lag))
    mapping = ur5_mapping(path, config, setup)
    bench = build_fmu(mapping, setup, config.command_delay, config.sensing, lag, model)
    bench.world.mechanics = config.mechanics
    return bench


ENTRY = PlantEntry(
    name="fmu",
    summary="the exported arm as a co-simulation FMU, built and cached on first use",
    config=Ur5FmuConfig,
    build=build_ur5,
    side_by_side=True,
    any_sensing=True,
)
