"""The HTTP renderer of stored models."""
