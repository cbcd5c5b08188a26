"""Sensing set-ups: what cameras, beside the arm or on its hand, measure of it."""
