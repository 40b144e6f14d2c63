"""Finds the photo that a file of cameras names, also where the folders in its path differ from the capture's."""

from __future__ import annotations

import filecmp
import re
import unicodedata
from collections.abc import Callable, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Literal

from splatmill.data_sets import walk
from splatmill.schema.files.masks import masks_beside, paired, without_mask_folder
from splatmill.schema.files.names import UnsafeName, readings, storable_name
from splatmill.schema.files.photos import ARCHIVE_SUFFIXES, PHOTO_SUFFIXES, VIDEO_SUFFIXES
from splatmill.schema.quantities import counted
from splatmill_worker.errors import Refusal, UnusablePicture
from splatmill_worker.images.decoding import decoders

SIZED = re.compile(r"(images|input|rgb)(_\d+)?", re.ASCII | re.IGNORECASE)
"""Folders in which tools put the photos of a data set, and those reduced so many times."""

MAX_ASPECT_RATIO = 1.02
"""Ratio of the aspect ratios of one photo in two sizes: sizes are rounded to whole pixels."""


@dataclass(frozen=True)
class ImageFiles:
    """The photos and masks of a capture.

    root: folder of the photos.
    photos: paths by name relative to `root`.
    masks: paths by name relative to the folder of the masks.
    """

    root: Path
    photos: dict[str, Path]
    masks: dict[str, Path]

    @staticmethod
    def under(directory: Path) -> ImageFiles:
        """The files under `directory`/images, or under `directory` itself when it has no such folder."""
        root = directory / "images" if (directory / "images").is_dir() else directory
        pictures = {
            name: path
            for name in walk(directory)
            if (path := directory / name).suffix.lower() in PHOTO_SUFFIXES and path.is_file()
        }
        inside = {name: inner for name in pictures if (inner := without_mask_folder(name)) is not None}
        candidates = {
            path.relative_to(root).as_posix(): path
            for name, path in pictures.items()
            if name not in inside and path.is_relative_to(root)
        }
        beside = {name: candidates[name] for name in masks_beside(candidates)}
        masks = {inner.removeprefix("images/"): pictures[name] for name, inner in inside.items()}
        photos = {name: path for name, path in candidates.items() if name not in beside}
        return ImageFiles(root, photos, beside | masks)

    def photo(self, name: str) -> tuple[str, Path] | None:
        """Relative name and path of the photo that `name` refers to; None when there is none, or no single one.

        It is the photo with the most trailing path components in common, the file name at least. When no file name
        agrees, the suffix may be missing or differ. Names in another case, or in another form of Unicode, count where
        none agrees exactly, and then those written as in addresses (`a%20b.jpg`). Of one photo in several sizes
        (images_2/, images_4/), it is the largest. A photo that was renamed for storage is found by the name it had.
        """
        best = self.candidates(name)
        match = best[0] if len(best) == 1 else self._largest(best)
        return (match, self.photos[match]) if match is not None else None

    def copies(self, used: Set[Path]) -> tuple[frozenset[Path], tuple[str, ...]]:
        """The photos that are smaller copies of those of `used`, and a sentence for each of their folders."""
        copies: list[Path] = []
        notes = []
        for folders, chosen in self._sizes.items():
            if chosen is None:
                continue
            count = sum(self._in_folder(chosen, path) for path in used)
            others = ", ".join(f"{folder}/" for folder in sorted(folders) if folder != chosen)
            notes.append(f"{count} photos are those of {chosen}/; {others} hold them again, no larger.")
            copies += [
                path
                for name, path in self.photos.items()
                if PurePosixPath(name).parts[0] in folders - {chosen}
            ]
        return frozenset(copies) - used, tuple(notes)

    def mask(self, name: str) -> Path | None:
        """The mask of the photo with this relative name; None when it has none."""
        return self.masks.get(self._pairs.get(name, ""))

    def named_mask(self, name: str) -> Path | None:
        """The mask that a file of cameras names; None when there is none, or no single one."""
        return next((mask for path in readings(name) if (mask := self._mask_at(path)) is not None), None)

    def _mask_at(self, path: str) -> Path | None:
        """The mask with the most trailing parts as `path`, if it is the only one."""
        parts = [part for part in folded(path).split("/") if part not in (".", "..", "")]
        inner = without_mask_folder("/".join(parts))
        for target in [parts] if inner is None else [inner.split("/"), parts]:
            for length in range(len(target), 0, -1):
                names = self._masks_by_end.get(tuple(target[-length:]), [])
                if len(names) == 1:
                    return self.masks[names[0]]
        return None

    @property
    def unused_masks(self) -> set[str]:
        """Names of the masks that belong to none of the photos."""
        return self.masks.keys() - set(self._pairs.values())

    def candidates(self, name: str) -> list[str]:
        """The photos that `name` fits equally well."""
        best: list[str] = []
        for path in readings(name):
            best = best or self._fitting(path)
        # A colon is changed only where the name begins with its letter, so both the path and its last part are tried.
        for changed in () if best else (name, name.rpartition("/")[2]):
            with suppress(UnsafeName):
                best = best or self._fitting(storable_name(changed))
        return best

    @cached_property
    def _pairs(self) -> dict[str, str]:
        return paired(self.photos, self.masks)

    @cached_property
    def _masks_by_end(self) -> dict[tuple[str, ...], list[str]]:
        """Names of the masks by each number of their last parts."""
        index: dict[tuple[str, ...], list[str]] = {}
        for name in self.masks:
            parts = folded(name).split("/")
            for start in range(len(parts)):
                index.setdefault(tuple(parts[start:]), []).append(name)
        return index

    def _fitting(self, name: str) -> list[str]:
        """The photos that the very `name` fits equally well."""
        parts = [part for part in PurePosixPath(name).parts if part not in (".", "..", "/")]
        best: list[str] = []
        for key in (str, folded):
            best = self._best([key(part) for part in parts], key)
            if len(best) == 1:
                break
        return best

    def _best(self, target: list[str], key: Callable[[str], str]) -> list[str]:
        """Names of the photos with the most trailing parts as `target`, by the `key` of each part."""
        best: list[str] = []
        best_length = 0
        for candidate in self._by_last_part(target[-1] if target else "", key):
            parts = [key(part) for part in PurePosixPath(candidate).parts]
            length = 1
            while length < min(len(parts), len(target)) and parts[-1 - length] == target[-1 - length]:
                length += 1
            if length > best_length:
                best, best_length = [candidate], length
            elif length == best_length:
                best.append(candidate)
        exact = [name for name in best if [key(part) for part in PurePosixPath(name).parts] == target]
        return exact if len(exact) == 1 else best

    def _largest(self, names: list[str]) -> str | None:
        """The name of the largest, where all are one photo in folders for several sizes; else None."""
        parts = [PurePosixPath(name).parts for name in names]
        if len({part[1:] for part in parts}) != 1 or not all(SIZED.fullmatch(part[0]) for part in parts):
            return None
        folders = frozenset(part[0] for part in parts)
        if folders not in self._sizes:
            self._sizes[folders] = self._largest_folder(names)
        chosen = self._sizes[folders]
        return next((name for name in names if PurePosixPath(name).parts[0] == chosen), None)

    def _largest_folder(self, names: list[str]) -> str | None:
        """The folder of the largest of these photos; None where two as large differ, or a shape does."""
        try:
            sizes = {name: decoders.sizes(self.photos[name], name)[0] for name in names}
        except UnusablePicture:
            return None
        first, *_ = ordered = sorted(names, key=lambda name: (-sizes[name][0], name))
        aspects = [sizes[name][0] / sizes[name][1] for name in ordered]
        if max(aspects) > min(aspects) * MAX_ASPECT_RATIO:
            return None
        alike = [name for name in ordered[1:] if sizes[name] == sizes[first]]
        if not all(filecmp.cmp(self.photos[first], self.photos[name], shallow=False) for name in alike):
            return None
        return PurePosixPath(first).parts[0]

    def _in_folder(self, folder: str, path: Path) -> bool:
        return path.is_relative_to(self.root / folder)

    def _by_last_part(self, last: str, key: Callable[[str], str]) -> list[str]:
        """Names of the photos whose file name is `last`; when there are none, of those with the same stem."""
        path = PurePosixPath(last)
        stem = path.stem if path.suffix.lower() in PHOTO_SUFFIXES else last
        by_name, by_stem = self._indices[key]
        return by_name.get(last) or by_stem.get(stem, [])

    @cached_property
    def _sizes(self) -> dict[frozenset[str], str | None]:
        """The folder with the largest photos, of folders that hold the same in several sizes."""
        return {}

    @cached_property
    def _indices(self) -> dict[Callable[[str], str], tuple[dict[str, list[str]], dict[str, list[str]]]]:
        """Names of the photos by their file name and by its stem, for each key of names."""
        return {key: (self._indexed(key, "name"), self._indexed(key, "stem")) for key in (str, folded)}

    def _indexed(self, key: Callable[[str], str], of: Literal["name", "stem"]) -> dict[str, list[str]]:
        index: dict[str, list[str]] = {}
        for name in self.photos:
            index.setdefault(key(getattr(PurePosixPath(name), of)), []).append(name)
        return index


