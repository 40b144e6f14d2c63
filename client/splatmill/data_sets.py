"""Where a data set has its cameras: transforms.json files and COLMAP models among the names of files.

The rule is one for a local folder, an unpacked zip and the folder of a capture. The page has the same one
(server/splatmill_server/web/page/new/kinds.js); a test compares the two.
"""

import os
import re
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from splatmill.schema.files.photos import ARCHIVE_SUFFIXES, PHOTO_SUFFIXES, VIDEO_SUFFIXES

MAX_DEPTH = 4
"""Folders around a data set that are looked into: zips and programs often put it into folders of their own."""

PLACES = ("sparse/[N/]", "colmap/sparse/[N/]", "N/")
"""Folders of a data set in which tools put COLMAP models, in order of preference; the data set's own is the last. N is
a number, and brackets enclose what may be missing."""

_PATTERNS = tuple(
    re.compile(
        r"(?:^|(?<=/))" + place.replace("[N/]", r"(?:\d+/)?").replace("N/", r"\d+/") + r"\Z",
        re.IGNORECASE | re.ASCII,
    )
    for place in PLACES
)

MODEL_FILES = ("cameras.bin", "cameras.txt")
"""Names, in lower case, of the files by which a COLMAP model is found."""

MODEL_PARTS = (*MODEL_FILES, "images.bin", "images.txt")
"""Names, in lower case, of the files that a COLMAP model must have, of one suffix."""

TRANSFORMS = "transforms*.json"
"""Pattern of the names, in lower case, of files with cameras of nerfstudio and others."""

KEYFRAMES = ("keyframes/corrected_cameras/", "keyframes/cameras/")
"""Folders in which the raw data of Polycam have a .json file with the camera of each photo, in order of preference."""

PROGRAM_FILES = {
    "Metashape": ("*.xml",),
    "RealityScan, RealityCapture (also for Postshot)": ("*.csv", "*.xmp"),
    "OpenSfM, OpenDroneMap": ("reconstruction.json",),
    "Bundler": ("*.out",),
    "VisualSFM": ("*.nvm",),
    "3D Gaussian Splatting (Inria's, and trainers like it)": ("cameras.json",),
    "Record3D": ("metadata.json", "metadata"),
}
"""Other programs whose cameras are read, with patterns of the names, in lower case, of their files.

Other files have such names too: the worker recognises those with cameras by what is in them."""

LISTS = ("*list*.txt", "*.lst")
"""Patterns of the names, in lower case, of the lists of photos that belong to cameras of Bundler."""

CAMERA_PROGRAMS = {
    "COLMAP, GLOMAP, and programs that export a COLMAP model": MODEL_FILES,
    "nerfstudio, instant-ngp, Blender (NeRF synthetic)": (TRANSFORMS,),
    "Polycam (raw data)": tuple(f"{folder}*.json" for folder in KEYFRAMES),
    **PROGRAM_FILES,
}
"""Programs whose cameras are read, with patterns of the names, in lower case, of their files."""

OTHER_CAMERAS = {
    "OpenDroneMap": ("shots.geojson",),
    "Metashape (its project)": ("*.psx", "*.psz"),
    "OpenMVG": ("sfm_data.json", "sfm_data.bin"),
    "Meshroom": ("*.sfm",),
    "Bundler (with another lens)": ("*.rd",),
    "KRT, as of Middlebury": ("*_par.txt", "*.krt"),
    "OpenMVS": ("*.mvs",),
    "LLFF": ("poses_bounds.npy",),
    "RealityScan, RealityCapture (their project)": ("*.rsproj", "*.rcproj"),
    "Pix4D": ("*_calibrated_*.txt", "*.p4d"),
    "MVSNet": ("*_cam.txt",),
    "7-Scenes": ("*.pose.txt",),
    "TUM RGB-D": ("groundtruth.txt",),
    "Replica": ("traj.txt",),
    "NeuS, DTU": ("cameras.npz", "cameras_sphere.npz"),
    "NSVF, SRN, ScanNet": ("pose/*.txt", "intrinsics.txt"),
    "Nerfies, HyperNeRF": ("camera/*.json",),
    "ARKitScenes": ("*.traj", "*.pincam"),
    "Stray Scanner": ("odometry.csv",),
    "3D Scanner App": ("frame_*.json",),
    "Tanks and Temples, Open3D": ("*_sfm.log", "trajectory.log"),
    "KITTI": ("poses.txt",),
}
"""Programs whose cameras are not read, with patterns of the names, in lower case, of their files; some have a folder.

A file that has cameras only beside others, as `intrinsics.txt`, stands for these."""

LARGE = ("*.mvs",)
"""Patterns of OTHER_CAMERAS whose files hold points or photos too, so that they are not sent to be named by the job."""


class TwoDataSets(ValueError):
    """Cameras of several data sets were found, and nothing says which is meant. The message names two."""


