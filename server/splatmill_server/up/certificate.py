"""A certificate for HTTPS in the local network, which this machine signs itself."""

import ipaddress
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from splatmill.files import atomic_write

VALID = timedelta(days=397)
"""What browsers accept at most of a certificate."""

RENEWED = timedelta(days=30)
"""Time before the end of a certificate at which a start makes a new one."""

_LONGEST_NAME = 64
"""Characters of a common name, at most."""


@dataclass(frozen=True)
class Certificate:
    """The files of a certificate in PEM, and of its private key."""

    file: Path
    key: Path


def certificate(folder: Path, addresses: Sequence[str]) -> Certificate:
    """Return the certificate in `folder`, made anew where there is none for all `addresses` or it soon ends.

    addresses: IP addresses of this machine; the certificate is also for its names.
    """
    files = Certificate(folder / "certificate.pem", folder / "certificate.key")
    if not _serves(files, addresses):
        _make(files, addresses)
    return files


def _serves(files: Certificate, addresses: Sequence[str]) -> bool:
    try:
        known = x509.load_pem_x509_certificate(files.file.read_bytes())
        key = serialization.load_pem_private_key(files.key.read_bytes(), None)
        names = known.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (OSError, ValueError, TypeError, x509.ExtensionNotFound):
        return False
    covered = {str(address) for address in names.get_values_for_type(x509.IPAddress)}
    return (
        known.public_key() == key.public_key()
        and covered.issuperset(addresses)
        and known.not_valid_after_utc - datetime.now(UTC) > RENEWED
    )


def _make(target: Certificate, addresses: Sequence[str]) -> None:
    host = socket.gethostname()
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"Splatmill on {host}"[:_LONGEST_NAME])])
    names = [x509.DNSName(text) for text in ("localhost", host, f"{host}.local") if text.isascii()]
    numbers = [x509.IPAddress(ipaddress.ip_address(text)) for text in ("127.0.0.1", *addresses)]
    now = datetime.now(UTC)
    usage = x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))  # clocks of phones differ
        .not_valid_after(now + VALID - timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([*names, *numbers]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    for path, content in (
        (target.key, private),
        (target.file, made.public_bytes(serialization.Encoding.PEM)),
    ):
        atomic_write(path, content)
        path.chmod(0o600)
