"""The address of Redis where none is given. It is apart from the clients, because settings are read without them."""

DEFAULT_URL = "redis://127.0.0.1:6379/0"
