"""Fits one picture by Gaussians in a plane (`splatmill fit-image`)."""
