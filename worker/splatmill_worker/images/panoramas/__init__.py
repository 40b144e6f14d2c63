"""Photos that show all directions: which these are, and their division into faces."""
