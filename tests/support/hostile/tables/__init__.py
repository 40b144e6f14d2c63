"""The rows of the list of hostile inputs, by what they attack."""
