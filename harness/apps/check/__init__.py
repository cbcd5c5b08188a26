"""Checks of controllers and plants against their contracts; each failure names the remedy."""
