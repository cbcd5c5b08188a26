"""Steps of runs for other tools."""
