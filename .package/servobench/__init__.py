"""A bench on which uncalibrated visual-servoing controllers are compared."""
