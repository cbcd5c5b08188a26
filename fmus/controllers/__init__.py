"""Records numpy code as CasADi expressions, from which C is generated: one formula for both."""
