"""The files of a capture at a local path: photos, masks, poses, a video or a zip archive."""

import json
import os
import unicodedata
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatmill.data_sets import (
    Cameras,
    TwoDataSets,
    camera_files,
    find_cameras,
    holds_media,
    is_camera_file,
    named_by_job,
    not_used_in_zip,
    place_of_model,
    unread_cameras,
    unreadable_file,
    walk,
)
from splatmill.errors import NothingToUpload
from splatmill.schema.files.masks import masks_beside, without_mask_folder
from splatmill.schema.files.names import UnsafeName, readings, safe_name, storable_name
from splatmill.schema.files.other_pictures import (
    MEASURED,
    NO_PHOTOS,
    beside_photos,
    kind_of_folder,
    no_photos,
)
from splatmill.schema.files.other_pictures import remarks as other_remarks
from splatmill.schema.files.outputs import own_outputs
from splatmill.schema.files.photos import ARCHIVE_SUFFIXES, PHOTO_SUFFIXES, VIDEO_SUFFIXES, unread
from splatmill.schema.quantities import counted, listed
from splatmill.schema.resources.captures import Role

MODEL_SUFFIXES = frozenset({".bin", ".txt"})
MODEL_STEMS = frozenset({"cameras", "images", "points3d", "rigs", "frames"})  # in lower case


MOST_NAMED = 10
"""Files that a sentence names, at most."""


@dataclass(frozen=True)
class LocalFile:
    """A file to upload.

    role: its purpose in the capture.
    name: its name in the capture.
    path: where it is on this machine.
    size: in bytes.
    """

    role: Role
    name: str
    path: Path
    size: int


