"""Equal tuning: every method gets the same trials on the same plants with the same objective."""
