"""Facts, decisions and plans of a training."""
