"""The certificate of a server that answers over HTTPS by itself."""

import hashlib
import ssl
from pathlib import Path
from typing import Any

from splatmill_server.base.settings import Settings


def fingerprint(certificate: Path) -> str:
    """Return the SHA-256 of a certificate in PEM as browsers show it: pairs of hex digits between colons."""
    der = ssl.PEM_cert_to_DER_cert(certificate.read_text())
    return hashlib.sha256(der).digest().hex(":").upper()


def uvicorn_options(settings: Settings) -> dict[str, Any]:
    """Return the options with which uvicorn answers over HTTPS, or none where the settings name no certificate.

    Raises OSError if the certificate or its key cannot be used.
    """
    if settings.tls_certificate is None:
        return {}
    try:
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(
            settings.tls_certificate, settings.tls_key, lambda: ""
        )
    except (OSError, ValueError) as error:  # SSLError is one
        raise OSError(
            f"SPLATMILL_TLS_CERTIFICATE={settings.tls_certificate} cannot be used: {error}. Name a certificate in PEM, "
            "and its private key without a password in SPLATMILL_TLS_KEY."
        ) from error
    return {"ssl_certfile": settings.tls_certificate, "ssl_keyfile": settings.tls_key}
