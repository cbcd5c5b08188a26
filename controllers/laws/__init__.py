"""Control laws behind one contract."""
