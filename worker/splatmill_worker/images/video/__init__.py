"""Frames of videos: which are taken, when they are shown, and as which pictures."""
