"""Statistics and tables of the runs in a results folder."""
