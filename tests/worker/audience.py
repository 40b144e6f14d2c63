"""Onlookers of a job who keep what they are shown."""

from __future__ import annotations

from pathlib import Path

from splatmill.schema import SnapshotEvent
from splatmill_worker.splat.formats import compressed_ply
from splatmill_worker.splat.gaussians import Gaussians


class Audience:
    """Onlookers who keep what they are shown. there: whether anybody looks."""

    def __init__(self, there: bool = True) -> None:
        self.there = there
        self.shown: list[tuple[bytes, SnapshotEvent]] = []

    def are_there(self) -> bool:
        return self.there

    def show(self, ply: bytes, event: SnapshotEvent) -> None:
        self.shown.append((ply, event))


def snapshot(ply: bytes, folder: Path) -> Gaussians:
    """The scene of a snapshot, which is written into `folder` to be read."""
    path = folder / "snapshot.ply"
    path.write_bytes(ply)
    return compressed_ply.read(path).gaussians
