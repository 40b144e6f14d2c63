"""Finds the photo that a file of cameras names, also where the folders in its path differ from the capture's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

from splatmill.schema.photos import MASK_FOLDERS, PHOTO_SUFFIXES
from splatmill_worker.images.masks import mask_of, masks_under


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
        masks = next((directory / name for name in MASK_FOLDERS if (directory / name).is_dir()), None)
        found = {
            path.relative_to(root).as_posix(): path
            for path in sorted(root.rglob("*"))
            if path.suffix.lower() in PHOTO_SUFFIXES and path.is_file()
        }
        if masks is not None and masks.is_relative_to(root):
            inner = masks.relative_to(root).as_posix() + "/"
            found = {name: path for name, path in found.items() if not name.startswith(inner)}
        return ImageFiles(root, found, masks_under(masks) if masks is not None else {})

    def photo(self, name: str) -> tuple[str, Path] | None:
        """Relative name and path of the photo that `name` refers to; None when there is none, or no single one.

        It is the photo with the most trailing path components in common, the file name at least. When no file name
        agrees, the suffix may be missing or differ.
        """
        wanted = [
            part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in (".", "..", "/")
        ]
        best: list[str] = []
        best_length = 0
        for candidate in self._by_last_part(wanted[-1] if wanted else ""):
            parts = PurePosixPath(candidate).parts
            length = 1
            while length < min(len(parts), len(wanted)) and parts[-1 - length] == wanted[-1 - length]:
                length += 1
            if length > best_length:
                best, best_length = [candidate], length
            elif length == best_length:
                best.append(candidate)
        exact = "/".join(wanted)
        if exact in best:
            best = [exact]
        return (best[0], self.photos[best[0]]) if len(best) == 1 else None

    def mask(self, name: str) -> Path | None:
        """The mask of the photo with this relative name; None when it has none."""
        return mask_of(name, self.masks)

    def _by_last_part(self, last: str) -> list[str]:
        """Names of the photos whose file name is `last`; when there are none, of those with the same stem."""
        path = PurePosixPath(last)
        stem = path.stem if path.suffix.lower() in PHOTO_SUFFIXES else last
        return self._by_name.get(last) or self._by_stem.get(stem, [])

    @cached_property
    def _by_name(self) -> dict[str, list[str]]:
        return self._indexed(lambda path: path.name)

    @cached_property
    def _by_stem(self) -> dict[str, list[str]]:
        return self._indexed(lambda path: path.stem)

    def _indexed(self, key: Callable[[PurePosixPath], str]) -> dict[str, list[str]]:
        index: dict[str, list[str]] = {}
        for name in self.photos:
            index.setdefault(key(PurePosixPath(name)), []).append(name)
        return index
