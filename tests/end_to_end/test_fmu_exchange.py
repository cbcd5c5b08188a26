"""FMUs that offer model exchange only: the exported UR5 without its co-simulation side agrees with that side."""

import re
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import numpy as np
import pytest

from kit.foreign_fmu import ROLES, build_crane, describe_exchange
from servobench.fmus.ur5_plant import cached_fmu
from servobench.plant.contract.faults import FmuError
from servobench.plant.fmu.mapping import FmuMapping
from servobench.plant.fmu.world import FmuWorld

NAMES = {
    "inputs": ("joint_velocity_command",),
    "joints": ("joint_position",),
    "features": ("ball_position",),
}


def without_co_simulation(version: int, target: Path) -> Path:
    with zipfile.ZipFile(cached_fmu(version)) as archive, zipfile.ZipFile(target, "w") as copy:
        for entry in archive.infolist():
            content = archive.read(entry)
            if entry.filename == "modelDescription.xml":
                root = ET.fromstring(content)
                root.remove(root.find("CoSimulation"))
                content = ET.tostring(root)
            copy.writestr(entry, content)
    return target


@pytest.mark.parametrize("version", [2, 3])
def test_an_integrated_fmu_agrees_with_its_co_simulation_also_at_stops(version, tmp_path):
    path = without_co_simulation(version, tmp_path / "exchange.fmu")
    stops = {
        "joint_upper": np.full(6, 0.4),
        "joint_lower": np.full(6, -1.7),
        "home": np.full(6, 0.2),
    }
    worlds = [
        FmuWorld(FmuMapping(file, **NAMES, parameters=stops), None, 0.05)
        for file in (path, cached_fmu(version))
    ]
    for _ in range(2):
        held = 0
        for k in range(30):
            command = np.linspace(0.4, 1.0, 6) * (1.0 if k < 15 else -1.0)
            integrated, exact = (world.advance(command) for world in worlds)
            np.testing.assert_allclose(integrated, exact, rtol=0, atol=1e-6)
            np.testing.assert_allclose(*(world.see() for world in worlds), rtol=0, atol=1e-6)
            held += np.count_nonzero(exact == 0.4)
        assert held > 20
        for world in worlds:
            world.reset(0)
    state = worlds[0].save()
    first = worlds[0].advance(np.full(6, 0.3))
    worlds[0].restore(state)
    np.testing.assert_allclose(worlds[0].advance(np.full(6, 0.3)), first, rtol=0, atol=1e-9)
    for world in worlds:
        world.close()


@pytest.mark.parametrize("version", [2, 3])
def test_an_integrated_fmu_has_the_play_and_the_tool_of_its_co_simulation(version, tmp_path):
    path = without_co_simulation(version, tmp_path / "exchange.fmu")
    mechanics = {
        "backlash": np.full(6, 0.035),
        "ripple": np.full(6, 0.03),
        "ripple_order": np.full(6, 8.0),
    }
    mechanics |= {"tool_frequency": np.array([12.0]), "tool_damping": np.array([0.02])}
    files = path, cached_fmu(version)
    # Play is updated at completed steps of the integrator.
    worlds = [
        FmuWorld(FmuMapping(each, **NAMES, parameters=mechanics, period=0.005), None, 0.05)
        for each in files
    ]
    for k in range(40):
        for world in worlds:
            world.advance(np.linspace(0.4, 1.0, 6) * (1.0 if k < 15 else -1.0))
        np.testing.assert_allclose(*(world.see() for world in worlds), rtol=0, atol=2e-5)
    for world in worlds:
        world.close()


def test_what_an_fmu_refuses_within_the_solver_is_told(tmp_path):
    description = re.sub(r"<CoSimulation[^>]*/>", "", describe_exchange())
    path = build_crane(tmp_path / "crane.fmu", 2, description=description)
    world = FmuWorld(FmuMapping(path, **ROLES[2]), None, 0.05)
    np.testing.assert_allclose(
        world.advance(np.array([0.2, -0.4])) - [0.3, 1.2], [0.01, -0.02], atol=1e-9
    )
    with pytest.raises(FmuError, match="GetDerivatives returned error"):
        world.advance(np.array([99.0, 0.0]))
    world.close()
