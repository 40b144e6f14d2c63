"""SIFT features of every photo, in a COLMAP database beside the reduced photos on which they were found."""

from __future__ import annotations

import sqlite3
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill.files import replacing
from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.decoding.decoders import decode
from splatmill_worker.images.lens import PANORAMA
from splatmill_worker.images.load import training_size
from splatmill_worker.images.masks import shown_part
from splatmill_worker.images.prepare import UsablePhoto
from splatmill_worker.scene import MIN_SHOWN
from splatmill_worker.sfm.callbacks import OnProgress, stop_if, watched
from splatmill_worker.sfm.cameras import CameraGroup
from splatmill_worker.sfm.options import FISHEYE, PANORAMA_FEATURES, PANORAMA_SIDE, Effort

MAX_IMAGES = 2147483647
"""COLMAP's kMaxNumImages: it numbers the pair of images a < b as MAX_IMAGES * a + b."""

CALL_SECONDS = 2.0
"""Seconds that one native call is made to take, by the pace of the one before; progress is reported between two. Fewer
photos a call would waste 0.05 seconds of each."""


@dataclass(frozen=True)
class Features:
    """SIFT features of one photo.

    points: positions [n,2] in pixels of the reduced photo.
    scales: [n], in pixels of the reduced photo.
    descriptors: uint8 [n,128].
    """

    points: npt.NDArray[np.float64]
    scales: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class FeatureStore:
    """The folder with the reduced photos, their masks, and COLMAP's database of one effort."""

    folder: Path

    @property
    def images(self) -> Path:
        """Folder of the reduced photos."""
        return self.folder / "images"

    @property
    def masks(self) -> Path:
        """Folder of the reduced masks."""
        return self.folder / "masks"

    @property
    def database(self) -> Path:
        """COLMAP's database: cameras, images, features, matches and two-view geometries."""
        return self.folder / "database.db"


def reduced_name(group: int, photo: int) -> str:
    """The name of a photo in the database, by the indices of its camera and of the photo."""
    return f"camera{group}/{photo:06d}.pgm"


def photo_index(name: str) -> int:
    """The index of the photo whose name in the database is `name`."""
    return int(Path(name).stem)


