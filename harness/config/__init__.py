"""Settings and their defaults; plants, controllers, robots and sensing set-ups by name."""
