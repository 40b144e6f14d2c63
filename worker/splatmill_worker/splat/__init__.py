"""Gaussian splats: parameters, rendering, training, evaluation, files. Knows kernels and scenes only."""
