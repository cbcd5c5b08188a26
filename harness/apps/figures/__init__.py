"""Pictures of a results folder, drawn from its tables alone."""
