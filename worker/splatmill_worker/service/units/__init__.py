"""Tiles of a scene on several workers: entries of the queue for those that take them, and outputs in storage."""
