"""Visual-servoing controllers: a Jacobian estimator and a control law, composed behind one step()."""
