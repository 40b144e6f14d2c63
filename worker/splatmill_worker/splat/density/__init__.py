"""Strategies that change how many Gaussians there are, behind one small interface."""
