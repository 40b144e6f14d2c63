"""What browsers may do with a page of this server: load its own files and nothing from elsewhere."""

import base64
import hashlib
from collections.abc import Iterable

_FEATURES = (
    "camera",
    "microphone",
    "geolocation",
    "payment",
    "usb",
    "serial",
    "display-capture",
)


def headers(scripts: Iterable[str] = (), *, embedded: bool = False) -> dict[str, str]:
    """Return the security headers of a page.

    scripts: contents of the inline scripts that the page may run, which is its import map.
    embedded: whether pages of others may show it in a frame.
    """
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts
    )
    policy = {
        "default-src": "'none'",
        "script-src": f"'self' {hashes}".strip(),
        "style-src": "'self'",
        "img-src": "'self' blob: data:",
        "media-src": "'self' blob:",
        "connect-src": "'self' blob: data:",  # the viewer fetches snapshots that scripts hold in memory
        "worker-src": "'self' blob:",  # the viewer sorts Gaussians in a worker made of its own text
        "frame-src": "'self'",
        "manifest-src": "'self'",
        "base-uri": "'none'",
        "form-action": "'none'",
        "object-src": "'none'",
        "frame-ancestors": "*" if embedded else "'none'",
    }
    return {
        "Content-Security-Policy": "; ".join(f"{name} {value}" for name, value in policy.items()),
        "Permissions-Policy": ", ".join(f"{name}=()" for name in _FEATURES),
        "Referrer-Policy": "no-referrer",  # the address of a page may hold the token of a shared link
        **({} if embedded else {"X-Frame-Options": "DENY", "Cross-Origin-Opener-Policy": "same-origin"}),
    }
