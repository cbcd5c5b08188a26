"""Model predictive control (eq. 46): closed form, limits and the quadratic program."""
