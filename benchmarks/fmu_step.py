"""What a step of the FMU plant costs beside the calls that it cannot do without, all in one run.

bare      set, doStep and get by ctypes with arguments that were built once: the floor
plant     Bench.step, without noise and delay
fmpy      setReal, doStep and getReal of fmpy's FMU2Slave, with lists
block     Bench.step of many runs side by side, for each of them
"""

from __future__ import annotations

import ctypes
import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import cast

import numpy as np
from fmpy.fmi2 import FMU2Slave

from measuring import asked_to_be_quick, table, times_in_turns
from servobench.fmus.ur5_plant import Ur5FmuConfig, build_ur5
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.lanes import stack
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.signals import Command
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.world import FmuWorld
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.ur5 import HOME

CALLS = 200
BLOCK = 128
PERIOD = 0.05
BARE = "bare calls by ctypes: set, step, get"


def open_plant(runs: int = 0) -> Bench:
    """Return the exported UR5 without anything around it; with `runs`, so many side by side."""
    config = Ur5FmuConfig(command_delay=0.0, sensing=SensingConfig(0.0))
    model, start = find_robot("ur5").nominal, np.array(HOME)
    if runs:
        model, start = stack([model] * runs), np.tile(start, (runs, 1))
    return build_ur5(config, PlantSetup(model, start, PERIOD))


def bare_calls(plant: Bench) -> Callable[[int], None]:
    """Return a step by three calls with prebuilt arguments."""
    world = cast(FmuWorld, plant.world)
    instance = world._instances.lanes[0].instance
    library, component = instance.library.loaded, instance._component
    set_real, inputs = library.fmi2SetReal, (*world._command.variables, world._command.pointer())
    get_real, outputs = library.fmi2GetReal, (*world._result.variables, world._result.pointer())
    do_step, now, step, yes = (
        library.fmi2DoStep,
        ctypes.c_double(),
        ctypes.c_double(PERIOD),
        ctypes.c_int(1),
    )

    def call(k: int) -> None:
        set_real(component, *inputs)
        now.value = k * PERIOD
        do_step(component, now, step, yes)
        get_real(component, *outputs)

    return call


def fmpy_calls(plant: Bench) -> Callable[[int], None]:
    """Return a step by fmpy's own methods."""
    world = cast(FmuWorld, plant.world)
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
    lead = plant.world.lead
    command = Command(np.full((*lead, plant.spec.n), 0.1))
    plant.reset(range(*lead) if lead else 0)

    def call(_: int) -> None:
        plant.step(command)

    return call


def main() -> None:
    """Measure in turns, so that a disturbance meets all alike, and print the best round of each and ratios."""
    rounds = 2 if asked_to_be_quick(__doc__) else 300
    plants = [*(open_plant() for _ in range(3)), open_plant(BLOCK)]
    block = f"`Bench.step`, {BLOCK} runs side by side"
    steps = {BARE: bare_calls(plants[0]), "`Bench.step`, one run": plant_steps(plants[1]),
             "fmpy's `FMU2Slave`": fmpy_calls(plants[2]), block: plant_steps(plants[3])}  # fmt: skip
    instants = {name: itertools.count() for name in steps}
    runs = {name: BLOCK if name == block else 1 for name in steps}

    def many(name: str) -> None:
        for k in itertools.islice(instants[name], CALLS // runs[name]):
            steps[name](k)

    times = times_in_turns({name: partial(many, name) for name in steps}, rounds, time.perf_counter)
    best = {
        name: min(values) / (CALLS // runs[name] * runs[name]) * 1e6
        for name, values in times.items()
    }
    print(table(["step of the FMU of the UR5", "a step", "× bare calls"],
                [[name, f"{value:.2f} µs", f"{value / best[BARE]:.2f}"] for name, value in best.items()]))  # fmt: skip
    for plant in plants:
        plant.close()


if __name__ == "__main__":
    main()
