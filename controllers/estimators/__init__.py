"""Jacobian estimators behind one contract."""
