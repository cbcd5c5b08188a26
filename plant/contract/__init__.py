"""The contract of plants and controllers: signals, checks, faults, lanes, settings, seeds and time."""
