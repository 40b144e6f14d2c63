"""The photos that are held out, and what keeps them from being trained on by another way."""
