"""Scenes, cameras and photos with a known truth."""
