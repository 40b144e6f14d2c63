"""The parts of a data set: photos for training, photos that are held out, and those of its validation set.

Blender data sets name them by files (transforms_train.json), nerfstudio by lists in a file (test_filenames).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Set
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from splatmill.schema.files.names import readings
from splatmill.schema.quantities import counted
from splatmill_worker.scene import View

Part = Literal["train", "test", "val"]

PARTS: dict[str, Part] = {
    "train": "train",
    "training": "train",
    "test": "test",
    "testing": "test",
    "val": "val",
    "valid": "val",
    "validation": "val",
}
"""The parts by what follows `transforms_` in the name of a file, in lower case, or precedes `_filenames` in a list."""

NOT_USED = "validation sets are not used"


def of_file(path: Path) -> Part | None:
    """The part that the name of a transforms file gives to all of its frames."""
    return PARTS.get(path.stem.lower().removeprefix("transforms").lstrip("_-"))


def of_lists(path: Path, document: dict[str, Any]) -> dict[str, set[Part]]:
    """The parts of each name in the lists of a transforms file. Raises ValueError for a list that is none of names."""
    parts: dict[str, set[Part]] = {}
    for part in ("train", "test", "val"):
        names = document.get(f"{part}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{part}_filenames in {path.name} is no list of names.")
        for name in names:
            parts.setdefault(plain(name), set()).add(PARTS[part])
    return parts


def plain(name: str) -> str:
    """The name of a photo in a transforms file, as it is compared with those in a list."""
    return readings(name)[-1]


def unknown(path: Path, listed: Iterable[str], frames: Iterable[Any]) -> list[str]:
    """A warning about names in the lists of a transforms file that none of its frames has; none without such names."""
    named = {
        plain(frame["file_path"])
        for frame in frames
        if isinstance(frame, dict) and isinstance(frame.get("file_path"), str)
    }
    lost = sorted(set(listed) - named)
    if not lost:
        return []
    return [
        f"The lists of photos to train on or to hold out in {path.name} have {counted(len(lost), 'name')} that no "
        f"frame has, such as {lost[0]!r}, and no use is made of them."
    ]


def divided(
    views: Iterable[View], parts: Mapping[Path, Set[Part]]
) -> tuple[list[View], list[str], list[str]]:
    """The views with their `split`; the names of those that are left out, as a validation set; and warnings.

    parts: those that a photo is named for. A photo for training is used also if it is in a validation set, and one
        that is held out is not trained on, whatever else names it. Without any part, a photo is divided as others are.
    """
    used: list[View] = []
    unused: list[View] = []
    both: list[str] = []
    for view in views:
        own = parts.get(view.image, frozenset())
        if {"train", "test"} <= own:
            both.append(view.name)
        split: Literal["train", "test"] | None = (
            "test" if "test" in own else "train" if "train" in own else None
        )
        (unused if own == {"val"} else used).append(replace(view, split=split))
    warnings = []
    if both:
        warnings.append(
            f"{counted(len(both), 'photo is', 'photos are')} named both for training and for holding out, such as "
            f"{both[0]}: held out."
        )
    if unused and all(view.split == "test" for view in used):
        warnings.append("The validation set has all photos that are not held out, so they are trained on.")
        return [*used, *unused], [], warnings
    return used, [view.name for view in unused], warnings
