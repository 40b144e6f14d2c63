"""The training loop, and what changes while it runs."""
