"""`splatmill up --lan`: the service for devices of the local network, over HTTPS and only with a key."""

import io
import os
import secrets
import socket
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from splatmill.files import atomic_write
from splatmill_server.base.tls import fingerprint
from splatmill_server.up.certificate import Certificate, certificate
from splatmill_server.up.folder import UpError

HOST = "0.0.0.0"
"""The address to listen on: all networks of this machine."""

FOLDER = "lan"
"""Folder below the data folder for the key and the certificate."""

_ANYWHERE = ("192.0.2.1", 9)
"""An address of no machine (RFC 5737). Asking for the way there sends nothing."""


@dataclass(frozen=True)
class Lan:
    """What `--lan` opens.

    address: that of this machine in its network.
    key: that requests need; None where only stored keys count.
    certificate: for HTTPS.
    """

    address: str
    key: str | None
    certificate: Certificate

    def url(self, port: int) -> str:
        """Return the address of the service for devices of the network."""
        return f"https://{self.address}:{port}"

    def sentences(self, url: str, port: int) -> str:
        """Return what an operator has to know: the code for phones, the key, what is open, and the certificate."""
        has_key = "The code carries the key." if self.key else "The page there asks for one of your keys."
        lines = [
            _code(url if self.key is None else f"{url}/sign-in#key={quote(self.key, safe='')}"),
            f"Point the camera of a phone in the same network at this code. {has_key}",
            *([f"API key: {self.key}"] if self.key else []),
            f"Open to other devices: port {port}, in all networks of this machine, and only with a key. Whoever has "
            "the key, or a picture of the code, can use all of the service.",
            "This machine has signed the certificate itself, so browsers warn of it once. Go on if the fingerprint "
            f"that they show is this one (SHA-256):\n{fingerprint(self.certificate.file)}",
            f"Programs trust it with SPLATMILL_CA_BUNDLE={self.certificate.file}",
        ]
        return "\n".join(lines)


def prepare(data: Path, *, has_keys: bool) -> Lan:
    """Return what `--lan` opens, with the key and the certificate of the start before where they can be used.

    has_keys: whether keys are stored, so that none is made here. SPLATMILL_API_KEY goes before both.

    Raises UpError where the machine is in no network, and where the folder cannot be written.
    """
    folder = data.expanduser().absolute() / FOLDER
    address = network_address()
    try:
        key = os.environ.get("SPLATMILL_API_KEY") or (None if has_keys else _key(folder / "key"))
        return Lan(address, key, certificate(folder, [address]))
    except OSError as error:
        raise UpError(
            f"The folder {folder}, for the key and the certificate of --lan, cannot be used: "
            f"{error.strerror or error}. Choose another with --data, or let this user write there."
        ) from error


def network_address() -> str:
    """Return the IPv4 address of this machine in its network. Raises UpError if it is in none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_ANYWHERE)
            address = str(probe.getsockname()[0])
        except OSError:
            address = "127.0.0.1"
    if address.startswith("127."):
        raise UpError(
            "--lan: this machine is in no network by which other devices could reach it. Connect it to one, or leave "
            "out --lan."
        )
    return address


def _key(path: Path) -> str:
    if path.exists() and (kept := path.read_text().strip()):
        return kept
    made = secrets.token_urlsafe(24)
    atomic_write(path, f"{made}\n")
    path.chmod(0o600)
    return made


def _code(text: str) -> str:
    import segno

    drawing = io.StringIO()
    segno.make(text, error="m", micro=False).terminal(drawing, compact=True)
    return drawing.getvalue().rstrip("\n")
