"""Adaptive density control: splitting and pruning of Gaussians."""
