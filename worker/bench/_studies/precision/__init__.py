"""Parts of `bench precision`."""
