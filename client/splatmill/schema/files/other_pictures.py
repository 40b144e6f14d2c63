"""Folders whose pictures are no photos, by their names: masks, depth maps and the like. Case does not matter."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os.path import splitext

from splatmill.schema.files.masks import MASK_FOLDERS
from splatmill.schema.files.photos import PHOTO_SUFFIXES
from splatmill.schema.quantities import counted, listed

DEPTH, CONFIDENCE = "depth maps", "confidence maps"
"""What lies in folders of depths of the photos, and of how sure these are."""

OTHER_FOLDERS = {
    "masks": MASK_FOLDERS,
    DEPTH: ("depth", "depths", "depth_maps", "depthmaps"),
    "normal maps": ("normals", "normal_maps", "normalmaps"),
    CONFIDENCE: ("confidence", "confidences", "confidence_maps"),
    "pictures of labels": ("semantic", "semantics", "semantic_maps"),
    "thumbnails": ("thumbnail", "thumbnails", "thumbs"),
}
"""What lies in folders, with the names, in lower case, of these. Masks and depths are used, and thumbnails are compared
with the photos; no use is made of the others."""

MEASURED = (DEPTH, CONFIDENCE)
"""Those of OTHER_FOLDERS that go along with the photos that they belong to."""

NO_PHOTOS = tuple(what for what in OTHER_FOLDERS if what not in ("masks", "thumbnails"))
"""Those of OTHER_FOLDERS that are not taken for photos where photos lie beside them."""

UNUSED = tuple(what for what in NO_PHOTOS if what not in MEASURED)
"""Those of NO_PHOTOS of which no use is made."""

ADVICE = "Give the photos; if these are the photos, give their folder another name."
"""What to do where all pictures lie in such folders."""


def kind_of_folder(name: str) -> str | None:
    """Return what a file is by the folders in its path `name`: one of OTHER_FOLDERS, or None."""
    for folder in name.split("/")[:-1]:
        for what, folders in OTHER_FOLDERS.items():
            if folder.lower() in folders:
                return what
    return None


def without_folder(name: str) -> str:
    """Return a path without the first folder in it that says what its files are."""
    parts = name.split("/")
    for index in range(1, len(parts)):
        if kind_of_folder("/".join(parts[:index]) + "/") is not None:
            return "/".join([*parts[: index - 1], *parts[index:]])
    return name


def no_photos(names: Sequence[str]) -> str:
    """Return a sentence where all of the pictures `names` lie in such folders; "" where one does not."""
    kinds = [kind_of_folder(name) for name in names]
    if not names or None in kinds:
        return ""
    which = f"All {len(names)} pictures lie" if len(names) > 1 else "The only picture lies"
    said = sorted({str(kind) for kind in kinds})
    return f"{which} in a folder of {' or '.join(said)} by its name, such as {names[0]}. {ADVICE}"


def beside_photos(names: Iterable[str]) -> dict[str, str]:
    """Return those of the files `names` that are NO_PHOTOS, with what they are; none without a photo beside."""
    kinds = {name: kind_of_folder(name) for name in names if splitext(name)[1].lower() in PHOTO_SUFFIXES}
    if None not in kinds.values():
        return {}
    return {name: kind for name, kind in kinds.items() if kind in NO_PHOTOS and kind is not None}


def remarks(others: dict[str, str]) -> list[str]:
    """Return a sentence for each kind of the pictures that `beside_photos` names."""
    said = []
    for what in UNUSED:
        names = [name for name, kind in others.items() if kind == what]
        if names:
            are = counted(len(names), "picture is", "pictures are")
            said.append(f"{are} taken for {what} by the name of the folder and not used: {listed(names, 1)}.")
    return said
