"""Which of the files a person gave are usable photos, and why the others are not."""

from __future__ import annotations

import hashlib
import os
import shutil
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from splatmill.schema.photos import ARCHIVE_SUFFIXES, MAX_PHOTO_PIXELS, MIN_PHOTO_SIDE, VIDEO_SUFFIXES
from splatmill_worker.errors import Cancelled
from splatmill_worker.images import archive, exif, video
from splatmill_worker.images.decode import upright_size
from splatmill_worker.images.masks import mask_of, masks_under

IGNORED_PREFIXES = (".", "__MACOSX")
IGNORED_NAMES = ("thumbs.db", "desktop.ini")


@dataclass(frozen=True)
class Usable:
    """A photo that decodes: its name, file, mask, content hash, size once upright, and what its EXIF says.

    `sequence` names the video it is a frame of.
    """

    name: str
    path: Path
    sha256: str
    width: int
    height: int
    exif: exif.Exif
    mask: Path | None = None
    sequence: str | None = None


@dataclass(frozen=True)
class Prepared:
    """The usable photos sorted by name, and (name, reason) of every file that was skipped."""

    photos: tuple[Usable, ...]
    skipped: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """A hash of the names and contents: the same photos, the same key."""
        digest = hashlib.sha256()
        for photo in self.photos:
            mask = _sha256(photo.mask) if photo.mask is not None else ""
            digest.update(f"{photo.name}\0{photo.sha256}\0{mask}\n".encode())
        return digest.hexdigest()


