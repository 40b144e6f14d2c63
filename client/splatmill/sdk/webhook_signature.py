"""Signatures of webhooks by the Standard Webhooks specification, with the standard library alone.

A receiver needs nothing else of this package: `verify_webhook` may be called in any web framework.
"""

import base64
import binascii
import hashlib
import hmac
import json
import time
from collections.abc import Iterable, Mapping
from typing import Any

SECRET_PREFIX = "whsec_"

TOLERANCE = 300.0
"""Seconds that the time of a webhook may be off the receiver's clock. A request recorded earlier is not accepted."""


class InvalidWebhook(ValueError):
    """A request is not a webhook of the holder of the secret, or is too old. The message says why."""


def verify_webhook(
    headers: Mapping[str, str],
    body: bytes | str,
    secret: str | Iterable[str],
    *,
    tolerance: float = TOLERANCE,
    now: float | None = None,
) -> dict[str, Any]:
    """Return the payload of a webhook: `type`, `timestamp` and `data`. Raises InvalidWebhook for a request of others.

    headers: those of the request, with names in any case.
    body: the body as it was received; a parsed and rewritten one has another signature.
    secret: that of the webhook (`whsec_...`), or several.
    tolerance: seconds that the time of the request may be off.
    now: Unix time in seconds; by default, that of the clock.

    A webhook that was not answered is sent again with the same `webhook-id`, by which a receiver can recognise it.
    """
    lower_case = {str(name).lower(): str(value) for name, value in headers.items()}
    try:
        message_id, timestamp, signature_header = (
            lower_case[f"webhook-{part}"].strip() for part in ("id", "timestamp", "signature")
        )
    except KeyError as error:
        raise InvalidWebhook(f"The header {error.args[0]} is missing.") from None
    if not (timestamp.isascii() and timestamp.isdigit() and len(timestamp) < 16):
        raise InvalidWebhook("The header webhook-timestamp is not a time in seconds.")
    if abs((time.time() if now is None else now) - int(timestamp)) > tolerance:
        raise InvalidWebhook(f"The webhook is more than {tolerance:.0f} seconds old, or from the future.")
    data = body.encode() if isinstance(body, str) else bytes(body)
    signatures = [part for part in signature_header.split() if part.startswith("v1,")]
    secrets = [secret] if isinstance(secret, str) else list(secret)
    matches = [
        hmac.compare_digest(sign(one, message_id, int(timestamp), data).encode(), signature.encode())
        for one in secrets
        for signature in signatures
    ]
    if not any(matches):
        raise InvalidWebhook("The signature does not fit the body and the secret.")
    try:
        payload = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InvalidWebhook("The body is not JSON.") from error
    if not isinstance(payload, dict):
        raise InvalidWebhook("The body is not a JSON object.")
    return payload


def sign(secret: str, message_id: str, timestamp: int, body: bytes) -> str:
    """Return the signature of a webhook: `v1,` and the HMAC-SHA256 in base64.

    It covers the id, the time and the body, so that none of them can be exchanged. Raises InvalidWebhook
    for a secret of another form.
    """
    try:
        key = base64.b64decode(secret.removeprefix(SECRET_PREFIX), validate=True)
    except (binascii.Error, ValueError) as error:
        raise InvalidWebhook(
            f"The secret is not one of a webhook; it begins with {SECRET_PREFIX}."
        ) from error
    signed = hmac.new(key, f"{message_id}.{timestamp}.".encode() + body, hashlib.sha256).digest()
    return "v1," + base64.b64encode(signed).decode()
