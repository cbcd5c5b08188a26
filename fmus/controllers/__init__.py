"""Records numpy code as programs, from which C is written: one formula for both."""
