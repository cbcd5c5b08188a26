"""Controllers and arms as FMUs."""