def extract(
    photos: Sequence[UsablePhoto],
    groups: Sequence[CameraGroup],
    effort: Effort,
    camera_model: str,
    store: FeatureStore,
    threads: int,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> None:
    """Fill the store's database with cameras, images and features.

    Photos that the database has features of are left as they are. Raises Cancelled between two batches.
    """
    names = {
        index: reduced_name(number, index) for number, group in enumerate(groups) for index in group.photos
    }
    extracted = _extracted(store.database)
    done = len(extracted)
    reader = pycolmap.ImageReaderOptions()
    if any(photo.mask is not None for photo in photos):
        store.masks.mkdir(parents=True, exist_ok=True)
        reader.mask_path = store.masks
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = threads
    options.sift.first_octave = effort.first_octave
    options.sift.max_num_orientations = effort.orientations
    store.images.mkdir(parents=True, exist_ok=True)
    size = threads
    with ThreadPoolExecutor(threads) as pool:
        for group in groups:
            missing = [index for index in group.photos if names[index] not in extracted]
            reader.camera_model = (
                PANORAMA if group.is_panorama else FISHEYE if group.is_fisheye else camera_model
            )
            options.sift.max_num_features = effort.features * (PANORAMA_FEATURES if group.is_panorama else 1)
            side = round(effort.side * (PANORAMA_SIDE if group.is_panorama else 1.0))
            while missing:
                batch, missing = missing[:size], missing[size:]
                stop_if(cancelled)
                started = time.monotonic()
                list(
                    pool.map(
                        lambda index, side=side: _reduce(photos[index], side, store, names[index]), batch
                    )
                )
                # COLMAP would otherwise create a new camera for each batch.
                reader.existing_camera_id = _camera_of(group, names, store.database)
                files = [names[index] for index in batch]

                def extract_batch(token: pycolmap.CancellationToken, files: list[str] = files) -> None:
                    pycolmap.extract_features(
                        store.database,
                        store.images,
                        files,
                        pycolmap.CameraMode.SINGLE,
                        reader,
                        options,
                        pycolmap.Device.cpu,
                        token,
                    )

                watched(extract_batch, cancelled)
                for name in files:
                    (store.images / name).unlink()
                done += len(batch)
                size = photos_per_call(len(batch), time.monotonic() - started, threads)
                on_progress("features", done, len(photos), photos[batch[-1]].name)
    _set_cameras(groups, names, store.database)


def photos_per_call(photos: int, seconds: float, threads: int) -> int:
    """Photos of the next native call, if the last one took so many `seconds` for so many `photos`."""
    return max(threads, int(CALL_SECONDS * photos / seconds))


def carry_over(source: FeatureStore, target: FeatureStore, retried: set[int]) -> None:
    """Copy the database of `source` to `target`, without the features and pairs of the photos `retried`.

    Both stores must have reduced photos of the same size. Photos keep their ids. A database that `target` already has
    is left as it is.
    """
    if target.database.is_file():
        return
    with (
        replacing(target.database) as part,
        closing(sqlite3.connect(source.database)) as old,
        closing(sqlite3.connect(part)) as new,
    ):
        old.backup(new)
        images = new.execute("SELECT image_id, name FROM images")
        ids = {photo_index(name): number for number, name in images}
        dropped = {ids[photo] for photo in retried if photo in ids}
        for table in ("matches", "two_view_geometries"):
            pairs = [number for (number,) in new.execute(f"SELECT pair_id FROM {table}")]
            stale = [(number,) for number in pairs if dropped & {number // MAX_IMAGES, number % MAX_IMAGES}]
            new.executemany(f"DELETE FROM {table} WHERE pair_id = ?", stale)
        for table in ("keypoints", "descriptors"):
            new.executemany(f"DELETE FROM {table} WHERE image_id = ?", [(number,) for number in dropped])
        new.commit()


def copy_without_pairs(source: Path, target: Path, left_out: Iterable[tuple[int, int]]) -> None:
    """Copy COLMAP's database without the two-view geometries of the pairs `left_out`, given by COLMAP's image ids."""
    with (
        replacing(target) as part,
        closing(sqlite3.connect(source)) as old,
        closing(sqlite3.connect(part)) as new,
    ):
        old.backup(new)
        numbers = [(MAX_IMAGES * min(pair) + max(pair),) for pair in left_out]
        new.executemany("DELETE FROM two_view_geometries WHERE pair_id = ?", numbers)
        new.commit()


def load(database: pycolmap.Database) -> tuple[dict[int, int], list[Features]]:
    """COLMAP's image id of each photo, and the photos' features in order of their indices."""
    ids = {photo_index(image.name): image.image_id for image in database.read_all_images()}
    found = []
    for index in sorted(ids):
        keypoints = np.asarray(database.read_keypoints(ids[index]), np.float32).reshape(-1, 6)
        x_y, affine = keypoints[:, :2], keypoints[:, 2:].reshape(-1, 2, 2)
        # The determinant of the affine shape a11, a12, a21, a22 is the square of the scale.
        scales = np.sqrt(np.abs(affine[:, 0, 0] * affine[:, 1, 1] - affine[:, 0, 1] * affine[:, 1, 0]))
        descriptors = np.asarray(database.read_descriptors(ids[index]).data, np.uint8).reshape(-1, 128)
        found.append(Features(x_y.astype(np.float64), scales, descriptors))
    return ids, found


def _camera_of(group: CameraGroup, names: dict[int, str], path: Path) -> int:
    """The database's id of the group's camera; -1 while the database has none of its photos."""
    if not path.is_file():
        return -1
    database = pycolmap.Database.open(path)
    try:
        wanted = {names[index] for index in group.photos}
        return next((image.camera_id for image in database.read_all_images() if image.name in wanted), -1)
    finally:
        database.close()


def _extracted(path: Path) -> set[str]:
    """Names of the photos that the database has features of."""
    if not path.is_file():
        return set()
    database = pycolmap.Database.open(path)
    try:
        images = database.read_all_images()
        return {image.name for image in images if database.exists_keypoints(image.image_id)}
    finally:
        database.close()


def _reduce(photo: UsablePhoto, side: int, store: FeatureStore, name: str) -> None:
    """Write the photo and its mask in grey, with a longest side of at most `side` pixels."""
    target = store.images / name
    target.parent.mkdir(parents=True, exist_ok=True)
    size = training_size(photo.width, photo.height, side)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        grey = decode(photo.path, at_least=size).convert("L")
    if grey.size != size:
        grey = grey.resize(size, Image.Resampling.HAMMING)
    grey.save(target)
    if photo.mask is not None:
        mask = shown_part(decode(photo.mask), photo.shown_from).resize(size, Image.Resampling.BOX)
        mask_path = store.masks / f"{name}.png"
        mask_path.parent.mkdir(parents=True, exist_ok=True)
        mask.point(lambda value: 255 if value >= MIN_SHOWN else 0).save(mask_path, compress_level=1)


def _set_cameras(groups: Sequence[CameraGroup], names: dict[int, str], path: Path) -> None:
    """Set the initial focal length of each group's camera, as the reduced photos have no EXIF."""
    database = pycolmap.Database.open(path)
    try:
        for group in groups:
            if group.is_panorama:
                continue
            image = database.read_image_with_name(names[group.photos[0]])
            if image is None:
                continue  # COLMAP could not read the reduced photo; `solve_at` checks that all were read
            camera = database.read_camera(image.camera_id)
            params = np.array(camera.params)
            params[camera.focal_length_idxs()] = group.focal * max(camera.width, camera.height)
            params[camera.principal_point_idxs()] = np.multiply(group.center, (camera.width, camera.height))
            camera.params = params.tolist()
            # EXIF initialises the focal length but is not used to verify matches: with a cropped photo or a wrong
            # tag, the correct ones would fail (decisions: EXIF_FOCAL). Without a known focal length a fundamental
            # matrix is fitted, which photos of a fisheye do not follow.
            camera.has_prior_focal_length = group.is_fisheye
            database.update_camera(camera)
    finally:
        database.close()