def folded(name: str) -> str:
    """A name without its case and form of Unicode, in which programs and systems differ."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def alternatives(name: str, files: ImageFiles) -> str:
    """The photos that a name may refer to, as a part of a sentence, where they are several; else empty."""
    several = files.candidates(name)
    return f"it may be {several[0]} or {several[1]}; leave one of them out" if len(several) > 1 else ""


def instead(files: ImageFiles) -> str:
    """A photo that there is, or a video or zip, as a part of a sentence."""
    whole = [path for path in walk(files.root) if path.lower().endswith((*VIDEO_SUFFIXES, *ARCHIVE_SUFFIXES))]
    if whole and not files.photos:
        return f", but {whole[0]}: cameras are read where photos lie beside them, or in one zip with them"
    return "".join(f": a photo of it is {name!r}" for name in list(files.photos)[:1])


def none_usable(unusable: Sequence[tuple[str, str]]) -> Refusal:
    """The error where no photo that has a camera can be used, given with the reasons."""
    name, reason = unusable[0]
    if decoders.forget_ended():
        return UnusablePicture("decoder_ended", name, f"no photo is left; of this one: {reason}")
    return Refusal(
        "no_images",
        f"None of the {counted(len(unusable), 'photo')} with a camera can be used, such as {name!r}: {reason}.",
        advice="Give whole photos of a format that is read, as the cameras were made for.",
    )


def missing(name: str, files: ImageFiles, fact: str) -> str:
    """Why no photo is used for a name that has a camera. fact: what has the camera."""
    several = alternatives(name, files)
    return f"{fact}, and {several}" if several else f"{fact}, but the capture has no such photo"
