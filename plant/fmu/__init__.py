"""Plants that are FMUs."""
