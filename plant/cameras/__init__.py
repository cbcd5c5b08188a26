"""Sensing set-ups: cameras, beside the arm or on its hand, and the features that they measure."""