@dataclass(frozen=True)
class CaptureFiles:
    """The files of a capture.

    ignored: relative names of the files that are not used.
    top: the folder of the data set, with a slash at its end, where it is not the given one.
    renamed: relative names of the files that are stored under other names, each with its name in the capture.
    left_out: relative names of the files that no name can be made for, each with the reason.
    outputs: relative names of pictures, videos, zips and cameras that are results of Splatmill.
    remarks: sentences about files that hold photos or cameras and are not read.
    """

    files: tuple[LocalFile, ...]
    ignored: tuple[str, ...] = ()
    top: str = ""
    renamed: tuple[tuple[str, str], ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    outputs: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @staticmethod
    def of(files: Iterable[LocalFile], ignored: Iterable[str] = ()) -> "CaptureFiles":
        """Return the files under names that the service accepts: one bad name keeps no other file from being used."""
        stored: list[LocalFile] = []
        renamed: list[tuple[str, str]] = []
        left_out: list[tuple[str, str]] = []
        for file in files:
            try:
                name = storable_name(file.name)
            except UnsafeName as error:
                left_out.append((file.name, str(error)))
                continue
            if name != unicodedata.normalize("NFC", file.name):
                renamed.append((file.name, name))
            stored.append(replace(file, name=name))
        return CaptureFiles(tuple(stored), tuple(ignored), renamed=tuple(renamed), left_out=tuple(left_out))

    def count(self, role: Role) -> int:
        """Return the number of files with this role."""
        return sum(file.role is role for file in self.files)

    def contents(self) -> list[str]:
        """Return what the files are, each kind with its number."""
        images = [_suffix(file.name) for file in self.files if file.role is Role.images]
        videos = sum(suffix in VIDEO_SUFFIXES for suffix in images)
        archives = sum(suffix in ARCHIVE_SUFFIXES for suffix in images)
        maps = sum(file.role is Role.poses and _is_image(file.name) for file in self.files)
        kinds = {
            "photo": len(images) - videos - archives,
            "video": videos,
            "zip archive": archives,
            "mask": self.count(Role.masks),
            "depth or confidence map": maps,
            "pose file": self.count(Role.poses) - maps,
        }
        return [counted(number, kind) for kind, number in kinds.items() if number]

    @property
    def is_one_photo(self) -> bool:
        """Whether the files are a single photo without cameras."""
        return self.contents() == ["1 photo"]

    def refuse_one_photo(self) -> None:
        """Raise NothingToUpload where all there is to train on is one photo."""
        if self.is_one_photo:
            raise NothingToUpload(
                f"{printable(self.files[0].name)} is one photo; depth cannot be recovered from a single photo.",
                "Give a folder with 20 or more photos from different places, a video, or a zip archive.",
            )

    @property
    def bytes(self) -> int:
        """The total size of the files in bytes."""
        return sum(file.size for file in self.files)


def find_files(path: str | os.PathLike[str]) -> CaptureFiles:
    """Find the files of the capture at `path`: a photo, a video, a zip archive, a folder of photos, a posed data set or
    a part of one (`_around`).

    In a folder, the photos are those under `images/`, named relative to it. Without `images/`, or where transforms
    files name photos beside it, they are all photos in the folder, named relative to it, so that `train/r_0.png` keeps
    its name in `transforms_train.json`. Masks lie in a folder such as `masks/`, beside their photos
    (`splatmill.schema.files.masks`), or where frames name them; poses are `transforms*.json`, the `.ply` files of
    points that they name, and COLMAP models. All of this may lie some folders down: see `data_sets.find_cameras`.
    Hidden files and folders are ignored. Videos and zip archives are used only where there are no photos; a zip of
    cameras alone goes along with photos that have none. Pictures in a folder of results are no photos
    (`splatmill.schema.files.outputs`), and neither are those in a folder of normal maps, for example, if no cameras are
    given (`splatmill.schema.files.other_pictures`). Depth maps and maps of confidence are poses.

    A file whose name the service does not accept gets another one, or is left out. What is no regular file, or cannot
    be read, is left out too (`data_sets.walk`).

    Raises NothingToUpload where the path does not exist, cannot be read, holds none of these, or is a folder of masks
    or the like itself.
    """
    root = Path(path).expanduser()
    if not root.is_dir() and (reason := unreadable_file(root)) is not None:
        lacking = "does not exist" if not os.path.lexists(root) else reason.removeprefix("it ")
        raise NothingToUpload(f"{root} {lacking}.", "Give a folder of photos, a zip archive or a video.")
    root, around = _around(root)
    if root.is_file():
        return _single(root)
    unreadable: dict[str, str] = {}
    try:
        names = walk(root, unreadable)
        outputs = own_outputs(names)
        names = [name for name in names if name not in outputs]
        cameras = find_cameras(names) or Cameras("")
    except OSError as error:
        raise NothingToUpload(f"{error.filename} cannot be read: {error.strerror}.") from error
    except TwoDataSets as error:
        raise NothingToUpload(f"{root} cannot be read as one capture. {error}") from error

    # Cameras in a folder without photos are those of the photos around it.
    top = cameras.top if any(name.startswith(cameras.top) and _is_image(name) for name in names) else ""
    photo_root = f"{top}images/"
    if not any(name.startswith(photo_root) and _is_image(name) for name in names):
        photo_root = top
    documents = _documents(root, cameras)
    pictures = [name for name in names if name.startswith(top) and _is_image(name)]
    if _has_photos_beside(_named(documents, "file_path", cameras.top).intersection(pictures), photo_root):
        photo_root = top
    masks = _masks(pictures, top, photo_root)
    for name in _named(documents, "mask_path", cameras.top).intersection(pictures).difference(masks):
        masks[name] = name.removeprefix(photo_root if name.startswith(photo_root) else top)
    poses = _poses(cameras, names)
    others: dict[str, str] = {}
    maps = _maps(pictures, names, documents, cameras.top)
    if not poses:
        inside = [name for name in pictures if name.startswith(photo_root) and name not in maps]
        said = no_photos(inside)
        if not photo_root and not any(map(kind_of_folder, inside)):
            said = no_photos([f"{root.resolve().name}/{name}" for name in inside])
        if said:
            raise NothingToUpload(said)
        others = beside_photos(inside)
    photos = any(name not in maps for name in pictures)
    zipped = _cameras_in_zips(root, names) if photos else {}
    along = set() if poses else {name for name, (_, has_photos) in zipped.items() if not has_photos}
    points = _named(documents, "ply_file_path", cameras.top).intersection(names)
    poses |= {name: name.removeprefix(cameras.top) for name in points if _suffix(name) == ".ply"}
    posed = bool(poses or (photos and cameras.programs))
    if photos:
        poses |= {name: name for name in (*cameras.programs, *named_by_job(names))}
    files: list[LocalFile] = []
    ignored: list[str] = []
    for name in names:
        if name in poses:
            files.append(_local(Role.poses, poses[name], root / name))
            continue
        try:
            if name in masks:
                files.append(_local(Role.masks, masks[name], root / name))
            elif name in maps:
                files.append(_local(Role.poses, name.removeprefix(top), root / name))
            elif name.startswith(photo_root) and _is_image(name) and name not in others:
                files.append(_local(Role.images, name.removeprefix(photo_root), root / name))
            elif name in along:
                files.append(_local(Role.images, name, root / name))
            else:
                ignored.append(name)
        except NothingToUpload as error:  # it was deleted since it was listed
            unreadable[name] = str(error)
    if not any(file.role is Role.images for file in files):
        whole = [name for name in ignored if _suffix(name) in VIDEO_SUFFIXES + ARCHIVE_SUFFIXES]
        files += [_local(Role.images, name, root / name) for name in whole]
        ignored = [name for name in ignored if name not in whole]
        if not whole:
            kinds = ", ".join(sorted(suffix.removeprefix(".") for suffix in PHOTO_SUFFIXES))
            raise NothingToUpload(
                f"{root} contains no photos, no video and no zip archive.",
                " ".join(
                    [
                        *_results(outputs),
                        *_left_out(unreadable),
                        *(unread(ignored) or [f"Photos are {kinds} files."]),
                    ]
                ),
            )
    capture_files = CaptureFiles.of(files, ignored)
    if not capture_files.count(Role.images):
        raise NothingToUpload(capture_files.left_out[0][1], "Rename the files.")
    remarks = around + _left_out(unreadable) + unread(ignored) + ([] if posed else unread_cameras(names))
    beside = [name for name in ignored if _suffix(name) in VIDEO_SUFFIXES + ARCHIVE_SUFFIXES]
    if cameras.programs and not photos:
        remarks.append(
            f"Cameras are read where photos have the names in them; beside a video or a zip these files are not used: "
            f"{listed(cameras.programs)}."
        )
    if beside:
        remarks.append(f"Videos and zips are not used where there are photos: {listed(beside)}.")
    remarks += [
        not_used_in_zip(name, first, posed=not has_photos)
        for name, (first, has_photos) in zipped.items()
        if name not in along
    ]
    remarks += other_remarks(others) + _cameras_beside(root, cameras)
    return replace(capture_files, top=cameras.top, outputs=tuple(sorted(outputs)), remarks=tuple(remarks))


def _cameras_in_zips(root: Path, names: Iterable[str]) -> dict[str, tuple[str, bool]]:
    """For each zip with files of cameras, the first of these, and whether the zip has photos or videos too.

    A zip whose list of files cannot be read is left out: it is named with those that are not used.
    """
    zips: dict[str, tuple[str, bool]] = {}
    for name in names:
        if _suffix(name) not in ARCHIVE_SUFFIXES:
            continue
        try:
            with zipfile.ZipFile(root / name) as archive:
                entries = [each.replace("\\", "/") for each in archive.namelist()]
        except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
            continue
        inside = sorted(each for each in entries if not each.endswith("/") and not _is_hidden(each))
        if cameras := camera_files(inside):
            zips[name] = cameras[0], holds_media(inside)
    return zips


def _is_hidden(name: str) -> bool:
    return any(part.startswith((".", "__MACOSX")) for part in name.split("/"))


def _results(outputs: Iterable[str]) -> list[str]:
    """A sentence about results of Splatmill, which are not read; none where there are none."""
    named = sorted(outputs)
    return [f"Results of an earlier training are not read: {listed(named)}."] if named else []


def _left_out(unreadable: Mapping[str, str]) -> list[str]:
    """A sentence about files that are not read; none where there are none."""
    if not unreadable:
        return []
    shown = "; ".join(f"{name}: {reason}" for name, reason in sorted(unreadable.items())[:MOST_NAMED])
    more = f"; and {len(unreadable) - MOST_NAMED} more" if len(unreadable) > MOST_NAMED else ""
    return [f"Left out are {shown}{more}."]


def _around(path: Path) -> tuple[Path, list[str]]:
    """Return the data set around a file of cameras or a folder of COLMAP models, and a remark; else the path itself.

    The folder around counts only if it has photos in it, or in its folder `images`; a folder with photos of its own is
    given as it is.
    """
    try:
        if path.is_file():
            if not is_camera_file(path.name):
                return path, []
            folder = path.parent.resolve()
        else:
            names = walk(path)
            if any(map(_is_image, names)) or not any(
                is_camera_file(name.rpartition("/")[2]) for name in names
            ):
                return path, []
            folder = path.resolve()
        for top in (folder, Path("/", place_of_model(f"{folder.as_posix()}/".lstrip("/")))):
            inside = [
                top,
                *(each for each in top.iterdir() if each.name.lower() == "images" and each.is_dir()),
            ]
            if top != path.resolve() and any(_is_image(name) for each in inside for name in os.listdir(each)):
                own = path.resolve().relative_to(top).as_posix()
                return top, [f"{own} is a part of a data set. The folder around it is taken: {top}."]
    except OSError:
        pass  # whoever reads the path says so
    return path, []


def _cameras_beside(root: Path, cameras: Cameras) -> list[str]:
    """Return a remark about cameras beside a folder `images` that has none of its own."""
    if cameras.transforms or cameras.models or root.resolve().name.lower() != "images":
        return []
    above = root.resolve().parent
    try:
        beside = [
            name for name in sorted(os.listdir(above)) if name.lower() == "sparse" or is_camera_file(name)
        ]
    except OSError:
        return []
    return [f"Cameras lie beside this folder: {listed(beside)}. To use them, give {above}."] if beside else []


def printable(name: str) -> str:
    """Return a file name as text that every terminal and JSON take: bytes that are not UTF-8 become escapes."""
    return name.encode("utf-8", "backslashreplace").decode()


def start_model(path: Path) -> LocalFile:
    """Return the file to start from as one of the capture; its role is poses, whose coordinates it shares.

    Raises NothingToUpload where there is no such file, or where the service does not accept its name.
    """
    if not path.is_file():
        lacking = "is not a file" if path.exists() else "does not exist"
        raise NothingToUpload(
            f"The file {path} to start from {lacking}.",
            "Give the path of a file of a model or of points, or the id of a model.",
        )
    try:
        return _local(Role.poses, safe_name(path.name), path)
    except UnsafeName as error:
        raise NothingToUpload(str(error)) from error


def _single(path: Path) -> CaptureFiles:
    if _suffix(path.name) not in PHOTO_SUFFIXES + VIDEO_SUFFIXES + ARCHIVE_SUFFIXES:
        raise NothingToUpload(
            f"{path.name} is neither a photo, nor a video, nor a zip archive.",
            " ".join(unread([path.name]) or ["Give a folder of photos, a zip archive or a video."]),
        )
    return CaptureFiles.of([_local(Role.images, path.name, path)])


def _has_photos_beside(named: Iterable[str], photo_root: str) -> bool:
    """Whether cameras name photos outside the folder `images`, other than these in another size (`images_4`)."""
    reduced = photo_root.rstrip("/") + "_"
    return any(
        not name.startswith(photo_root)
        and not (name.startswith(reduced) and name.removeprefix(reduced).split("/")[0].isdecimal())
        for name in named
    )


def _masks(pictures: list[str], top: str, photo_root: str) -> dict[str, str]:
    """Return the local name of each mask, with its name in the capture. All pictures are under `top`."""
    # A folder around the data set may be called masks too.
    inner = {name: without_mask_folder(name.removeprefix(top)) for name in pictures}
    masks = {name: f"{top}{rest}" for name, rest in inner.items() if rest is not None}
    photos = [name for name in pictures if name.startswith(photo_root) and name not in masks]
    if not photos:
        return {}
    masks |= {name: name for name in masks_beside(photos)}
    return {
        name: whole.removeprefix(photo_root if whole.startswith(photo_root) else top)
        for name, whole in masks.items()
    }


def _maps(
    pictures: list[str], names: list[str], documents: Iterable[Mapping[str, Any]], top: str
) -> frozenset[str]:
    """Return the local names of the depth maps and the maps of confidence beside photos or a video; none without them.

    They lie in folders of such names, or frames name them. What frames name as a photo is none.
    """
    maps = {name for name in pictures if kind_of_folder(name.removeprefix(top)) in MEASURED}
    for key in ("depth_file_path", "depth_path"):
        maps |= _named(documents, key, top).intersection(pictures)
    maps -= _named(documents, "file_path", top)
    media = any(_suffix(name) in VIDEO_SUFFIXES for name in names)
    photos = [name for name in pictures if name not in maps]
    beside = any(kind_of_folder(name.removeprefix(top)) not in (*NO_PHOTOS, "masks") for name in photos)
    return frozenset(maps if media or beside else ())


def _poses(cameras: Cameras, names: list[str]) -> dict[str, str]:
    """Return the local name of each pose file, with its name in the capture: that in the data set."""
    poses = {name: name.removeprefix(cameras.top) for name in cameras.transforms}
    for folder in cameras.models:
        for name in names:
            stem, suffix = os.path.splitext(name.removeprefix(folder).lower())
            if name.startswith(folder) and stem in MODEL_STEMS and suffix in MODEL_SUFFIXES:
                poses[name] = name.removeprefix(cameras.top)
    return poses


def _documents(root: Path, cameras: Cameras) -> list[dict[str, Any]]:
    """The transforms files. One that cannot be read is left out here; the worker says what is wrong with it.

    Of one in another encoding than Unicode's, the names in ASCII are read.
    """
    documents = []
    for name in cameras.transforms:
        try:
            text = (root / name).read_bytes()
            document = json.loads(text.decode(json.detect_encoding(text), "replace"))
        except (OSError, ValueError, RecursionError):
            continue
        if isinstance(document, dict):
            documents.append(document)
    return documents


def _named(documents: Iterable[Mapping[str, Any]], key: str, top: str) -> set[str]:
    """The paths that the names under `key` in transforms files or their frames may stand for."""
    entries: list[Any] = []
    for document in documents:
        frames = document.get("frames")
        entries += [document, *(frames if isinstance(frames, list) else [])]
    named = [entry[key] for entry in entries if isinstance(entry, dict) and isinstance(entry.get(key), str)]
    return {top + path for name in named for path in readings(name)}


def _local(role: Role, name: str, path: Path) -> LocalFile:
    try:
        return LocalFile(role, name, path, path.stat().st_size)
    except OSError as error:
        raise NothingToUpload(f"{path} cannot be read: {error.strerror}.") from error


def _is_image(name: str) -> bool:
    return _suffix(name) in PHOTO_SUFFIXES


def _suffix(name: str) -> str:
    return os.path.splitext(name)[1].lower()
