"""Hostile tags of models, and hostile selections of their Gaussians."""

from __future__ import annotations

import json

from tests.support.hostile.entry import Hostile
from tests.support.hostile.tables.requests import SCHEMA

_MODEL = f"/v1/models/{'0' * 16}"
_JSON = "Content-Type: application/json"
_FRONT = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def _tags(what: str, tags: list[str], said: str) -> Hostile:
    body = json.dumps({"tags": tags}).encode()
    return Hostile(
        "Names for people", what, lambda b: b.request(f"PATCH {_MODEL}", body, _JSON), SCHEMA, said
    )


def _strokes(what: str, strokes: list[dict[str, object]], said: str) -> Hostile:
    body = json.dumps({"selection": {"strokes": strokes}}).encode()
    return Hostile("API", what, lambda b: b.request(f"POST {_MODEL}/edits", body, _JSON), SCHEMA, said)


LABELS: tuple[Hostile, ...] = (
    _tags("an escape sequence in a tag", ["\x1b[2J"], "control character"),
    _tags("10,000 tags of one model", [str(number) for number in range(10_000)], "at most 12 items"),
    _tags("a tag of 10,000 characters", ["a" * 10_000], "at most 40 characters"),
    _strokes(
        "a selection of 1,000 strokes",
        [{"camera_to_world": _FRONT, "points": [[0, 0]], "radius": 1}] * 1000,
        "at most 64 items",
    ),
    _strokes(
        "a stroke of 10,000 points",
        [{"camera_to_world": _FRONT, "points": [[0, 0]] * 10_000, "radius": 1}],
        "at most 256 items",
    ),
    _strokes(
        "a stroke on a view of no rotation",
        [{"camera_to_world": [[0] * 4] * 4, "points": [[0, 0]], "radius": 1}],
        "last row of camera_to_world",
    ),
)
