"""Which server a client talks to, and how: from its arguments, the environment, or a profile."""

import os
import ssl
from dataclasses import dataclass
from pathlib import Path

from splatmill.errors import ConfigurationInvalid
from splatmill.schema.port import DEFAULT_PORT
from splatmill.transfer.profiles import PROFILE_VARIABLE, read_profile

DEFAULT_SERVER = f"http://127.0.0.1:{DEFAULT_PORT}"
SERVER_VARIABLE = "SPLATMILL_SERVER"
API_KEY_VARIABLE = "SPLATMILL_API_KEY"
CA_BUNDLE_VARIABLE = "SPLATMILL_CA_BUNDLE"

Verify = bool | str | os.PathLike[str] | ssl.SSLContext
"""What a server's certificate is checked against: the usual certificates (True), nothing (False), a file or folder of
certificates, or a context of the module `ssl`."""


@dataclass(frozen=True)
class ServerChoice:
    """A server, its key, what its certificate is checked against, and the proxy to go through."""

    server: str
    api_key: str | None
    verify: Verify
    proxy: str | None


def choose_server(
    server: str | None,
    *,
    api_key: str | None = None,
    profile: str | None = None,
    verify: Verify | None = None,
    proxy: str | None = None,
) -> ServerChoice:
    """Return the server of these arguments.

    An argument comes before the environment, and the environment before a profile that SPLATMILL_PROFILE names. The
    fields of a profile that is an argument come before the environment. A profile applies only as a whole: with an
    address from elsewhere, its key is not used.

    Raises ConfigurationInvalid for a profile that cannot be used, and for a server beside a profile.
    """
    if server is not None and profile is not None:
        raise ConfigurationInvalid(
            f"Both the server {server} and the profile {profile!r} are given.", "Give one of them."
        )
    environment = {name: os.environ.get(name) or None for name in _VARIABLES}
    name = profile
    if server is None and profile is None and environment[SERVER_VARIABLE] is None:
        name = environment[PROFILE_VARIABLE]
    if name is None:
        key = api_key if api_key is not None else environment[API_KEY_VARIABLE]
        address = server or environment[SERVER_VARIABLE] or DEFAULT_SERVER
        return ServerChoice(address, key, _first(verify, environment[CA_BUNDLE_VARIABLE], True), proxy)
    stored = read_profile(name)
    keys = [stored.api_key, environment[API_KEY_VARIABLE]]
    bundles: list[Verify | None] = [stored.ca_bundle, environment[CA_BUNDLE_VARIABLE]]
    if profile is None:  # the environment names it, and so its other variables come first
        keys.reverse()
        bundles.reverse()
    key = next((key for key in (api_key, *keys) if key is not None), None)
    return ServerChoice(stored.server, key, _first(verify, *bundles, True), proxy or stored.proxy)


def ssl_context(verify: Verify) -> ssl.SSLContext | bool:
    """Return what httpx takes as `verify`. Raises ConfigurationInvalid for certificates that cannot be read."""
    if isinstance(verify, bool | ssl.SSLContext):
        return verify
    path = Path(verify).expanduser()
    try:
        if path.is_dir():
            return ssl.create_default_context(capath=str(path))
        return ssl.create_default_context(cafile=str(path))
    except OSError as error:  # ssl.SSLError is one
        raise ConfigurationInvalid(
            f"The certificates in {path} cannot be read: {error.strerror or error}.",
            f"Give a PEM file, or a folder of hashed certificates (verify=, {CA_BUNDLE_VARIABLE}, or ca_bundle).",
        ) from error


_VARIABLES = (SERVER_VARIABLE, API_KEY_VARIABLE, CA_BUNDLE_VARIABLE, PROFILE_VARIABLE)


def _first(*values: Verify | None) -> Verify:
    return next(value for value in values if value is not None)
