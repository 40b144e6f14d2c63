"""Camera poses and points from verified pairs: COLMAP's mappers, merging of models, and the last bundle adjustment."""
