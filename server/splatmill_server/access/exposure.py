"""What is refused, or warned of, where other machines could connect: no keys, and trust in every client's headers."""

import ipaddress

from splatmill_server.access.keys import Keys
from splatmill_server.base.settings import Settings, split


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


def unbounded_trust(settings: Settings) -> str | None:
    """Return a warning if clients of other machines are believed to be proxies, or None."""
    if settings.local or not any(map(_names_all, split(settings.forwarded_allow_ips))):
        return None
    return (
        f"FORWARDED_ALLOW_IPS={settings.forwarded_allow_ips[:80]} trusts every client as a proxy, and the server "
        f"listens on {settings.host}, where clients can reach it without one. Each client can then choose the address "
        "under which it is logged and takes turns at the renderer, its scheme, and the path in links. Set "
        "FORWARDED_ALLOW_IPS to the address of the proxy, or let the server listen on 127.0.0.1 or on a unix socket, "
        "and the proxy connect there."
    )


def _names_all(trusted: str) -> bool:
    """Return whether an entry of the trusted proxies stands for all addresses of IPv4 or of IPv6."""
    try:
        return trusted == "*" or ipaddress.ip_network(trusted).prefixlen == 0
    except ValueError:
        return False
