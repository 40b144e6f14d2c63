"""Finds the usable photos among the given files, unpacks zips and videos, and says why other files are left out."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from PIL import Image

from splatmill.data_sets import MAX_DEPTH, unread_cameras
from splatmill.schema.files.masks import masks_beside, paired, without_mask_folder
from splatmill.schema.files.other_pictures import beside_photos
from splatmill.schema.files.outputs import own_outputs
from splatmill.schema.files.photos import ARCHIVE_SUFFIXES, VIDEO_SUFFIXES, unread, unread_kind
from splatmill.schema.quantities import counted
from splatmill_worker.errors import Cancelled, CaptureIncomplete, UnusablePicture, UnusableVideo
from splatmill_worker.images import copies, exif, mask_levels, no_photo, transparency
from splatmill_worker.images.archives import archive, unpacked_room
from splatmill_worker.images.colors import photo_colors
from splatmill_worker.images.copies import SmallPicture
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.image_circle import Circle
from splatmill_worker.images.masks import masks_under, unfit
from splatmill_worker.images.overlays import overlays
from splatmill_worker.images.panoramas import panoramas
from splatmill_worker.scene import MIN_SHOWN, Overlay
from splatmill_worker.wording import plain

IGNORED_PREFIXES = (".", "__MACOSX")
"""Beginnings of the names of files and folders that are left out without mention."""

IGNORED_NAMES = ("thumbs.db", "desktop.ini")
"""Names, in lower case, of files that are left out without mention."""

MACHINE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO)
"""Errors of the operating system that say nothing about the file: they end the attempt."""

DEFAULT_FRAMES = 100
"""Frames taken from a video."""


@dataclass(frozen=True)
class UsablePhoto:
    """A photo that decodes.

    name: relative to the given folder; of photos in zips and videos, below the name of those.
    path: of the file.
    sha256: of the file's content.
    width, height: in pixels, with the EXIF orientation applied.
    exif: the tags that structure from motion uses.
    mask: path of the mask, if there is one.
    shown_from: level of the mask, 0 to 255, from which a pixel is shown.
    mask_sha256: of the mask's content, where it was read before; None: not known.
    sequence: name of the video that the photo is a frame of, if it is one.
    several: whether the file holds further pictures, which are not used.
    colors: how its colours become sRGB, as `PhotoColors.remark` says it.
    sphere: what says that it is a panorama.
    is_panorama: whether it is taken for one, which shows 360 by 180 degrees.
    circle: what a circular fisheye lens fills of it; None where it fills it all.
    alpha: its smallest and largest alpha.
    kind: what it seems to be, if no photo.
    """

    name: str
    path: Path
    sha256: str
    width: int
    height: int
    exif: exif.Exif
    mask: Path | None = None
    shown_from: int = MIN_SHOWN
    mask_sha256: str | None = None
    sequence: str | None = None
    several: bool = False
    colors: str = ""
    sphere: panoramas.Sphere = ""
    is_panorama: bool = False
    circle: Circle | None = None
    alpha: transparency.Extent = (255, 255)
    kind: no_photo.Kind = ""

    def hash_of_mask(self) -> str | None:
        """The SHA-256 of the mask's content; None without a mask."""
        return self.mask_sha256 if self.mask is None or self.mask_sha256 is not None else _sha256(self.mask)


@dataclass(frozen=True)
class Prepared:
    """The outcome of `prepare`.

    photos: sorted by name.
    skipped: (name, reason) of every file that is left out.
    notes: sentences for the user.
    warnings: sentences for the user about what is probably wrong, assumed or converted.
    overlays: what never moves in the photos of each camera, and is masked.
    """

    photos: tuple[UsablePhoto, ...]
    skipped: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    overlays: tuple[Overlay, ...] = ()

    @property
    def key(self) -> str:
        """A hash of the names and contents of all photos and masks."""
        digest = hashlib.sha256()
        for photo in self.photos:
            mask = "" if photo.mask is None else f"{photo.hash_of_mask()}{photo.shown_from}"
            kind = "\0panorama" if photo.is_panorama else ""
            digest.update(f"{photo.name}\0{photo.sha256}\0{mask}{kind}\n".encode())
        return digest.hexdigest()


