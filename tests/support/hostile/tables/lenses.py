"""Hostile lenses of cameras that come with photos."""

from __future__ import annotations

import json

from tests.support.hostile import models
from tests.support.hostile.entry import Hostile

INVALID = "the job fails: `poses_invalid`"


def _lens(what: str, said: str, **values: object) -> Hostile:
    data = json.dumps(json.loads(models.transforms()) | values).encode()
    return Hostile("Poses", what, lambda bench: bench.posed({"poses/transforms.json": data}), INVALID, said)


LENSES = (
    _lens(
        "a `camera_model` of panoramas for photos of 4:3", "EQUIRECTANGULAR", camera_model="EQUIRECTANGULAR"
    ),
    _lens("a `camera_model` that is a list of a million", "camera model is [0, 0", camera_model=[0] * 10**6),
    _lens("a coefficient `k6` of infinity", "Frame 0", k6=float("inf")),
    _lens("a coefficient `k1` of text", "Frame 0", k1="rm -rf"),
)
