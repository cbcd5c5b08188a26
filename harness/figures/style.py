"""One colour, line and marker a method, the same in every picture, and readable without colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

# Okabe and Ito's palette, distinguishable with every kind of colour vision.
BLUE, ORANGE, GREEN, VERMILLION, PURPLE, SKY, YELLOW, GREY, BLACK = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
    "#B8A900",
    "#7F7F7F",
    "#000000",
)


@dataclass(frozen=True)
class MethodStyle:
    """How a method's line looks."""

    colour: str
    line: Any
    marker: str

    def line_arguments(self, points: int) -> dict[str, Any]:
        """Return keyword arguments for a matplotlib line of `points` points, with about eight markers on it."""
        return {
            "color": self.colour,
            "linestyle": self.line,
            "marker": self.marker,
            "markevery": max(1, points // 8),
            "markersize": 4.5,
            "linewidth": 1.4,
        }


_STYLES = {
    "rbfnn_mfac": MethodStyle(VERMILLION, "-", "o"),
    "ukf_mfac": MethodStyle(BLUE, "--", "s"),
    "ukf_mpc": MethodStyle(GREEN, "-.", "^"),
    "rbf_pid": MethodStyle(ORANGE, (0, (5, 1)), "D"),
    "calibrated": MethodStyle(BLACK, "-", ""),
    "nmpc_calibrated": MethodStyle(BLACK, ":", "x"),
    "constant": MethodStyle(GREY, ":", "v"),
    "broyden": MethodStyle(PURPLE, "--", "P"),
    "rls": MethodStyle(SKY, "-.", "X"),
    "kalman_mfac": MethodStyle(SKY, "-", "+"),
    "cfdl_mfac": MethodStyle(YELLOW, (0, (3, 1, 1, 1)), "*"),
}
_OTHERS = tuple(
    MethodStyle(colour, line, marker)
    for line, marker in (((0, (1, 1)), "<"), ((0, (4, 2)), ">"), ((0, (6, 1, 1, 1)), "h"))
    for colour in (PURPLE, SKY, YELLOW)
)


def method_styles(names: list[str]) -> dict[str, MethodStyle]:
    """Return a style for each name: the known ones always the same, others in the order in which they come."""
    unknown = [name for name in names if name not in _STYLES]
    return {name: _STYLES.get(name) or _OTHERS[unknown.index(name) % len(_OTHERS)] for name in names}
