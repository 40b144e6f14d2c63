"""What is trained on: shared captures, our own still life, or any folder, each with its fixed options."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from _data import FOLDERS, SHARED

from _train import bare, few, scanned
from splatmill_worker.synthetic import Light, Movers

SIDE = 480
"""Longest side of the photos in pixels, small enough for a run of one minute to converge."""


@dataclass(frozen=True)
class Scene:
    """A capture and the options that all runs on it share. `made` names the generator of a built-in scene; `posed` says
    whether its cameras come with it."""

    name: str
    folder: Path
    options: dict[str, Any] = field(default_factory=lambda: {"image_size": SIDE, "holdout": 8})
    transparent: bool = False
    points: bool = True
    posed: bool = False
    made: str | None = None


KNOWN = ("fox", "lego", "lund", "kermit", "synthetic", "beer", "snowmiku")
"""Trained by default. fox and lego bring their cameras; the others' are recovered once, then kept."""

OFFICIAL = "lego-800"
"""lego at its published size, for `bench train --official`."""

PUBLISHED: dict[str, Any] = {"image_size": 800, "holdout": 8, "background": "white"}
"""Its options. Training is over white too, as 3DGS trains on it; without the option it is over random colours, so that
the model is transparent over any (decisions: random-background)."""

FOLDED = "beer-folded"
"""beer with the cameras that came with it, which lay two sides of the room on each other (decisions: unfold)."""

PLANTED: dict[str, dict[str, Any]] = {
    "unequal": {"light": Light(exposures=0.3)},
    "vignetted": {"light": Light(vignetting=0.4)},
    "tone-mapped": {"light": Light(exposures=0.1, tone=0.5)},
    "passed-by": {"movers": Movers()},
}
"""The built-in still life as cameras show it that change its light: with a random exposure for each training photo,
with darker corners, and with local tone mapping. And with things that stand in the way of single training photos."""

MADE: dict[str, dict[str, Any]] = {"synthetic": {}, **PLANTED}
"""What is planted in the photos of each built-in scene: arguments of `synthetic.capture`."""

COMPARED = (*PLANTED, *bare.SCENES, *few.SCENES, *scanned.SCENES, FOLDED, OFFICIAL)
"""Made for one comparison each; how soon they are learnt says nothing beside the captures that they are made of."""

ALL = (*KNOWN, *COMPARED)


def named(text: str, work: Path) -> Scene:
    """The scene of a name or of a capture's folder; generated photos are kept in `work`.

    Raises, with a sentence, ValueError for what is neither, and FileNotFoundError for shared data that is not there.
    """
    if text in MADE:
        return Scene(text, work / text / "capture", made=text)
    if text in bare.SCENES:
        if not bare.available(text):
            raise FileNotFoundError(
                f"{text} is left out: fox is not in ../shared/data, and no part of the project."
            )
        return Scene(text, work / text / "capture", posed=True, made=text)
    if text in scanned.SCENES:
        options = {"image_size": SIDE, "holdout": 8, "start": scanned.FILE}
        return Scene(text, work / text / "capture", options, made=text)
    if text in few.SCENES:
        whole = named(few.SCENES[text][0], work)
        options = {**whole.options, "test_views": few.held_out(text)}
        return Scene(text, work / text / "capture", options, posed=True, made=text)
    if text in (*KNOWN, FOLDED, OFFICIAL):
        shared = FOLDERS["beer" if text == FOLDED else text]
        folder = SHARED / shared
        if not folder.is_dir():
            raise FileNotFoundError(
                f"{text} is left out: {shared} is not in ../shared/data, and no part of the project."
            )
        if text in ("beer", "snowmiku"):
            return Scene(text, _photos_alone(folder, work / text / "capture"))
        if text in ("lego", OFFICIAL):
            options = {"image_size": 400, "holdout": 8} if text == "lego" else PUBLISHED
            return Scene(text, folder, options, transparent=True, points=False, posed=True)
        return Scene(text, folder, posed=text in (FOLDED, "fox"))
    folder = Path(text)
    if not folder.is_dir():
        raise ValueError(f"{text!r} is neither a scene ({', '.join(ALL)}) nor a folder with a capture.")
    folder = folder.resolve()
    return Scene(f"{folder.name} (folder)" if folder.name in ALL else folder.name, folder)


def _photos_alone(folder: Path, capture: Path) -> Path:
    """The new or kept folder `capture`, which links to the photos of a capture and not to its cameras."""
    if not capture.is_dir():
        capture.mkdir(parents=True)
        (capture / "images").symlink_to(folder / "images")
    return capture
