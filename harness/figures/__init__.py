"""Pictures of a results folder, drawn from its tables alone."""

from harness.figures.draw import draw_figures, picture_of

__all__ = ["draw_figures", "picture_of"]
