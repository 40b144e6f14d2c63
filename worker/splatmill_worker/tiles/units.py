"""The plan of a scene in tiles: its units, what each needs, and which can be run now."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from splatmill.schema import TrainOptions

FORMAT = 10
"""Version of the plan's format and of what its units make: another one makes everything anew."""

PHOTO_OPTIONS = ("max_video_frames", "seed", "sfm_effort", "matcher")
"""Options that features and matches follow from, and where these are kept."""

MAPPING_OPTIONS = (*PHOTO_OPTIONS, "mapper")
"""Options that the models of clusters follow from, and where these are kept."""

CAMERA_OPTIONS = (*MAPPING_OPTIONS, "scale", "start")
"""Options that the cameras and the points follow from. The others do not change them."""

DIVIDED = "divided"
"""Fact of the unit `photos`: whether the units between it and the cameras have something to do."""

CLUSTERS = "clusters"
"""Fact of the unit `photos`: the number of clusters of photos, which the incremental mapper maps apart."""

MOST_BLOCKS = 64
"""Blocks of photos, of their pairs and of their clusters, at most: more machines do not find the cameras together."""

State = Literal["done", "failed"]


@dataclass(frozen=True)
class Unit:
    """A part of the work, which one process does.

    name: unique in its plan.
    needs: names of the units whose output it reads.
    optional: those of them that may have failed: the unit does without their output.
    """

    name: str
    needs: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScenePlan:
    """What the units of a scene follow from.

    digest: of the files of the capture.
    options: of the training, with the number of tiles.
    """

    digest: str
    options: TrainOptions

    def __post_init__(self) -> None:
        if self.options.tiles is None:
            raise ValueError("Its options have no number of tiles.")

    @property
    def tiles(self) -> int:
        """How many parts the scene is trained in."""
        assert self.options.tiles is not None
        return self.options.tiles

    @property
    def blocks(self) -> int:
        """How many parts the photos are divided into, their pairs, and their clusters."""
        return min(self.tiles, MOST_BLOCKS)

    @cached_property
    def feature_names(self) -> tuple[str, ...]:
        """The units that find the features of a block of the photos each."""
        return tuple(f"features-{number}" for number in range(1, self.blocks + 1))

    @cached_property
    def match_names(self) -> tuple[str, ...]:
        """The units that match a block of the pairs of photos each."""
        return tuple(f"matches-{number}" for number in range(1, self.blocks + 1))

    @cached_property
    def mapping_names(self) -> tuple[str, ...]:
        """The units that map a block of the clusters of photos each."""
        return tuple(f"mapping-{number}" for number in range(1, self.blocks + 1))

    @cached_property
    def camera_names(self) -> tuple[str, ...]:
        """The units whose outputs follow from the photos and CAMERA_OPTIONS alone. The last one makes the cameras."""
        return ("photos", *self.feature_names, "pairs", *self.match_names, *self.mapping_names, "cameras")

    @cached_property
    def tile_names(self) -> tuple[str, ...]:
        """The units that train the tiles. They need the output of the coarse model alone, and not the capture."""
        return tuple(tile_name(number) for number in range(1, self.tiles + 1))

    @cached_property
    def seam_names(self) -> tuple[str, ...]:
        """The units that train each tile to its end, with what the others were trained to around it."""
        return tuple(seam_name(number) for number in range(1, self.tiles + 1))

    @cached_property
    def part_names(self) -> tuple[str, ...]:
        """The units that several machines do at a time, in the order of their numbers in the queue, from 1."""
        return self.tile_names + self.seam_names + self.feature_names + self.match_names + self.mapping_names

    @cached_property
    def units(self) -> tuple[Unit, ...]:
        """All units, each after those that it needs."""
        features, matches, mapping = self.feature_names, self.match_names, self.mapping_names
        tiles, seams = self.tile_names, self.seam_names
        return (
            Unit("photos"),
            *(Unit(name, ("photos",)) for name in features),
            Unit("pairs", ("photos", *features), features),
            *(Unit(name, ("photos", *features, "pairs"), features) for name in matches),
            *(Unit(name, ("photos", *features, "pairs", *matches), features + matches) for name in mapping),
            Unit("cameras", ("photos", *features, "pairs", *matches, *mapping), features + matches + mapping),
            Unit("coarse", ("photos", "cameras")),
            *(Unit(name, ("coarse",)) for name in tiles),
            *(Unit(name, ("coarse", *tiles), tiles) for name in seams),
            Unit("scene", ("photos", "cameras", "coarse", *tiles, *seams), tiles + seams),
        )

    def unit(self, name: str) -> Unit:
        """The unit of that name. Raises KeyError."""
        return self._by_name[name]

    @cached_property
    def _by_name(self) -> dict[str, Unit]:
        return {unit.name: unit for unit in self.units}

    @cached_property
    def _chosen(self) -> dict[str, Any]:
        return self.options.model_dump(mode="json")

    def key(self, name: str, states: Mapping[str, State]) -> str:
        """A digest of all that the output of a unit follows from: equal keys, equal outputs.

        states: of the units, by which the scene without a failed tile has another key than the scene with it.
        """
        own: dict[str, Any] = {"format": FORMAT, "unit": name, "capture": self.digest}
        options = self._chosen
        if name in self.camera_names:
            # Where a block has failed, a unit after it does that itself, and makes the same; the mapping does without.
            used: tuple[str, ...] = PHOTO_OPTIONS
            if name in self.mapping_names:
                used = MAPPING_OPTIONS
            elif name == "cameras":
                used = CAMERA_OPTIONS
            own["options"] = {option: options[option] for option in used}
            if name in self.part_names:
                own["blocks"] = self.blocks
        else:
            own["options"] = options
        if self.depends_on_failures(name):
            # Features of a block that failed are found by `pairs`, which the mapping reads as well.
            counted = self.match_names if name in self.mapping_names else self.unit(name).optional
            own["failed"] = [need for need in counted if states.get(need) == "failed"]
        return hashlib.sha256(json.dumps(own, sort_keys=True).encode()).hexdigest()[:16]

    def left_out(self, photos: Mapping[str, Any]) -> set[str]:
        """Names of the units between `photos` and `cameras` that have nothing to do.

        photos: facts of the unit `photos`.
        """
        if not photos.get(DIVIDED, True):
            return set(self.camera_names[1:-1])
        clusters = 0 if self.options.mapper == "global" else photos.get(CLUSTERS, 0)
        return set(self.mapping_names[clusters:])

    def depends_on_failures(self, name: str) -> bool:
        """Whether the output of a unit is another one where units before it have failed."""
        optional = bool(self.unit(name).optional)
        return optional and (name not in self.camera_names or name in self.mapping_names)

    def ready(self, states: Mapping[str, State]) -> list[str]:
        """Names of the units that the scene needs, that have not ended and whose needs are met, in the order of the
        plan."""
        pending = self.pending(states)
        return [
            unit.name for unit in self.units if unit.name in pending and not self.missing(unit.name, states)
        ]

    def pending(self, states: Mapping[str, State]) -> set[str]:
        """The units that have not ended and that the scene still needs: not those before the cameras, once these are
        there."""
        names: set[str] = set()
        left = ["scene"]
        while left:
            name = left.pop()
            if name not in states and name not in names:
                names.add(name)
                left += self.unit(name).needs
        return names

    def needed(self, states: Mapping[str, State]) -> set[str]:
        """The units that the scene still needs, and those that they read."""
        pending = self.pending(states)
        return pending.union(need for name in pending for need in self.unit(name).needs)

    def missing(self, name: str, states: Mapping[str, State]) -> list[str]:
        """The units that must end before the unit `name` can be run."""
        unit = self.unit(name)
        return [
            need
            for need in unit.needs
            if states.get(need) != "done" and not (need in unit.optional and states.get(need) == "failed")
        ]

    def as_dict(self) -> dict[str, Any]:
        """The plan as JSON has it."""
        return {
            "format": FORMAT,
            "digest": self.digest,
            "options": self.options.model_dump(mode="json"),
        }

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> ScenePlan:
        """The plan of `as_dict`. Raises ValueError for another format, and KeyError or TypeError for other fields."""
        if values["format"] != FORMAT:
            raise ValueError(f"It has format {values['format']}, and this version reads format {FORMAT}.")
        return ScenePlan(str(values["digest"]), TrainOptions.model_validate(values["options"]))


def tile_name(number: int) -> str:
    """The name of the unit that trains a tile. number: from 1."""
    return f"tile-{number}"


def seam_name(number: int) -> str:
    """The name of the unit that trains a tile to its end. number: from 1."""
    return f"seam-{number}"


def tile_number(name: str) -> int:
    """The number of the tile that a unit trains, from 1. name: of a tile or a seam."""
    return int(name.partition("-")[2])
