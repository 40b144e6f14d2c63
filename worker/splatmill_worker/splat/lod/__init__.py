"""Levels of detail of a model: coarser models of the same scene, each of a quarter of the Gaussians, in a tree."""
