"""What the studies of the engine's numerics are made of, and the one runner of all of them: `study`."""
