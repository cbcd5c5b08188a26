"""The paper's seven claims, answered by statistics that anyone can repeat."""
