"""Which photos overlap: pairs to match, feature matches, and the two-view geometry that verifies them."""
