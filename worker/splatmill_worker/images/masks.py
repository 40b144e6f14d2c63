"""Finds the masks of photos by their names."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from splatmill.schema.photos import MASK_SUFFIXES


def masks_under(directory: Path) -> dict[str, Path]:
    """The masks in `directory`, by their name relative to it."""
    return {
        path.relative_to(directory).as_posix(): path
        for path in sorted(directory.rglob("*"))
        if path.suffix.lower() in MASK_SUFFIXES and path.is_file()
    }


def mask_of(name: str, masks: dict[str, Path]) -> Path | None:
    """The mask of the photo `name`: by COLMAP's convention (name.jpg.png), the same name, or the same stem."""
    stem = str(PurePosixPath(name).with_suffix(""))
    candidates = (f"{name}.png", f"{stem}.png", name, *(f"{stem}{suffix}" for suffix in MASK_SUFFIXES))
    return next((masks[candidate] for candidate in candidates if candidate in masks), None)
