"""Scenes along axes, their conditioning, the engines, and the oracle."""