@dataclass(frozen=True)
class Cameras:
    """The files of cameras of one data set.

    top: the folder of the data set, with a slash at its end; empty where it is the folder itself.
    transforms: names of the transforms*.json files in it, or else of the files in one of its KEYFRAMES.
    models: its folders with a COLMAP model, each with a slash at its end, in order of their numbers. They are
        alternatives: COLMAP writes a model for each set of photos that it could not join with the others.
    programs: names of the files that may have cameras of PROGRAM_FILES, and of LISTS that belong to them. They are
        those of photos in any folder, so that they have no data set of their own.
    """

    top: str
    transforms: tuple[str, ...] = ()
    models: tuple[str, ...] = ()
    programs: tuple[str, ...] = ()


def walk(root: Path, left_out: dict[str, str] | None = None) -> list[str]:
    """The relative names of all files under `root` except hidden ones, sorted.

    What is no regular file, or cannot be read, is left out: opening a FIFO would wait for ever. Links are followed,
    because data sets share photos through them; a folder is read once, where it lies rather than where a link leads to
    it.

    left_out: filled with the names of what is left out, and the reasons.

    Raises OSError where `root` itself cannot be read.
    """
    omitted = {} if left_out is None else left_out

    def fail(error: OSError) -> None:
        if Path(error.filename) == root:
            raise error
        omitted[Path(error.filename).relative_to(root).as_posix()] = f"it cannot be read: {error.strerror}"

    names: list[str] = []
    visited: set[tuple[int, int]] = set()
    begins = [str(root)]
    for begin in begins:
        for folder, subfolders, files in os.walk(begin, onerror=fail):
            try:
                here = os.stat(folder)
            except OSError as error:
                fail(error)
                subfolders.clear()
                continue
            if (here.st_dev, here.st_ino) in visited:
                subfolders.clear()
                continue
            visited.add((here.st_dev, here.st_ino))
            subfolders[:] = sorted(name for name in subfolders if not name.startswith((".", "__MACOSX")))
            begins += [path for name in subfolders if os.path.islink(path := os.path.join(folder, name))]
            inside = Path(folder).relative_to(root)
            for file in files:
                if file.startswith("."):
                    continue
                name = (inside / file).as_posix()
                if (reason := unreadable_file(os.path.join(folder, file))) is None:
                    names.append(name)
                else:
                    omitted[name] = reason
    return sorted(names)


def unreadable_file(path: str | os.PathLike[str]) -> str | None:
    """Why a file is not read; None for a regular file that may be read."""
    try:
        mode = os.stat(path).st_mode
    except OSError as error:
        return "it is a link to nothing" if os.path.islink(path) else f"it cannot be read: {error.strerror}"
    if not stat.S_ISREG(mode):
        return "it is a device, a socket or a pipe, not a file"
    return None if os.access(path, os.R_OK) else "it cannot be read: Permission denied"


def find_cameras(names: Sequence[str]) -> Cameras | None:
    """The cameras among files with these relative names: those of the outermost data set; None without any.

    Raises TwoDataSets where several data sets lie side by side.
    """
    transforms: dict[str, list[str]] = {}
    captured: dict[str, dict[int, list[str]]] = {}
    models: dict[str, list[tuple[int, str]]] = {}
    lower = {name.lower() for name in names}
    for name in names:
        folder, base = _split(name)
        base = base.lower()
        if fnmatchcase(base, TRANSFORMS):
            transforms.setdefault(folder, []).append(name)
        elif base.endswith(".json") and (place := keyframes(folder)) is not None:
            captured.setdefault(place[0], {}).setdefault(place[1], []).append(name)
        elif base in MODEL_FILES:
            top, rank = _place(folder)
            # A file called cameras.txt in some folder is a model only together with its images.
            if top == "" or f"{folder.lower()}images{base[-4:]}" in lower:
                ranked_folders = models.setdefault(top, [])
                if (rank, folder) not in ranked_folders:
                    ranked_folders.append((rank, folder))
    for top, ranked in captured.items():
        transforms.setdefault(top, ranked[min(ranked)])
    tops = sorted({*transforms, *models}, key=lambda top: (top.count("/"), top))
    programs = program_files(names)
    if not tops or tops[0].count("/") > MAX_DEPTH:
        return Cameras("", programs=programs) if programs else None
    if len(tops) > 1 and tops[1].count("/") == tops[0].count("/"):
        raise TwoDataSets(
            f"There are cameras of several data sets, in {tops[0]} and in {tops[1]}. Give the folder of one of them."
        )
    top = tops[0]
    candidates = models.get(top, [])
    best = min((rank for rank, _ in candidates), default=0)
    folders = sorted((folder for rank, folder in candidates if rank == best), key=_number)
    return Cameras(top, tuple(transforms.get(top, ())), tuple(folders), programs)


