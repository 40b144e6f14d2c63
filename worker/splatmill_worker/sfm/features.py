"""SIFT features of every photo, kept in a COLMAP database beside the reduced photos they were found on."""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.decode import decode
from splatmill_worker.images.load import training_size
from splatmill_worker.images.prepare import Usable
from splatmill_worker.sfm.cameras import Group
from splatmill_worker.sfm.cancellation import native_token, stop_if
from splatmill_worker.sfm.options import Effort

PAIR_IDS = 2147483647  # COLMAP's largest number of images
BATCH = 8  # photos per native call: progress is told between two of them


@dataclass(frozen=True)
class Features:
    """Features of one photo: points [n,2] in pixels of the reduced photo, scales [n], descriptors uint8 [n,128]."""

    points: npt.NDArray[np.float64]
    scales: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Workspace:
    """Where the reduced photos and the database of one set of photos at one effort lie."""

    folder: Path

    @property
    def images(self) -> Path:
        return self.folder / "images"

    @property
    def masks(self) -> Path:
        return self.folder / "masks"

    @property
    def database(self) -> Path:
        return self.folder / "database.db"


def reduced_name(group: int, photo: int) -> str:
    """The reduced photo's name in the database; a folder per camera."""
    return f"camera{group}/{photo:06d}.png"


def photo_index(name: str) -> int:
    """The photo a name of `reduced_name` stands for."""
    return int(Path(name).stem)


def extract(
    photos: Sequence[Usable],
    groups: Sequence[Group],
    effort: Effort,
    model: str,
    place: Workspace,
    threads: int,
    on_progress: Callable[[str, int, int, str], None],
    cancelled: Callable[[], bool],
) -> None:
    """Fills the database with cameras, images and features; what is there already is not made again."""
    names = {
        index: reduced_name(number, index) for number, group in enumerate(groups) for index in group.photos
    }
    done = _extracted(place.database)
    told = len(done)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = model
    if any(photo.mask is not None for photo in photos):
        place.masks.mkdir(parents=True, exist_ok=True)
        reader.mask_path = place.masks
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = threads
    options.sift.max_num_features = effort.features
    options.sift.first_octave = effort.first_octave
    options.sift.max_num_orientations = effort.orientations
    place.images.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(threads) as pool:
        for group in groups:
            missing = [index for index in group.photos if names[index] not in done]
            for start in range(0, len(missing), BATCH):
                batch = missing[start : start + BATCH]
                stop_if(cancelled)
                list(pool.map(lambda index: _reduce(photos[index], effort.side, place, names[index]), batch))
                # Each call would otherwise start a camera of its own for its batch.
                reader.existing_camera_id = _camera_of(group, names, place.database)
                with native_token(cancelled) as token:
                    pycolmap.extract_features(
                        place.database,
                        place.images,
                        [names[index] for index in batch],
                        pycolmap.CameraMode.SINGLE,
                        reader,
                        options,
                        pycolmap.Device.cpu,
                        token,
                    )
                told += len(batch)
                on_progress("features", told, len(photos), photos[batch[-1]].name)
    _set_cameras(groups, names, place.database)


def carry_over(source: Workspace, target: Workspace, again: set[int]) -> None:
    """Starts `target` with all that `source` has, but for the photos whose features are to be found `again`.

    Both look at the photos at one size. Pairs with such a photo are forgotten with it; what other pairs gave stays.
    Photos keep their ids. A target that is there already is left as it is.
    """
    if target.database.is_file():
        return
    target.folder.mkdir(parents=True, exist_ok=True)
    part = target.database.with_suffix(".part")
    part.unlink(missing_ok=True)
    with closing(sqlite3.connect(source.database)) as old, closing(sqlite3.connect(part)) as new:
        old.backup(new)
        ids = {photo_index(name): number for number, name in new.execute("SELECT image_id, name FROM images")}
        gone = {ids[photo] for photo in again if photo in ids}
        # COLMAP numbers a pair of images a < b by PAIR_IDS * a + b.
        for table in ("matches", "two_view_geometries"):
            pairs = [number for (number,) in new.execute(f"SELECT pair_id FROM {table}")]
            lost = [(number,) for number in pairs if gone & {number // PAIR_IDS, number % PAIR_IDS}]
            new.executemany(f"DELETE FROM {table} WHERE pair_id = ?", lost)
        for table in ("keypoints", "descriptors"):
            new.executemany(f"DELETE FROM {table} WHERE image_id = ?", [(number,) for number in gone])
        new.commit()
    part.replace(target.database)


def _camera_of(group: Group, names: dict[int, str], path: Path) -> int:
    """The database's id of the group's camera; -1 before any of its photos is in."""
    if not path.is_file():
        return -1
    database = pycolmap.Database.open(path)
    try:
        wanted = {names[index] for index in group.photos}
        return next((image.camera_id for image in database.read_all_images() if image.name in wanted), -1)
    finally:
        database.close()


def load(database: pycolmap.Database) -> tuple[dict[int, int], list[Features]]:
    """COLMAP's image id of each photo, and the photos' features in the same order."""
    ids = {photo_index(image.name): image.image_id for image in database.read_all_images()}
    found = []
    for index in sorted(ids):
        keypoints = np.asarray(database.read_keypoints(ids[index]), np.float32).reshape(-1, 6)
        # x, y and the affine shape a11, a12, a21, a22, whose determinant is the squared scale.
        scales = np.sqrt(np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4]))
        descriptors = np.asarray(database.read_descriptors(ids[index]).data, np.uint8).reshape(-1, 128)
        found.append(Features(keypoints[:, :2].astype(np.float64), scales, descriptors))
    return ids, found


def _extracted(path: Path) -> set[str]:
    if not path.is_file():
        return set()
    database = pycolmap.Database.open(path)
    try:
        images = database.read_all_images()
        return {image.name for image in images if database.exists_keypoints(image.image_id)}
    finally:
        database.close()


def _reduce(photo: Usable, side: int, place: Workspace, name: str) -> None:
    """Writes the photo (and its mask) in grey at the size features are found on."""
    target = place.images / name
    target.parent.mkdir(parents=True, exist_ok=True)
    size = training_size(photo.width, photo.height, side)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        grey = decode(photo.path, at_least=size).convert("L")
    if grey.size != size:
        grey = grey.resize(size, Image.Resampling.HAMMING)
    grey.save(target, compress_level=1)
    if photo.mask is not None:
        mask = decode(photo.mask).convert("L").resize(size, Image.Resampling.BOX)
        place_of_mask = place.masks / f"{name}.png"
        place_of_mask.parent.mkdir(parents=True, exist_ok=True)
        mask.point(lambda value: 255 if value >= 128 else 0).save(place_of_mask, compress_level=1)


def _set_cameras(groups: Sequence[Group], names: dict[int, str], path: Path) -> None:
    """The reduced files have no EXIF: each group's camera gets its focal length here."""
    database = pycolmap.Database.open(path)
    try:
        for group in groups:
            image = database.read_image_with_name(names[group.photos[0]])
            if image is None:
                continue  # its file did not decode a second time; it is told apart as unregistered
            camera = database.read_camera(image.camera_id)
            params = np.array(camera.params)
            params[camera.focal_length_idxs()] = group.focal * max(camera.width, camera.height)
            camera.params = params.tolist()
            # EXIF is where the focal length starts, never what matches are judged by: a cropped photo or a
            # wrong tag would rule out the true ones.
            camera.has_prior_focal_length = False
            database.update_camera(camera)
    finally:
        database.close()
