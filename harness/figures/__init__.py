"""Pictures of a results folder, drawn from its tables alone."""

from harness.figures.draw import draw_figures

__all__ = ["draw_figures"]
