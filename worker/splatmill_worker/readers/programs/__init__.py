"""Readers of the cameras that other programs write: one file each, which returns the same plain values."""
