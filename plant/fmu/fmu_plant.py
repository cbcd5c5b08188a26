"""Any FMI 2 or FMI 3 co-simulation FMU as a plant; delay, noise, latency and lost frames are those of the bench."""

from __future__ import annotations

from pathlib import Path

from servobench.plant.bench.bench import Bench, build_bench
from servobench.plant.bench.plant import PlantEntry, PlantSetup
from servobench.plant.contract.faults import FmuError
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import NonNegative, nested, settings
from servobench.plant.fmu.mapping import FmuMapping, read_mapping
from servobench.plant.fmu.world import FmuWorld
from servobench.plant.robot.hand_eye import SensedArm


@settings
class FmuConfig:
    """Settings of an FMU plant; the same as those of the kinematic plant where both have them."""

    command_delay: NonNegative = 0.05
    """[s] between a command and its first effect; a multiple of the control period, or whole milliseconds."""
    sensing: SensingConfig = nested(SensingConfig)
    """Noise, latency, frame period and lost frames."""
    isolate: bool = True
    """Carry its runs out in a process of their own, with limits; false for an FMU that you trust like servobench."""


def build_fmu(
    mapping: FmuMapping,
    setup: PlantSetup,
    command_delay: float,
    sensing: SensingConfig,
    lag: float | None = None,
    model: SensedArm | None = None,
) -> Bench:
    """Return the plant of an FMU, for a registry.

    Args:
        mapping: the roles of its variables.
        setup: start and control period.
        command_delay: between a command and its first effect, s.
        sensing: noise, latency, frame period and lost frames.
        lag: time constant of the FMU's joints, s; None where it is unknown.
        model: what the FMU is known to be, for names, unit and natural size of its features.

    Raises:
        ValueError: an FMU or mapping that cannot be used; also if the FMU itself says so.
    """
    try:
        start = mapping.start if setup.start is None else setup.start
        return build_bench(lambda own: FmuWorld(mapping, start, own.period, lag, model), setup, command_delay, sensing)
    except FmuError as error:
        raise ValueError(str(error)) from error


def mapped_entry(path: Path) -> PlantEntry:
    """Return the registry's entry of the plant `fmu:PATH`, the FMU that the mapping at `path` describes.

    Raises:
        ValueError: the mapping cannot be used.
    """
    mapping = read_mapping(path)

    def build(config: FmuConfig, setup: PlantSetup) -> Bench:
        return build_fmu(mapping, setup, config.command_delay, config.sensing)

    summary = f"the FMU {mapping.file.name}, as mapped by {path.name}"
    return PlantEntry(f"fmu:{path}", summary, FmuConfig, build, own_robot=True)
