"""Parts of `bench stability`: scenes along axes, their conditioning, the engines, and the oracle."""
