"""Applications: abilities that only their commands reach, a room each; nothing in the core imports one."""
