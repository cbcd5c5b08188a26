"""Settings, their defaults, and what is known by name."""
