"""Refuses to serve without keys where other machines could connect."""

from splatmill_server.access.keys import Keys
from splatmill_server.base.settings import Settings


class NeedsKey(ValueError):
    """The server has no keys, and would listen where other machines reach it."""


def check_exposure(settings: Settings, keys: Keys) -> None:
    """Raise NeedsKey if other machines could reach a server without keys, and StorageError if keys cannot be read."""
    if settings.local or settings.api_key is not None:
        return
    keys.read()
    if not keys.any():
        raise NeedsKey(
            f"Listening on {settings.host} gives other machines access, which requires an API key: set "
            "SPLATMILL_API_KEY to a secret text, or listen on 127.0.0.1 and store a key with `splatmill keys create`."
        )
