"""Gaussian splatting: parameters, rendering, training, evaluation, files, report."""
