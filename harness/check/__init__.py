"""Checks of controllers and plants against their contracts; each failure says what to change."""
