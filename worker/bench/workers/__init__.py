"""Several processes that do the units of one plan: what they take, and that nothing changes what they make."""
