"""What is trained on: shared captures, our own still life, or any folder, each with its fixed options."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from _data import FOLDERS, SHARED

SIDE = 480
"""Longest side of the photos in pixels, small enough for a run of one minute to converge."""


@dataclass(frozen=True)
class Scene:
    """A capture and the options that all runs on it share. `made` names the generator of a built-in scene."""

    name: str
    folder: Path
    options: dict[str, Any] = field(default_factory=lambda: {"image_size": SIDE, "holdout": 8})
    transparent: bool = False
    points: bool = True
    made: str | None = None


KNOWN = ("fox", "lego", "lund", "kermit", "synthetic")
"""Trained by default. fox and lego bring their cameras; those of lund, kermit and the still life are recovered once,
then kept."""

UNEQUAL = "unequal"
MADE = ("synthetic", UNEQUAL)
"""The built-in still life, and the same with a random exposure for each photo."""

ALL = (*KNOWN, UNEQUAL)


def named(text: str, work: Path) -> Scene:
    """The scene of a name or of a capture's folder; generated photos are kept in `work`.

    Raises, with a sentence, ValueError for what is neither, and FileNotFoundError for shared data that is not there.
    """
    if text in MADE:
        return Scene(text, work / text / "capture", made=text)
    if text in KNOWN:
        folder = SHARED / FOLDERS[text]
        if not folder.is_dir():
            raise FileNotFoundError(
                f"{text} is left out: {FOLDERS[text]} is not in ../shared/data, and no part of the project."
            )
        if text == "lego":
            return Scene(text, folder, {"image_size": 400, "holdout": 8}, transparent=True, points=False)
        return Scene(text, folder)
    folder = Path(text)
    if not folder.is_dir():
        raise ValueError(f"{text!r} is neither a scene ({', '.join(ALL)}) nor a folder with a capture.")
    folder = folder.resolve()
    return Scene(f"{folder.name} (folder)" if folder.name in ALL else folder.name, folder)
