"""What is trained on: shared captures, our own still life, or any folder, each with its fixed options."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from _data import FOLDERS, SHARED

SIDE = 480
"""Longest side of the photos in pixels: small enough that a run of a minute has annealed and converged."""


@dataclass(frozen=True)
class Scene:
    """A capture and the options that every run of it shares. `made`: photographed by ourselves on first use."""

    name: str
    folder: Path
    options: dict[str, Any] = field(default_factory=lambda: {"image_size": SIDE, "holdout": 8})
    transparent: bool = False
    made: bool = False


KNOWN = ("fox", "lego", "lund", "kermit", "synthetic")
"""fox and lego bring their cameras; those of lund, kermit and the still life are recovered once, then kept."""


def named(text: str, work: Path) -> Scene:
    """A scene by its name, or the folder of a capture; `work` is where things made on the way are kept.

    Raises, with a sentence, ValueError for what is neither, and FileNotFoundError for shared data that is not there.
    """
    if text == "synthetic":
        return Scene(text, work / "synthetic" / "capture", made=True)
    if text in KNOWN:
        folder = SHARED / FOLDERS[text]
        if not folder.is_dir():
            raise FileNotFoundError(
                f"{text} is left out: {FOLDERS[text]} is not in ../shared/data, and no part of the project."
            )
        if text == "lego":
            return Scene(text, folder, {"image_size": 400, "holdout": 8}, transparent=True)
        return Scene(text, folder)
    folder = Path(text)
    if not folder.is_dir():
        raise ValueError(f"{text!r} is neither a scene ({', '.join(KNOWN)}) nor a folder with a capture.")
    folder = folder.resolve()
    return Scene(f"{folder.name} (folder)" if folder.name in KNOWN else folder.name, folder)
