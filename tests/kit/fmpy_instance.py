"""An FMU as FMPy drives it, of either version, by the names of its variables."""

from pathlib import Path

import numpy as np
from fmpy import read_model_description
from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmpy.fmi3 import FMU3Model, FMU3Slave

from servobench.plant.fmu.archive import extract_fmu

KINDS = {(2, False): FMU2Slave, (2, True): FMU2Model, (3, False): FMU3Slave, (3, True): FMU3Model}


class Driven:
    """An instance of an FMU, which is freed at the end of a `with`."""

    def __init__(self, path: Path, version: int, *, exchange: bool = False) -> None:
        self.version, self.description = version, read_model_description(str(path))
        token = self.description.guid if version == 2 else self.description.instantiationToken
        interface = self.description.modelExchange if exchange else self.description.coSimulation
        self.fmu = KINDS[version, exchange](
            guid=token, unzipDirectory=str(extract_fmu(path)), modelIdentifier=interface.modelIdentifier,
            instanceName="driven",
        )  # fmt: skip
        self.fmu.instantiate()

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        self.fmu.freeInstance()

    def start(self, time: float = 0.0, stop: float | None = None) -> None:
        if self.version == 2:
            self.fmu.setupExperiment(startTime=time, stopTime=stop)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=time, stopTime=stop)
        self.fmu.exitInitializationMode()

    def step(self, time: float, size: float) -> None:
        self.fmu.doStep(currentCommunicationPoint=time, communicationStepSize=size)

    def references(self, *names: str) -> list[int]:
        """Return the value references of variables; in FMI 2 each entry of an array has its own."""
        each = {name: [] for name in names}
        for variable in self.description.modelVariables:
            name = variable.name if variable.name in each else variable.name.partition("[")[0]
            if name in each:
                each[name].append(variable.valueReference)
        return [reference for references in each.values() for reference in references]

    def write(self, values, *names: str) -> None:
        put = self.fmu.setReal if self.version == 2 else self.fmu.setFloat64
        put(self.references(*names), np.ravel(values).tolist())

    def read(self, size: int, *names: str) -> np.ndarray:
        """Return the values of variables that have `size` entries together."""
        if self.version == 2:
            return np.array(self.fmu.getReal(self.references(*names)))
        return np.array(self.fmu.getFloat64(self.references(*names), nValues=size))