def program_files(names: Sequence[str]) -> tuple[str, ...]:
    """Those of some names that files with cameras of PROGRAM_FILES may have, and of LISTS beside cameras of Bundler."""
    patterns = [pattern for each in PROGRAM_FILES.values() for pattern in each]
    lists = LISTS if any(fits(name, PROGRAM_FILES["Bundler"]) for name in names) else ()
    return tuple(name for name in names if fits(name, (*patterns, *lists)))


def named_by_job(names: Sequence[str]) -> list[str]:
    """Those of some names whose files have cameras that are not read, and are sent so that the job says so."""
    patterns = [each for one in OTHER_CAMERAS.values() for each in one if each not in LARGE]
    return [name for name in names if fits(name, patterns)]


def camera_files(names: Sequence[str]) -> list[str]:
    """Those of some names whose files may have cameras, those that are not read included."""
    patterns = (*MODEL_PARTS, TRANSFORMS, *(each for one in OTHER_CAMERAS.values() for each in one))
    programs = program_files(names)
    return [
        name
        for name in names
        if name in programs
        or fits(name, patterns)
        or (name.lower().endswith(".json") and keyframes(_split(name)[0]) is not None)
    ]


def holds_media(names: Sequence[str]) -> bool:
    """Whether some of these names are those of photos, videos or archives."""
    return any(name.lower().endswith((*PHOTO_SUFFIXES, *VIDEO_SUFFIXES, *ARCHIVE_SUFFIXES)) for name in names)


def not_used_in_zip(archive: str, first: str, *, posed: bool) -> str:
    """A sentence about cameras in a zip that lies among photos. posed: whether these have cameras beside them."""
    why = "other cameras lie beside the photos" if posed else "photos lie in the zip and beside it"
    return (
        f"The cameras in {archive} are not used, such as {first}: {why}. Give one folder or one zip with the photos "
        "and the cameras that belong to them."
    )


def fits(name: str, patterns: Sequence[str]) -> bool:
    """Whether the last parts of a name, as many as a pattern has, fit one of some patterns in lower case."""
    parts = name.lower().split("/")
    return any(fnmatchcase("/".join(parts[-1 - pattern.count("/") :]), pattern) for pattern in patterns)


def is_camera_file(name: str) -> bool:
    """Whether a file of this name, without a folder, holds cameras or a part of them."""
    base = name.lower()
    return base in (*MODEL_PARTS, "points3d.bin", "points3d.txt", "database.db") or fits(
        name, (TRANSFORMS, "reconstruction.json", "cameras.json")
    )


def place_of_model(folder: str) -> str:
    """The data set that a folder with a COLMAP model, with a slash at its end, belongs to."""
    return _place(folder)[0]


def unread_cameras(names: Sequence[str]) -> list[str]:
    """Sentences about files with cameras that are not read, among files where `find_cameras` finds none.

    They are of OTHER_CAMERAS, lie too deep, or are a part of a COLMAP model.
    """
    recovered = "cameras are recovered from the photos."
    said = []
    for program, patterns in OTHER_CAMERAS.items():
        first = next((name for name in names if fits(name, patterns)), None)
        if first is not None:
            said.append(
                f"The cameras of {program} in {first} are not read: {recovered} To use those, export them from there "
                "as a COLMAP model or a transforms.json."
            )
    first = next((name for name in names if fits(name, (*MODEL_PARTS, TRANSFORMS))), None)
    if first is not None:
        said.append(
            f"{first} is not read: {recovered} A COLMAP model has cameras and images, both as .bin or both as .txt, "
            f"and lies at most {MAX_DEPTH} folders down, as a transforms.json does."
        )
    return said


def _place(folder: str) -> tuple[str, int]:
    """The data set that a folder with a COLMAP model belongs to, and the rank of its place there."""
    # "colmap/sparse/" ends in "sparse/" too, so that the longest place is asked for first.
    for rank in (1, 0, 2):
        match = _PATTERNS[rank].search(folder)
        if match:
            return folder[: match.start()], rank
    return folder, len(PLACES)


def keyframes(folder: str) -> tuple[str, int] | None:
    """The data set with this folder of Polycam's cameras, and its rank among KEYFRAMES; None for another folder."""
    for rank, place in enumerate(KEYFRAMES):
        if f"/{folder.lower()}".endswith(f"/{place}"):
            return folder[: -len(place)], rank
    return None


def _number(folder: str) -> tuple[bool, int, str]:
    """The order of the models of a data set: by their numbers, and one without a number behind them."""
    last = folder.rstrip("/").rpartition("/")[2]
    numbered = last.isdecimal() and last.isascii()
    return (not numbered, int(last) if numbered else 0, folder)


def _split(name: str) -> tuple[str, str]:
    """The folder of a name, with a slash at its end or empty, and the name in it."""
    head, slash, base = name.rpartition("/")
    return head + slash, base
