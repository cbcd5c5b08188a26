"""Linear analysis of the loop around an equilibrium: margins, sensitivity, responses, limits of gain and latency."""
