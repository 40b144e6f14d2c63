"""A training step over all Gaussians: the protocol, and its implementations by backend."""
