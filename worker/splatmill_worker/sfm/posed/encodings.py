"""Reads the names of a COLMAP model that are not UTF-8: in the encoding in which they are those of the photos.

COLMAP writes the bytes of the system, which on Windows are those of its code page.
"""

from __future__ import annotations

from dataclasses import replace

from splatmill_worker.images.archives.zip_names import ENCODINGS, label
from splatmill_worker.sfm.posed.files import ImageFiles
from splatmill_worker.sfm.posed.model_files import GivenModel


def decoded(model: GivenModel, files: ImageFiles) -> tuple[GivenModel, tuple[str, ...]]:
    """The model with names of text alone, and sentences on how they were read, if they are not UTF-8.

    Of the encodings of zips, that is taken in which the most names are those of photos. Raises ValueError where two of
    them lead to different photos.
    """
    names = {image.name for image in model.images.values()} | {name for name, _ in model.faulty}
    unclear = {name: raw for name in names if (raw := _bytes(name)) is not None}
    if not unclear:
        return model, ()
    photos: dict[str, dict[str, str]] = {}
    for encoding in ENCODINGS:
        try:
            read = {name: raw.decode(encoding) for name, raw in unclear.items()}
        except UnicodeDecodeError:
            continue
        photos[encoding] = {
            name: found[0] for name, text in read.items() if (found := files.photo(text)) is not None
        }
    most = max(map(len, photos.values()), default=0)
    if not most:
        return _named(model, {name: raw.decode("utf-8", "replace") for name, raw in unclear.items()}), ()
    best = [encoding for encoding, found in photos.items() if len(found) == most]
    first = best[0]
    for other in best[1:]:
        if photos[other] != photos[first]:
            name = next(
                name for name in sorted(unclear) if photos[other].get(name) != photos[first].get(name)
            )
            raise ValueError(
                "The names in the COLMAP model are not UTF-8, and two readings of them lead to different photos: as "
                f"{label(first)}, one is {unclear[name].decode(first)!r}, and as {label(other)}, "
                f"{unclear[name].decode(other)!r}. Give the photos names in ASCII, or leave out those that do not "
                "belong to the model."
            )
    example = min(photos[first])
    said = (
        f"The names in the COLMAP model are not UTF-8. They are read as {label(first)}, as the photos are called: "
        f"{unclear[example].decode(first)}."
    )
    return _named(model, {name: raw.decode(first) for name, raw in unclear.items()}), (said,)


def _bytes(name: str) -> bytes | None:
    """The bytes of a name that is not UTF-8; None for others."""
    raw = name.encode("utf-8", "surrogateescape")
    return None if raw.decode("utf-8", "replace") == name else raw


def _named(model: GivenModel, names: dict[str, str]) -> GivenModel:
    images = {
        number: replace(image, name=names.get(image.name, image.name))
        for number, image in model.images.items()
    }
    faulty = tuple((names.get(name, name), fault) for name, fault in model.faulty)
    return replace(model, images=images, faulty=faulty)
