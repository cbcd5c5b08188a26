"""A page on which runs are steered while they go on."""
