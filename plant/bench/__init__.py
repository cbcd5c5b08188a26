"""The shell around every plant: clipping, command delay, sub-steps, sensor noise, latency and lost frames."""
