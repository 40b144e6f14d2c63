"""The port of the service, which programs need before they load any message."""

DEFAULT_PORT = 8080
"""The port that a server listens on and that a client connects to by default."""
