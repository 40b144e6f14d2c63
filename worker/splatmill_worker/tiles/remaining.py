"""How long the tiles of a plan still take, by those that have been trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from splatmill_worker.tiles.tile import LAST
from splatmill_worker.tiles.units import ScenePlan


@dataclass(frozen=True)
class Remaining:
    """The tiles and last steps that are left beside the one that is trained now.

    tiles, seams: how many of each.
    tile_seconds, seam_seconds: of those that have ended, one each.
    is_seam: whether last steps are trained now.
    """

    tiles: int
    seams: int
    tile_seconds: tuple[float, ...]
    seam_seconds: tuple[float, ...]
    is_seam: bool

    @staticmethod
    def of(plan: ScenePlan, seconds: Mapping[str, float | None], name: str) -> Remaining:
        """While the unit `name` is done. seconds: of the units that have ended; None for one that failed."""

        def left(names: tuple[str, ...]) -> int:
            return sum(each not in seconds and each != name for each in names)

        def known(names: tuple[str, ...]) -> tuple[float, ...]:
            return tuple(duration for each in names if (duration := seconds.get(each)) is not None)

        tiles = plan.tile_names
        seams = tuple(  # those of a tile that failed have nothing to do
            seam
            for tile, seam in zip(tiles, plan.seam_names, strict=True)
            if tile not in seconds or seconds[tile] is not None
        )
        return Remaining(left(tiles), left(seams), known(tiles), known(seams), name in seams)

    def seconds(self, passed: float, eta: float) -> float:
        """Time until all are trained, one after the other. passed, eta: of the one that is trained now.

        Tiles take what the others take in the mean. Last steps are taken to need their share of the steps of a tile
        until some have been trained.
        """
        own = passed + eta
        tiles = self.tile_seconds if self.is_seam else (*self.tile_seconds, own)
        seams = (*self.seam_seconds, own) if self.is_seam else self.seam_seconds
        tile = sum(tiles) / max(1, len(tiles))
        seam = sum(seams) / len(seams) if seams else tile * LAST / (1.0 - LAST)
        return eta + self.tiles * tile + self.seams * seam
