"""What a step of the FMU plant costs beside the calls that it cannot do without, all in one run.

bare      set, doStep and get by ctypes with arguments that were built once: the floor
plant     Bench.step, without noise and delay
fmpy      setReal, doStep and getReal of fmpy's FMU2Slave, with lists
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from typing import cast

import numpy as np
from fmpy.fmi2 import FMU2Slave

from servobench.fmus.ur5_plant import Ur5FmuConfig, build_ur5
from servobench.plant.bench import Bench, SensingConfig
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.world import FmuWorld
from servobench.plant.plant import PlantSetup
from servobench.plant.robot.ur5 import HOME, nominal_ur5
from servobench.plant.signals import Command

CALLS = 200
ROUNDS = 400
PERIOD = 0.05


def open_plant() -> Bench:
    """Return the exported UR5 without anything around it."""
    config = Ur5FmuConfig(command_delay_periods=0, sensing=SensingConfig(0.0))
    return build_ur5(config, PlantSetup(nominal_ur5(), np.array(HOME), PERIOD))


def fmu_world(plant: Bench) -> FmuWorld:
    """Return the FMU on the bench."""
    return cast(FmuWorld, plant.world)


def bare_calls(plant: Bench) -> Callable[[int], None]:
    """Return a step by three calls with prebuilt arguments."""
    world = fmu_world(plant)
    instance = world._instances.lanes[0].instance
    library, component = instance._library, instance._component
    set_real, inputs = library.fmi2SetReal, (*world._command.variables, world._command.pointer())
    get_real, outputs = library.fmi2GetReal, (*world._result.variables, world._result.pointer())
    do_step, now, step, yes = library.fmi2DoStep, ctypes.c_double(), ctypes.c_double(PERIOD), ctypes.c_int(1)

    def call(k: int) -> None:
        set_real(component, *inputs)
        now.value = k * PERIOD
        do_step(component, now, step, yes)
        get_real(component, *outputs)

    return call


def fmpy_calls(plant: Bench) -> Callable[[int], None]:
    """Return a step by fmpy's own methods."""
    world = fmu_world(plant)
    description = world.description
    slave = FMU2Slave(
        guid=description.token,
        modelIdentifier=description.identifier,
        unzipDirectory=str(extract_fmu(description.path)),
        instanceName="fmpy",
    )
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    inputs, outputs = list(world._command.variables[0]), list(world._result.variables[0])
    command = [0.1] * len(inputs)

    def call(k: int) -> None:
        slave.setReal(inputs, command)
        slave.doStep(currentCommunicationPoint=k * PERIOD, communicationStepSize=PERIOD)
        slave.getReal(outputs)

    return call


def plant_steps(plant: Bench) -> Callable[[int], None]:
    """Return a step of the plant."""
    command = Command(np.full(plant.spec.n, 0.1))
    plant.reset(0)

    def call(_: int) -> None:
        plant.step(command)

    return call


def main() -> None:
    """Measure in turns, so that a disturbance meets all alike, and print the best round of each and ratios."""
    plants = [open_plant() for _ in range(3)]
    calls = {"bare": bare_calls(plants[0]), "plant": plant_steps(plants[1]), "fmpy": fmpy_calls(plants[2])}
    times: dict[str, list[float]] = {name: [] for name in calls}
    for round_ in range(ROUNDS):
        for name, call in calls.items():
            started = time.perf_counter()
            for k in range(round_ * CALLS, (round_ + 1) * CALLS):
                call(k)
            times[name].append((time.perf_counter() - started) / CALLS)
    best = {name: min(values) * 1e6 for name, values in times.items()}
    for name, value in best.items():
        print(f"{name:6} {value:6.2f} µs   {value / best['bare']:5.2f} × bare")
    for plant in plants:
        plant.close()


if __name__ == "__main__":
    main()
