"""Results that strangers can check: the self-test of a machine, verification, submissions and a board."""
