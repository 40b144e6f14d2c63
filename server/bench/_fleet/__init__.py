"""Parts of `bench fleet`: simulated workers in a few processes, the API in this one, and meters of Redis."""
