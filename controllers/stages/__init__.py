"""The stages of a composed controller around its estimator and its law."""
