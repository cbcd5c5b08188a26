"""Twins: arm, camera and drive identified from a log, and controllers shown a log."""
