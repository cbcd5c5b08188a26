"""FMU plants for the registry: any FMU by the mapping in a TOML file."""

from __future__ import annotations

from pathlib import Path

from servobench.plant.faults import FmuError
from servobench.plant.fmu.config import FmuConfig
from servobench.plant.fmu.fmu_plant import FmuPlant
from servobench.plant.fmu.mapping import FmuMapping, read_mapping
from servobench.plant.plant import PlantEntry, PlantSetup
from servobench.plant.sensing import vary_sensing


def build_plant(config: FmuConfig, mapping: FmuMapping, setup: PlantSetup) -> FmuPlant:
    """Return the plant of an FMU, for a registry.

    Raises:
        ValueError: an FMU, mapping or setting that cannot be used; also where the FMU itself says so.
    """
    try:
        start = mapping.start if setup.start is None else setup.start
        return FmuPlant(config, mapping, start, setup.period)
    except FmuError as error:
        raise ValueError(str(error)) from error


def mapped_entry(path: Path) -> PlantEntry:
    """Return the registry's entry of the plant `fmu:PATH`, the FMU that the mapping at `path` describes.

    Raises:
        ValueError: the mapping cannot be used.
    """
    mapping = read_mapping(path)

    def build(config: FmuConfig, setup: PlantSetup) -> FmuPlant:
        return build_plant(config, mapping, setup)

    summary = f"the FMU {mapping.path.name}, as mapped by {path.name}"
    return PlantEntry(f"fmu:{path}", summary, FmuConfig, build, sense=vary_sensing, own_robot=True)
