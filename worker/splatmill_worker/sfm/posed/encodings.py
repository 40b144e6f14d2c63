"""Reads names in files of cameras that are not UTF-8: in the encoding in which they are those of the photos.

COLMAP writes the bytes of the system, which on Windows are those of its code page, as many scripts do.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

from splatmill_worker.images.archives.zip_names import ENCODINGS, label
from splatmill_worker.sfm.posed.files import ImageFiles
from splatmill_worker.sfm.posed.model_files import GivenModel


def decoded(model: GivenModel, files: ImageFiles) -> tuple[GivenModel, tuple[str, ...]]:
    """The model with names of text alone, and sentences on how they were read, if they are not UTF-8.

    Raises NamesUnclear.
    """
    names = {image.name for image in model.images.values()} | {name for name, _ in model.faulty}
    stored = {name: photo[0] for name in names if not_utf8(name) and (photo := files.photo(name)) is not None}
    model = _named(model, stored)
    unclear = {name: raw for name in sorted(names - stored.keys()) if (raw := not_utf8(name)) is not None}
    if not unclear:
        return model, ()
    readings: dict[str, dict[str, str]] = {}
    for encoding in ENCODINGS:
        with suppress(UnicodeDecodeError):
            readings[encoding] = {name: raw.decode(encoding) for name, raw in unclear.items()}
    best, said = chosen(readings, files, "the COLMAP model")
    if best is None:
        return _named(model, {name: raw.decode("utf-8", "replace") for name, raw in unclear.items()}), ()
    return _named(model, readings[best]), said


Key = TypeVar("Key")


class NamesUnclear(ValueError):
    """Two encodings of the names lead to different photos. The message has both readings."""


def chosen(
    readings: Mapping[str, Mapping[Key, str]], files: ImageFiles, file: str
) -> tuple[str | None, tuple[str, ...]]:
    """The encoding in which the most names are those of photos, and a sentence that says so; None where none is.

    readings: the names as each encoding of zips has them. file: what they were read from, in a sentence.

    Raises NamesUnclear where two encodings lead to different photos.
    """
    photos = {
        encoding: {key: photo[0] for key, text in names.items() if (photo := files.photo(text)) is not None}
        for encoding, names in readings.items()
    }
    most = max(map(len, photos.values()), default=0)
    if not most:
        return None, ()
    first, *others = [encoding for encoding, names in photos.items() if len(names) == most]
    for other in others:
        for key, name in readings[first].items():
            if photos[other].get(key) != photos[first].get(key):
                raise NamesUnclear(
                    f"The names in {file} are not UTF-8, and two readings of them lead to different photos: as "
                    f"{label(first)}, one is {name!r}, and as {label(other)}, {readings[other][key]!r}. Give the "
                    "photos names in ASCII, or leave out those that do not belong to the cameras."
                )
    example = next((name for key in photos[first] if not (name := readings[first][key]).isascii()), None)
    if example is None:
        return first, ()
    return first, (
        f"The names in {file} are not UTF-8. They are read as {label(first)}, as the photos are called: {example}.",
    )


def not_utf8(name: str) -> bytes | None:
    """The bytes of a name that is not UTF-8, whose other bytes are surrogates; None for other names.

    Photos with names in such bytes are stored under others made of them, which `ImageFiles.photo` finds by them.
    """
    raw = name.encode("utf-8", "surrogateescape")
    return None if raw.decode("utf-8", "replace") == name else raw


def _named(model: GivenModel, names: dict[str, str]) -> GivenModel:
    images = {
        number: replace(image, name=names.get(image.name, image.name))
        for number, image in model.images.items()
    }
    faulty = tuple((names.get(name, name), fault) for name, fault in model.faulty)
    return replace(model, images=images, faulty=faulty)
