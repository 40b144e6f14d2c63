"""Signatures of webhooks: those of the specification's own example, and what is refused."""

import json
import subprocess
import sys
from typing import Any

import pytest

from splatmill import InvalidWebhook, verify_webhook
from splatmill.sdk.webhook_signature import sign

# The example of the specification's reference libraries (MIT), for which they publish the signature.
SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"
MESSAGE, TIME, BODY = "msg_p5jXN8AQM9LWM0D4loKWxJek", 1614265330, b'{"test": 2432232314}'
SIGNATURE = "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="


def headers(**other: str) -> dict[str, str]:
    standard = {"Webhook-Id": MESSAGE, "Webhook-Timestamp": str(TIME), "Webhook-Signature": SIGNATURE}
    return standard | {f"Webhook-{name.capitalize()}": value for name, value in other.items()}


def test_the_signature_is_that_of_the_specification() -> None:
    assert sign(SECRET, MESSAGE, TIME, BODY) == SIGNATURE
    assert verify_webhook(headers(), BODY, SECRET, now=TIME) == {"test": 2432232314}
    assert verify_webhook(headers(), BODY.decode(), SECRET, now=TIME + 299) == {"test": 2432232314}


def test_one_of_several_signatures_and_secrets_is_enough() -> None:
    several = f"v1,{'A' * 43}= v1a,other {SIGNATURE}"
    assert verify_webhook(headers(signature=several), BODY, SECRET, now=TIME)
    assert verify_webhook(headers(), BODY, ["whsec_AAAA", SECRET], now=TIME)


@pytest.mark.parametrize(
    ("changed", "body", "now", "why"),
    [
        ({}, BODY + b" ", TIME, "does not fit"),
        ({"id": "msg_other"}, BODY, TIME, "does not fit"),
        ({"timestamp": str(TIME + 1)}, BODY, TIME, "does not fit"),
        ({"signature": SIGNATURE.replace("v1,", "v2,")}, BODY, TIME, "does not fit"),
        ({"signature": ""}, BODY, TIME, "does not fit"),
        ({"signature": "v1,é"}, BODY, TIME, "does not fit"),
        ({}, BODY, TIME + 301, "seconds old"),
        ({}, BODY, TIME - 301, "seconds old"),
        ({"timestamp": "now"}, BODY, TIME, "not a time"),
    ],
)
def test_what_is_not_signed_or_is_old_is_refused(
    changed: dict[str, str], body: bytes, now: float, why: str
) -> None:
    with pytest.raises(InvalidWebhook, match=why):
        verify_webhook(headers(**changed), body, SECRET, now=now)


def test_missing_headers_other_secrets_and_other_bodies_are_named() -> None:
    with pytest.raises(InvalidWebhook, match="webhook-id is missing"):
        verify_webhook({}, BODY, SECRET)
    with pytest.raises(InvalidWebhook, match="begins with whsec_"):
        verify_webhook(headers(), BODY, "whsec_not base64", now=TIME)
    for body in (b"not json", b"[1]"):
        signed: Any = headers(signature=sign(SECRET, MESSAGE, TIME, body))
        with pytest.raises(InvalidWebhook, match="JSON"):
            verify_webhook(signed, body, SECRET, now=TIME)


def test_it_needs_the_standard_library_alone() -> None:
    code = "import sys, json, splatmill.sdk.webhook_signature; print(json.dumps(list(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in json.loads(done.stdout)}
    assert loaded.isdisjoint({"httpx", "pydantic", "typer", "rich", "redis"})
