"""Exports a controller as a co-simulation FMU: a recorded step, its variables, its reference run."""

from dataclasses import dataclass

import numpy as np

from servobench.fmus.controllers.branches import NOT_DEFINITE
from servobench.fmus.controllers.record import Recorded
from servobench.fmus.model_description import Description
from servobench.fmus.product import Product, c_files, documentation, word
from servobench.fmus.reference import tables
from servobench.fmus.variables import SAMPLED, Groups, Layout, read_groups
from servobench.plant.contract.checks import NamedArrays

MODEL = "controller"
CORE = "controller"
# Names of the variables.
POSITION = "joint_position"
FEATURE = "feature"
SEEN = "seen"
REFERENCE = "reference"
COMMAND = "joint_velocity_command"
JACOBIAN = "jacobian"


def controller_groups(n: int, m: int, rows: int, unit: str) -> Groups:
    """Return the variables of a controller.

    Args:
        n: joints.
        m: features.
        rows: of the reference.
        unit: of a feature.
    """
    return read_groups(MODEL, {"n": n, "m": m, "rows": rows}, {"unit": unit})


@dataclass(frozen=True)
class ControllerModel:
    """A controller ready for export."""

    name: str  # by which it is known
    summary: str  # one line
    recorded: Recorded  # its step, of the columns [time, inputs]
    groups: Groups  # from `controller_groups`
    period: float  # s
    # A run of the original: time, inputs and the outputs for them by name, (k, size).
    run: NamedArrays
    settings: str  # settings of the original, for the documentation

    @property
    def identifier(self) -> str:
        """Name of the libraries."""
        return word(self.name, "controller")

    def product(self, fmi_version: int, start: NamedArrays | None = None) -> Product:
        """Return the content of the FMU.

        Args:
            fmi_version: 2 or 3.
            start: values of inputs by name, (size,), at the start; zeros for others, and ones for `seen`.
        """
        layout = Layout(self.groups)
        starts = {SEEN: np.ones_like(self.run[SEEN][0]), **(start or {})}
        return Product(
            fmi_version=fmi_version,
            folder=MODEL,
            core=CORE,
            source=self.recorded.source,
            constants=self._constants(layout),
            description=Description(
                model_name=f"Controller {self.name}",
                model_identifier=self.identifier,
                summary=f"{self.name}: {self.summary}.",
                layout=layout,
                start=starts,
                sources=c_files(fmi_version, CORE),
                step=self.period,
                exchange=False,
            ),
            documentation=documentation(
                MODEL,
                layout,
                name=self.name,
                summary=self.summary,
                period=f"{self.period:g}",
                memory=str(self.recorded.states),
                settings=self.settings,
            ),
            reference=self._reference(layout),
        )

    def _constants(self, layout: Layout) -> dict[str, float]:
        """Return the sizes of arrays, and the codes, that the C model needs."""
        return {
            "PERIOD": self.period,
            "N_MEMORY": max(self.recorded.states, 1),
            "N_FEATURES": layout.by_name[SEEN].size,
            "N_ANSWERS": sum(group.size for group in layout.of_role(SAMPLED)),
            "FAULT_NOT_DEFINITE": NOT_DEFINITE,
        }

    def _reference(self, layout: Layout) -> tuple[str, str]:
        """Return the run as CSV; the outputs at an instant, before its inputs, are those of the last one."""
        before = {}
        for name in (COMMAND, JACOBIAN):
            before[name] = np.pad(self.run[name][:-1], ((1, 0), (0, 0)))
        return tables({**self.run, **before}, layout)
