"""Exports FMUs: one folder for each model, `fmi` for the FMI functions, and the modules that put an FMU together."""