@dataclass
class _Inventory:
    """Files found so far.

    files: name, path, and name of the video that the file is a frame of.
    opened: names of the zips and videos whose content is among the files.
    allowance: what further zips may unpack to.
    skipped, notes, warnings: as in `Prepared`.
    unfit_masks: name of each photo whose mask is not used, with what is wrong with the mask.
    """

    files: list[tuple[str, Path, str | None]] = field(default_factory=list)
    opened: set[str] = field(default_factory=set)
    allowance: archive.Allowance = field(default_factory=archive.Allowance)
    skipped: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    unfit_masks: list[tuple[str, str]] = field(default_factory=list)


def prepare(
    images: Path,
    masks: Path | None,
    workdir: Path,
    *,
    frames: int = DEFAULT_FRAMES,
    on_progress: Callable[[str, int, int, str], None] = lambda stage, done, total, note: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Prepared:
    """Examine the files under `images`.

    Zips are unpacked into `workdir`, and `frames` frames of each video are stored there. Files are skipped, each
    with its reason, when they are no image or do not decode completely, when their header gives too small or too large
    a size (they are then not decoded), and when they are copies of another photo (`images.copies`), of which the
    largest is kept. Of a file with several pictures, the first is used.

    masks: folder of the masks, if there is one; others may lie among the photos (`splatmill.schema.files.masks`).
    on_progress: called as ("images", files examined, files in all, name of the file), and while they are compared.

    Raises Refusal for a mask that is too large to be decoded, for masks that hide all of every photo, where no picture
    is a photo by its pixels (`images.no_photo`), and for archives
    and videos that together exceed `archive.Allowance`, CaptureIncomplete when a file is neither used nor skipped, and
    Cancelled.
    """
    inventory = _Inventory()
    paths = given_files(images)
    for path in paths:
        _expand(path.relative_to(images).as_posix(), path, None, workdir, frames, inventory, cancelled)
    outputs = own_outputs(name for name, _, _ in inventory.files)
    inventory.skipped += [(name, "it is a result of Splatmill, not a photo") for name in sorted(outputs)]
    inventory.files = [file for file in inventory.files if file[0] not in outputs]
    others = beside_photos(name for name, _, _ in inventory.files)
    inventory.skipped += [(name, f"it lies in a folder of {what}") for name, what in others.items()]
    inventory.files = [file for file in inventory.files if file[0] not in others]
    beside = {name: path for name, path, _ in inventory.files}
    own_masks = _own_masks(inventory)
    mask_files = {inner: beside[name] for name, inner in own_masks.items()}
    mask_files |= masks_under(masks) if masks is not None and masks.is_dir() else {}
    candidates = [file for file in inventory.files if file[0] not in own_masks]
    pairs = paired([name for name, _, _ in candidates], mask_files)
    photos: dict[str, UsablePhoto] = {}
    small: dict[str, SmallPicture] = {}
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        inspected = pool.map(lambda file: None if cancelled() else _inspect(*file), candidates)
        for done, ((name, _, _), inspection) in enumerate(zip(candidates, inspected, strict=True), 1):
            if inspection is None:
                raise Cancelled("Examining the photos was cancelled.")
            on_progress("images", done, len(candidates), name)
            if isinstance(inspection, str):
                inventory.skipped.append((name, inspection))
                continue
            result, small[name] = inspection
            try:
                result = _with_mask(result, mask_files.get(pairs.get(name, "")), inventory)
            except UnusablePicture as error:
                if error.code != "decoder_ended":
                    raise
                inventory.skipped.append((name, f"of its mask: {error.reason}"))
                continue
            if (same := photos.get(result.sha256)) is not None:
                # Programs call a copy "a (1).jpg" or "a copy.jpg".
                result, copy = sorted((same, result), key=lambda photo: (len(photo.name), photo.name))
                result = replace(result, mask=result.mask or copy.mask)
                inventory.skipped.append((copy.name, f"its content is the same as that of {result.name}"))
            photos[result.sha256] = result
    inventory.notes += [
        f"{photo.name} holds several pictures; the first one is used."
        for photo in photos.values()
        if photo.several
    ]
    if not photos and inventory.skipped and decoders.forget_ended():
        # The cause may lie outside of the photos, such as a lack of memory, which ends processes for any photo.
        name, reason = inventory.skipped[0]
        raise UnusablePicture("decoder_ended", name, f"no photo is left; of this one: {reason}")
    ordered = sorted(photos.values(), key=lambda photo: photo.name)
    no_photo.check({photo.name: photo.kind for photo in ordered})
    ordered = _without_depth(ordered, inventory)

    def compared(done: int) -> None:
        if cancelled():
            raise Cancelled("Examining the photos was cancelled.")
        note = f"compared {done} of {len(ordered)} with the others"
        on_progress("images", len(candidates), len(candidates), note)

    originals = copies.copies([small[photo.name] for photo in ordered], compared)
    copied = [(ordered[copy].name, ordered[original].name) for copy, original in originals.items()]
    ordered = _without_copies(ordered, originals, inventory)
    known = (
        {photo.name for photo in ordered}
        | {name for name, _ in inventory.skipped}
        | own_masks.keys()
        | inventory.opened
    )
    lost = [name for path in paths if (name := path.relative_to(images).as_posix()) not in known]
    if lost:
        raise CaptureIncomplete(f"{images.name}/", lost, len(paths))
    unused = mask_files.keys() - pairs.values()
    judged = mask_levels.judged({photo.name: photo.mask for photo in ordered}, unused)
    are_panoramas, assumed = panoramas.decided(
        [
            panoramas.Candidate(
                each.name, each.width, each.height, _source(each), each.sequence is not None, each.sphere
            )
            for each in ordered
        ]
    )
    inventory.warnings += assumed
    ordered = [
        replace(photo, shown_from=judged.shown_from, is_panorama=is_panorama)
        for photo, is_panorama in zip(ordered, are_panoramas, strict=True)
    ]
    inventory.warnings += photo_colors.sentences([photo.colors for photo in ordered])
    skipped = [name for name, _ in inventory.skipped]
    warnings = [*judged.warnings, *unfit(inventory.unfit_masks), *unread(skipped), *unread_cameras(skipped)]
    hidden = overlays.hidden_in(
        [overlays.Candidate(each.name, each.width, each.height, _source(each)) for each in ordered],
        lambda index, size: _picture(ordered[index], small, size),
    )
    ordered = [
        photo
        if mask is None
        else replace(
            photo,
            mask=overlays.mask_file(mask, photo.mask, workdir, shown_from=photo.shown_from),
            shown_from=MIN_SHOWN,
            circle=circle,
        )
        for photo, mask, circle in zip(ordered, hidden.regions, hidden.circles, strict=True)
    ]
    inventory.warnings += [*copies.warning(copied), *hidden.warnings]
    inventory.warnings += transparency.remarks({photo.name: photo.alpha for photo in ordered})
    return Prepared(
        tuple(ordered),
        tuple(inventory.skipped),
        (*inventory.notes, *judged.notes),
        (*inventory.warnings, *warnings),
        hidden.shown,
    )


def _source(photo: UsablePhoto) -> str:
    """The video or folder that a photo is from."""
    return photo.sequence or PurePosixPath(photo.name).parent.as_posix()


def given_files(images: Path) -> list[Path]:
    """What lies under `images` and is no folder, sorted by name; hidden files are left out."""
    if not images.is_dir():
        return []
    return [
        path
        for path in sorted(images.rglob("*"))
        if (path.is_symlink() or not path.is_dir())
        and path.name.lower() not in IGNORED_NAMES
        and not any(part.startswith(IGNORED_PREFIXES) for part in path.relative_to(images).parts)
    ]


def _without_copies(
    photos: list[UsablePhoto], originals: dict[int, int], inventory: _Inventory
) -> list[UsablePhoto]:
    """The photos without those that `copies` names; an original without a mask gets that of a copy of its shape."""
    kept = dict(enumerate(photos))
    for copy, original in originals.items():
        mask = kept.pop(copy).mask
        if mask is not None and kept[original].mask is None:
            kept[original] = _with_mask(kept[original], mask, inventory)
        inventory.skipped.append((photos[copy].name, f"it shows the same as {photos[original].name}"))
    return list(kept.values())


def _without_depth(photos: list[UsablePhoto], inventory: _Inventory) -> list[UsablePhoto]:
    """The photos without pictures of a single channel of 16 bits, where others have colours of 8 bits."""
    kept = [photo for photo in photos if photo.kind != "depth maps"]
    skipped = [photo for photo in photos if photo.kind == "depth maps"]
    inventory.skipped += [
        (photo.name, "it has a single channel of 16 bits, as depth maps have, which other photos have not")
        for photo in skipped
    ]
    return kept


def _picture(photo: UsablePhoto, small: dict[str, SmallPicture], at_least: tuple[int, int]) -> Image.Image:
    """The photo at least so large; the small picture, which has no transparency, where that suffices."""
    if max(at_least) <= copies.SMALL_SIDE and photo.alpha[0] >= transparency.SOLID:
        return Image.fromarray(small[photo.name].grey)
    return decoders.decode(photo.path, at_least=at_least)


def _own_masks(inventory: _Inventory) -> dict[str, str]:
    """The masks among the photos, each with its name without the folder of masks.

    Where all pictures lie in such folders, they are photos.
    """
    pictures = [name for name, _, video in inventory.files if video is None]
    masks = {name: inner for name in pictures if (inner := without_mask_folder(name)) is not None}
    photos = [name for name in pictures if name not in masks]
    if not photos:
        return {}
    return masks | {name: name for name in masks_beside(photos)}


def _expand(
    name: str,
    path: Path,
    inside: str | None,
    workdir: Path,
    frames: int,
    inventory: _Inventory,
    cancelled: Callable[[], bool],
) -> None:
    """Add a file, or the content of a zip or video, to `inventory`.

    inside: name of the zip that holds the file, if there is one.

    What is unpacked is kept in `workdir`, in a folder named by the hash of the zip or video.
    """
    suffix = path.suffix.lower()
    try:
        if path.is_symlink() or not path.is_file():
            inventory.skipped.append((name, "it is a link or a device, not a file"))
        elif suffix in ARCHIVE_SUFFIXES and inside is None:
            folder = unpacked(name, path, workdir, inventory.allowance, cancelled)
            for inner in given_files(folder):
                inner_name = f"{Path(name).with_suffix('').as_posix()}/{inner.relative_to(folder).as_posix()}"
                _expand(inner_name, inner, name, workdir, frames, inventory, cancelled)
            inventory.opened.add(name)
            inventory.warnings += names_remark(folder)
        elif suffix in ARCHIVE_SUFFIXES:
            inventory.skipped.append((name, "a zip inside a zip is not unpacked; give its photos themselves"))
        elif suffix in VIDEO_SUFFIXES:
            folder = filled_once(
                workdir / "frames" / f"{_sha256(path)[:24]}_{frames}",
                lambda place: decoders.keyframes(path, place, frames, cancelled=cancelled),
            )
            pictures = given_files(folder)
            size = _bytes_of(pictures)
            unpacked_room.take(folder.name, size, may_refuse=False)
            inventory.allowance.take(name, 0, size)
            prefix = Path(name).with_suffix("").as_posix()
            inventory.files += [(f"{prefix}_{p.stem.rpartition('_')[2]}.jpg", p, name) for p in pictures]
            inventory.opened.add(name)
            taken = counted(len(pictures), "frame was", "frames were")
            inventory.notes.append(f"{taken} taken from the video {name}.")
            inventory.warnings += [remark.format(name) for remark in decoders.video_remarks(path)]
        elif (kind := unread_kind(name)) is not None:
            # Pillow would read the small preview in a raw photo.
            inventory.skipped.append((name, f"{kind.what} are not read"))
        else:
            inventory.files.append((name, path, None))
    except UnusableVideo as error:
        inventory.skipped.append((name, error.reason))
    except ValueError as error:
        inventory.skipped.append((name, str(error)))
    except OSError as error:
        if error.errno in MACHINE_ERRORS:
            raise
        inventory.skipped.append((name, f"it cannot be read: {plain(error)}"))


def unpacked(
    name: str, path: Path, workdir: Path, allowance: archive.Allowance, cancelled: Callable[[], bool]
) -> Path:
    """The folder in `workdir` with the content of the zip at `path`, unpacked if no earlier attempt has done so.

    allowance: what the capture's zips may still unpack to; this one is subtracted.

    Raises what `archive.unpack` raises.
    """
    folder = workdir / "unpacked" / _sha256(path)[:24]
    if folder.is_dir():
        files = given_files(folder)
        allowance.take(name, len(files), _bytes_of(files))
        unpacked_room.take(folder.name, _bytes_of(files))
    return filled_once(folder, lambda place: archive.unpack(path, place, cancelled, allowance))


def names_remark(folder: Path) -> list[str]:
    """A sentence for the user about how the names of an unpacked zip were read, in which `folder` lies; none where they
    leave no doubt."""
    places = (place / archive.REMARK for place in (folder, *folder.parents[:MAX_DEPTH]))
    return [place.read_text("utf-8") for place in places if place.is_file()][:1]


def _bytes_of(files: list[Path]) -> int:
    return sum(path.stat().st_size for path in files)


def filled_once(folder: Path, make: Callable[[Path], object]) -> Path:
    """Return `folder` as filled by `make`, which is called when it does not exist yet.

    `make` fills a folder with another name, which is renamed when it is complete.
    """
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


def _inspect(name: str, path: Path, sequence: str | None) -> tuple[UsablePhoto, SmallPicture] | str:
    """The photo, also at low resolution, or the reason why the file is left out."""
    try:
        picture = decoders.examine(path, name)
        digest = _sha256(path)
    except OSError as error:
        if error.errno in MACHINE_ERRORS:
            raise
        return f"it cannot be read: {error.strerror}"
    if isinstance(picture, str):
        return picture
    if transparency.is_clear(picture.alpha):
        return transparency.NOTHING
    photo = UsablePhoto(
        name,
        path,
        digest,
        picture.width,
        picture.height,
        picture.exif,
        sequence=sequence,
        several=picture.several,
        colors=picture.colors,
        sphere=picture.sphere,
        alpha=picture.alpha,
        kind=picture.kind,
    )
    has_tags = picture.exif.make is not None or picture.exif.model is not None
    return photo, SmallPicture(name, picture.width, picture.height, picture.small, has_tags)


def _with_mask(photo: UsablePhoto, mask: Path | None, inventory: _Inventory) -> UsablePhoto:
    """The photo with `mask`, or without it when it is unreadable or has another shape."""
    if mask is None:
        return photo
    fault = decoders.mask_fault(mask, (photo.width, photo.height))
    if fault is not None:
        inventory.unfit_masks.append((photo.name, fault))
        return photo
    return replace(photo, mask=mask)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