@dataclass
class _Found:
    files: list[tuple[str, Path, str | None]] = field(default_factory=list)  # name, path, video it came from
    skipped: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def prepare(
    images: Path,
    masks: Path | None,
    workdir: Path,
    *,
    frames: int = 100,
    on_progress: Callable[[str, int, int, str], None] = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Prepared:
    """Looks through the files under `images`: zips are unpacked and videos cut into `frames` photos in `workdir`.

    Skipped by rule, each with its reason: what is no image, does not decode to the end, has a side under 16
    pixels or more than 250 million pixels (told from the header, never decoded), and the second of two files
    with the same bytes. Masks are found in `masks`, or beside a photo as name.jpg.png. `on_progress` gets the
    stage, files done, files in all, and the file's name.

    Raises Cancelled when cancelled.
    """
    found = _Found()
    for path in _files(images):
        _expand(path.relative_to(images).as_posix(), path, None, workdir, frames, found, cancelled)
    beside = {name: path for name, path, _ in found.files}
    mask_files = masks_under(masks) if masks is not None and masks.is_dir() else {}
    own_masks = {name for name in beside if name.endswith(".png") and name[: -len(".png")] in beside}
    candidates = [file for file in found.files if file[0] not in own_masks]
    photos: dict[str, Usable] = {}
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        looked = pool.map(lambda file: None if cancelled() else _look_at(*file), candidates)
        for done, ((name, _, _), result) in enumerate(zip(candidates, looked, strict=True), 1):
            if result is None:
                raise Cancelled("Looking through the photos was cancelled.")
            on_progress("images", done, len(candidates), name)
            if isinstance(result, str):
                found.skipped.append((name, result))
                continue
            same = photos.get(result.sha256)
            if same is not None:
                found.skipped.append((name, f"the same bytes as {same.name}"))
                continue
            mask = mask_of(name, mask_files)
            if mask is None and f"{name}.png" in own_masks:
                mask = beside[f"{name}.png"]
            photos[result.sha256] = _with_mask(result, mask, found)
    ordered = tuple(sorted(photos.values(), key=lambda photo: photo.name))
    return Prepared(ordered, tuple(found.skipped), tuple(found.notes))


def _files(images: Path) -> list[Path]:
    """Regular files, no links, nothing hidden, sorted by name."""
    if not images.is_dir():
        return []
    return [
        path
        for path in sorted(images.rglob("*"))
        if path.is_file()
        and not path.is_symlink()
        and path.name.lower() not in IGNORED_NAMES
        and not any(part.startswith(IGNORED_PREFIXES) for part in path.relative_to(images).parts)
    ]


def _expand(
    name: str,
    path: Path,
    inside: str | None,
    workdir: Path,
    frames: int,
    found: _Found,
    cancelled: Callable[[], bool],
) -> None:
    """Adds a file, or what a zip or video holds, to `found`; unpacked content is kept by its hash."""
    suffix = path.suffix.lower()
    try:
        if suffix in ARCHIVE_SUFFIXES and inside is None:
            folder = _once(
                workdir / "unpacked" / _sha256(path)[:24],
                lambda place: archive.unpack(path, place, cancelled),
            )
            for inner in _files(folder):
                inner_name = f"{Path(name).with_suffix('').as_posix()}/{inner.relative_to(folder).as_posix()}"
                _expand(inner_name, inner, name, workdir, frames, found, cancelled)
        elif suffix in ARCHIVE_SUFFIXES:
            found.skipped.append((name, "a zip inside a zip is not unpacked"))
        elif suffix in VIDEO_SUFFIXES:
            folder = _once(
                workdir / "frames" / f"{_sha256(path)[:24]}_{frames}",
                lambda place: video.sharpest_frames(path, place, frames, cancelled=cancelled),
            )
            pictures = _files(folder)
            prefix = Path(name).with_suffix("").as_posix()
            found.files += [(f"{prefix}_{p.stem.rpartition('_')[2]}.jpg", p, name) for p in pictures]
            found.notes.append(f"{len(pictures)} frames were taken from {name}.")
        else:
            found.files.append((name, path, None))
    except Cancelled:
        raise
    except (ValueError, OSError) as error:
        found.skipped.append((name, str(error)))


def _once(folder: Path, make: Callable[[Path], object]) -> Path:
    """`folder` as `make` filled it: made under another name and moved, so that a half-made one is never taken."""
    if folder.is_dir():
        return folder
    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        make(partial)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder


def _look_at(name: str, path: Path, sequence: str | None) -> Usable | str:
    """The photo, or the reason why it is none."""
    try:
        if path.stat().st_size == 0:
            return "the file is empty"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # broken EXIF is not a reason to refuse a photo
            with Image.open(path) as image:
                width, height = image.size
                if min(width, height) < MIN_PHOTO_SIDE:
                    return (
                        f"{width} x {height} pixels: sides under {MIN_PHOTO_SIDE} pixels are too small to use"
                    )
                if width * height > MAX_PHOTO_PIXELS:
                    limit = MAX_PHOTO_PIXELS // 10**6
                    return f"{width} x {height} pixels: more than the {limit} million that are decoded"
                width, height = upright_size(image)
                tags = exif.read(image)
                if image.format == "JPEG":
                    image.draft(None, (1, 1))  # the smallest DCT scale still reads the file to its end
                image.load()
    except UnidentifiedImageError:
        return (
            "not an image (or of a kind that is not read: JPEG, PNG, WebP, TIFF, HEIC, MP4, MOV and zip are)"
        )
    except Image.DecompressionBombError as error:
        return str(error)
    except (OSError, ValueError, SyntaxError, EOFError, IndexError) as error:
        return f"does not decode to its end: {error}"
    return Usable(name, path, _sha256(path), width, height, tags, sequence=sequence)


def _with_mask(photo: Usable, mask: Path | None, found: _Found) -> Usable:
    """The photo with its mask, where that is readable and has the photo's shape."""
    if mask is None:
        return photo
    try:
        with Image.open(mask) as image:
            width, height = upright_size(image)
    except (OSError, ValueError, SyntaxError) as error:
        found.notes.append(f"The mask of {photo.name} is not used: it does not open ({error}).")
        return photo
    if abs(width / height / (photo.width / photo.height) - 1.0) > 0.02:
        found.notes.append(
            f"The mask of {photo.name} is not used: it is {width} x {height}, the photo {photo.width} x {photo.height}."
        )
        return photo
    return replace(photo, mask=mask)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
