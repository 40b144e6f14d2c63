"""The training loop, its state, and the parts of the optimisation beside the Gaussians."""
