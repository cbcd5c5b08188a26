"""The paper's seven claims: the rules by which runs answer them, and the tables of the answers."""
