"""Adaptive density control: cloning, splitting and pruning of Gaussians."""
