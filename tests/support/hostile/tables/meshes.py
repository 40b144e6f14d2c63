"""Hostile wishes for meshes."""

from __future__ import annotations

import json

from tests.support.hostile.entry import Hostile
from tests.support.hostile.tables.requests import SCHEMA

_ADDRESS = f"/v1/models/{'0' * 16}/meshes"


def _mesh(what: str, wish: object, said: str) -> Hostile:
    body = json.dumps(wish).encode()
    return Hostile("Meshes", what, lambda b: b.post(_ADDRESS, body), SCHEMA, said)


MESHES: tuple[Hostile, ...] = (
    _mesh("a mesh of a thousand million triangles", {"faces": 10**9}, "less than or equal"),
    _mesh("a voxel of 0", {"voxel": 0}, "greater than 0"),
    _mesh("a voxel that is no number", {"voxel": float("nan")}, ""),
    _mesh("a box without room", {"box": {"min": [0, 0, 0], "max": [0, 1, 1]}}, "The box is empty"),
    _mesh("a box without end", {"box": {"min": [0, 0, 0], "max": [float("inf"), 1, 1]}}, ""),
)
