"""Profiles: named servers in the file `config.toml` of the person, each with its address, key and certificates.

    [profiles.lab]
    server = "https://lab.example"
    api_key_file = "lab.key"        # or api_key = "..."
    ca_bundle = "lab-ca.pem"        # certificates to trust in place of the usual ones
    proxy = "http://proxy.example:3128"

Paths are relative to the folder of the file. A file with a key must not be readable by others.
"""

import os
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from splatmill.errors import ConfigurationInvalid

PROFILE_VARIABLE = "SPLATMILL_PROFILE"

_FIELDS = ("server", "api_key", "api_key_file", "ca_bundle", "proxy")


@dataclass(frozen=True)
class Profile:
    """A named server.

    server: its address.
    api_key: the key to send, or None.
    ca_bundle: file or folder of the certificates to trust, or None for the usual ones.
    proxy: address of the proxy to go through, or None for that of the environment.
    """

    name: str
    server: str
    api_key: str | None = None
    ca_bundle: Path | None = None
    proxy: str | None = None


def config_path() -> Path:
    """Return the path of the file of profiles, which need not exist.

    Its folder is `splatmill` in XDG_CONFIG_HOME where that is set, else in `~/.config`, on macOS in
    `~/Library/Application Support`, and on Windows in APPDATA.
    """
    if folder := os.environ.get("XDG_CONFIG_HOME"):
        base = Path(folder)
    elif sys.platform == "win32":
        base = Path(os.environ.get("APPDATA") or Path.home() / "AppData" / "Roaming")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Application Support"
    else:
        base = Path.home() / ".config"
    return base / "splatmill" / "config.toml"


def read_profile(name: str) -> Profile:
    """Return a profile. Raises ConfigurationInvalid if there is none of this name, or if it cannot be used."""
    path = config_path()
    profiles = _read(path)
    fields = profiles.get(name)
    if not isinstance(fields, Mapping):
        known = ", ".join(sorted(profiles)) or "none"
        raise ConfigurationInvalid(
            f"There is no profile {name!r} in {path}; its profiles are: {known}.",
            f'Add one: [profiles.{name}] with server = "https://...".',
        )
    where = f"The profile {name!r} in {path}"
    for field, value in fields.items():
        if field not in _FIELDS:
            raise ConfigurationInvalid(f"{where} has the unknown field {field!r}.", f"{_choices()}")
        if not isinstance(value, str) or not value:
            raise ConfigurationInvalid(f"{where} has a {field} that is not a text.", "Write it in quotes.")
    if "server" not in fields:
        raise ConfigurationInvalid(f"{where} has no server.", 'Add a line such as server = "https://...".')
    if "api_key" in fields and "api_key_file" in fields:
        raise ConfigurationInvalid(f"{where} has both api_key and api_key_file.", "Leave one of them.")
    key = fields.get("api_key")
    if key is not None:
        _check_private(path)
    elif "api_key_file" in fields:
        key = _read_key(_beside(path, fields["api_key_file"]), where)
    bundle = _beside(path, fields["ca_bundle"]) if "ca_bundle" in fields else None
    return Profile(name, fields["server"], key, bundle, fields.get("proxy"))


def profile_names() -> list[str]:
    """Return the names of the profiles, for completion in a shell; none if the file cannot be read."""
    try:
        return sorted(_read(config_path()))
    except ConfigurationInvalid:
        return []


def _read(path: Path) -> Mapping[str, object]:
    try:
        with path.open("rb") as source:
            profiles = tomllib.load(source).get("profiles", {})
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise ConfigurationInvalid(f"{path} cannot be read: {error}.", "Correct it as TOML.") from error
    return profiles if isinstance(profiles, Mapping) else {}


def _read_key(path: Path, where: str) -> str:
    try:
        key = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationInvalid(
            f"{where} names the key file {path}, which cannot be read: {error}."
        ) from error
    _check_private(path)
    if not key or not key.isprintable() or " " in key:
        raise ConfigurationInvalid(
            f"{where} names the key file {path}, which does not hold one key.", "Write the key alone into it."
        )
    return key


def _check_private(path: Path) -> None:
    if os.name == "posix" and path.stat().st_mode & 0o077:
        raise ConfigurationInvalid(
            f"{path} holds an API key, and other users of this machine may read it.",
            f"Make it private: chmod 600 {path}",
        )


def _beside(config: Path, path: str) -> Path:
    return config.parent / Path(path).expanduser()


def _choices() -> str:
    return f"The fields are: {', '.join(_FIELDS)}."
