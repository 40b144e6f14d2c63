"""Hostile texts and numbers in how a model is shown to people."""

from __future__ import annotations

import json

from tests.support.hostile.entry import Hostile
from tests.support.hostile.tables.requests import SCHEMA

_ADDRESS = f"/v1/models/{'0' * 16}/presentation"
_JSON = "Content-Type: application/json"


def _change(what: str, change: object, said: str) -> Hostile:
    body = json.dumps(change).encode()
    return Hostile(
        "Names for people", what, lambda b: b.request(f"PATCH {_ADDRESS}", body, _JSON), SCHEMA, said
    )


PRESENTATION: tuple[Hostile, ...] = (
    _change(
        "an escape sequence in an annotation",
        {"annotations": [{"point": [0, 0, 0], "text": "\x1b[2J"}]},
        "control character",
    ),
    _change(
        "10,000 annotations of one model",
        {"annotations": [{"point": [0, 0, 0], "text": "a"}] * 10_000},
        "at most 100 items",
    ),
    _change(
        "an annotation beyond all bounds",
        {"annotations": [{"point": [0, 0, 1e300], "text": "a"}]},
        "less than or equal",
    ),
    _change("a scale of 0", {"scale": {"factor": 0, "unit": "cm"}}, "greater than 0"),
)
