"""Records what numpy code computes as CasADi expressions, from which C is generated: one formula, read twice."""
