"""The parts of `bench openapi`."""
