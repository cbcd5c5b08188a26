"""The structure of a model: which of its unknowns depends on what, for both versions of the description."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

from servobench.fmus.variables import INPUT, SAMPLED, ArmLayout, Group, Layout

_Rows: TypeAlias = list[tuple[str, tuple[str, ...], bool]]  # unknown, what it depends on, elementwise or as a whole


@dataclass(frozen=True)
class Section:
    """One part of the model structure: which unknown depends on which groups, elementwise or as a whole.

    FMI 2 has no element for event indicators.
    """

    fmi2: str
    fmi3: str
    layout: Layout
    unknowns: tuple[tuple[Group, tuple[str, ...], bool], ...]

    def scalars(self) -> Iterable[tuple[int, list[int]]]:
        """Yield index and dependencies of every number; FMI 2 wants them in ascending order."""
        sizes = {group.name: group.size for group in self.layout.groups}
        for group, names, elementwise in self.unknowns:
            for k in range(group.size):
                dependencies: list[int] = []
                for name in names:
                    first = self.layout.offsets[name]
                    dependencies += [first + k] if elementwise else range(first, first + sizes[name])
                yield self.layout.offsets[group.name] + k, sorted(dependencies)

    def arrays(self) -> Iterable[tuple[int, list[int]]]:
        """Yield value reference and dependencies of every group."""
        for group, names, _ in self.unknowns:
            yield self.layout.offsets[group.name], sorted(self.layout.offsets[name] for name in names)


def arm_sections(layout: ArmLayout) -> tuple[Section, ...]:
    """Return outputs, derivatives, initial unknowns and event indicators of an arm with what they depend on."""
    geometry, computed = ([group.name for group in part] for part in (layout.kinematic, layout.computed))
    state = ("joint_position", "joint_velocity")
    outputs: _Rows = [(name, (name,), True) for name in state]
    outputs += [("encoder_position", ("joint_position",), True)]
    outputs += [(name, ("joint_position",), False) for name in computed]
    derivatives: _Rows = [
        ("der(joint_position)", state, True),
        ("der(joint_velocity)", (*state, "joint_velocity_command"), True),
    ]
    start: _Rows = [
        ("joint_position", ("home",), True),
        ("joint_velocity", (), True),
        ("der(joint_position)", (), True),
        ("der(joint_velocity)", ("lag", "max_speed", "joint_velocity_command"), True),
        ("encoder_position", ("encoder_resolution", "home"), True),
    ]
    start += [(name, (*geometry, "home"), False) for name in computed]
    return (
        _section(layout, "Outputs", "Output", outputs),
        _section(layout, "Derivatives", "ContinuousStateDerivative", derivatives),
        _section(layout, "InitialUnknowns", "InitialUnknown", start),
        _section(layout, "", "EventIndicator", [("stop_indicator", (*state[:1], "joint_velocity_command"), False)]),
    )


def sampled_sections(layout: Layout) -> tuple[Section, ...]:
    """Return outputs and initial unknowns of a system in discrete time: every output depends on every input."""
    inputs = tuple(group.name for group in layout.of_role(INPUT))
    rows: _Rows = [(group.name, inputs, False) for group in layout.of_role(SAMPLED)]
    return (
        _section(layout, "Outputs", "Output", rows),
        _section(layout, "InitialUnknowns", "InitialUnknown", rows),
    )


def _section(layout: Layout, fmi2: str, fmi3: str, rows: _Rows) -> Section:
    groups = {group.name: group for group in layout.groups}
    unknowns = tuple((groups[name], names, elementwise) for name, names, elementwise in rows)
    return Section(fmi2, fmi3, layout, unknowns)
