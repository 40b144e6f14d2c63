"""What the photos say about every Gaussian of a finished model, and the removal of those that they do not support."""
