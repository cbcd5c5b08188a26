"""Experiments: references, the loop, logs, metrics, comparisons and the command line."""
