"""SIFT features of every photo, in a COLMAP database."""

from __future__ import annotations

import sqlite3
import warnings
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
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
from splatmill_worker.sfm.callbacks import OnProgress, stop_if
from splatmill_worker.sfm.cameras import CameraGroup
from splatmill_worker.sfm.options import FISHEYE, PANORAMA_FEATURES, PANORAMA_SIDE, Effort
from splatmill_worker.sfm.sift import Features, find, search_slots

MAX_IMAGES = 2147483647
"""COLMAP's kMaxNumImages: it numbers the pair of images a < b as MAX_IMAGES * a + b."""


FEATURES = "keypoints", "descriptors"
"""Tables of COLMAP's database with the features of the photos."""

NO_FEATURES = Features(np.empty((0, 2)), np.empty(0, np.float32), np.empty((0, 128), np.uint8))


def reduced_name(group: int, photo: int) -> str:
    """The name of a photo in the database, by the indices of its camera and of the photo."""
    return f"camera{group}/{photo:06d}"


def photo_index(name: str) -> int:
    """The index of the photo whose name in the database is `name`."""
    return int(Path(name).stem)


def extract(
    photos: Sequence[UsablePhoto],
    groups: Sequence[CameraGroup],
    effort: Effort,
    camera_model: str,
    path: Path,
    pool: ThreadPoolExecutor,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> None:
    """Fill COLMAP's database at `path` with cameras, images and features.

    Photos that the database has features of are left as they are. Raises Cancelled between two photos.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    sides = [round(effort.side * (PANORAMA_SIDE if group.is_panorama else 1.0)) for group in groups]
    slots = search_slots(
        training_size(group.width, group.height, side) for group, side in zip(groups, sides, strict=True)
    )

    def search_photo(photo: UsablePhoto, side: int, most: int) -> Features:
        with slots:
            stop_if(cancelled)
            return find(*_reduced(photo, side), most)

    waiting: deque[tuple[int, int, Future[Features]]] = deque()
    with closing(pycolmap.Database.open(path)) as database:
        try:
            for number, (group, side) in enumerate(zip(groups, sides, strict=True)):
                most = effort.features * (PANORAMA_FEATURES if group.is_panorama else 1)
                if not database.exists_camera(number + 1):
                    _write_camera(database, number, group, side, camera_model)
                for index in group.photos:
                    if not database.exists_descriptors(index + 1):
                        waiting.append((number, index, pool.submit(search_photo, photos[index], side, most)))
            while waiting:
                number, index, search = waiting.popleft()
                _write_features(database, number, index, search.result())
                done = len(photos) - len(waiting)
                on_progress("features", done, len(photos), photos[index].name)
        finally:
            for *_, search in waiting:
                search.cancel()


def carry_over(source: Path, target: Path, retried: set[int]) -> None:
    """Copy COLMAP's database without the features and pairs of the photos `retried`.

    Both must be of photos reduced to the same size. Photos keep their ids. A `target` that is there is left as it is.
    """
    if target.is_file():
        return
    with (
        replacing(target) as part,
        closing(sqlite3.connect(source)) as old,
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


def photos_in(path: Path, *, with_features: bool) -> set[int]:
    """Indices of the photos in COLMAP's database at `path`: of all, or of those with features."""
    table = "images JOIN descriptors USING (image_id)" if with_features else "images"
    with closing(_read_only(path)) as database:
        return {photo_index(name) for (name,) in database.execute(f"SELECT name FROM {table}")}


def pairs_in(path: Path) -> set[tuple[int, int]]:
    """The pairs of photos, by their indices, of which COLMAP's database at `path` has the two-view geometry."""
    with closing(_read_only(path)) as database:
        indices = {
            number: photo_index(name)
            for number, name in database.execute("SELECT image_id, name FROM images")
        }
        numbers = [number for (number,) in database.execute("SELECT pair_id FROM two_view_geometries")]
    pairs = [(indices[number // MAX_IMAGES], indices[number % MAX_IMAGES]) for number in numbers]
    return {(min(pair), max(pair)) for pair in pairs}


def completed(path: Path, features_of: Collection[int]) -> None:
    """Make COLMAP's database at `path` a file by itself, which any number of machines read at a time.

    features_of: indices of the photos whose features it keeps.
    """
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        images = database.execute("SELECT image_id, name FROM images").fetchall()
        dropped = [(number,) for number, name in images if photo_index(name) not in features_of]
        for table in FEATURES:
            database.executemany(f"DELETE FROM {table} WHERE image_id = ?", dropped)
        # COLMAP's journal is a second file, which machines that share a folder cannot share.
        database.execute("PRAGMA journal_mode = DELETE")
        if dropped:
            database.execute("VACUUM")


def _read_only(path: Path) -> sqlite3.Connection:
    """A connection that writes no file beside the database, which does not change."""
    return sqlite3.connect(f"{path.resolve().as_uri()}?immutable=1", uri=True)


def merge_databases(source: Path, target: Path, *, without: Iterable[str] = ()) -> None:
    """Add to COLMAP's database `target` what `source` has beyond it, which nobody writes any more (`completed`). Both
    number cameras and photos alike.

    without: tables that are left as they are.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with closing(_read_only(source)) as old, closing(sqlite3.connect(target)) as new:
        if not new.execute("SELECT name FROM sqlite_master").fetchone():
            old.backup(new)
            for table in without:
                new.execute(f"DELETE FROM {table}")
            new.commit()
            return
        tables = [name for (name,) in old.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        for table in set(tables) - {"sqlite_sequence", *without}:  # the first is SQLite's own
            rows = old.execute(f"SELECT * FROM {table}")
            places = ",".join("?" * len(rows.description))
            new.executemany(f"INSERT OR IGNORE INTO {table} VALUES ({places})", rows)
        new.commit()


def load(
    database: pycolmap.Database, only: Collection[int] | None = None
) -> tuple[dict[int, int], list[Features]]:
    """COLMAP's image id of each photo, and the photos' features in order of their indices.

    only: indices of the photos that features are read of; the others have none. None: all.
    """
    ids = {photo_index(image.name): image.image_id for image in database.read_all_images()}
    features = []
    for index in sorted(ids):
        if only is not None and index not in only:
            features.append(NO_FEATURES)
            continue
        keypoints = np.asarray(database.read_keypoints(ids[index]), np.float32)
        descriptors = np.asarray(database.read_descriptors(ids[index]).data, np.uint8)
        features.append(Features(keypoints[:, :2].astype(np.float64), keypoints[:, 2], descriptors))
    return ids, features


def _reduced(photo: UsablePhoto, side: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8] | None]:
    """The photo in grey [h,w] with a longest side of at most `side` pixels, and 255 where its mask shows it, if any."""
    size = training_size(photo.width, photo.height, side)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        grey = decode(photo.path, at_least=size).convert("L")
    if grey.size != size:
        grey = grey.resize(size, Image.Resampling.HAMMING)
    if photo.mask is None:
        return np.asarray(grey), None
    mask = shown_part(decode(photo.mask), photo.shown_from).resize(size, Image.Resampling.BOX)
    return np.asarray(grey), np.where(np.asarray(mask) >= MIN_SHOWN, np.uint8(255), np.uint8(0))


def _write_camera(
    database: pycolmap.Database, number: int, group: CameraGroup, side: int, camera_model: str
) -> None:
    """Write the camera of group `number`, with its initial focal length, and its rig of one camera."""
    model = PANORAMA if group.is_panorama else FISHEYE if group.is_fisheye else camera_model
    width, height = training_size(group.width, group.height, side)
    camera = pycolmap.Camera.create_from_model_name(
        number + 1, model, group.focal * max(width, height), width, height
    )
    if not group.is_panorama:
        params = np.array(camera.params)
        params[camera.principal_point_idxs()] = np.multiply(group.center, (width, height))
        camera.params = params.tolist()
        # EXIF initialises the focal length but is not used to verify matches: with a cropped photo or a wrong tag, the
        # correct ones would fail (decisions: EXIF_FOCAL). Without a known focal length a fundamental matrix is fitted,
        # which photos of a fisheye do not follow.
        camera.has_prior_focal_length = group.is_fisheye
    rig = pycolmap.Rig(rig_id=number + 1)
    rig.add_ref_sensor(camera.sensor_id)
    with pycolmap.DatabaseTransaction(database):
        database.write_camera(camera, use_camera_id=True)
        database.write_rig(rig, use_rig_id=True)


def _write_features(database: pycolmap.Database, number: int, index: int, features: Features) -> None:
    """Write the features of photo `index`, and the photo as one of camera `number` where the database has it not."""
    image_id = index + 1
    with pycolmap.DatabaseTransaction(database):
        if not database.exists_image(image_id):
            name = reduced_name(number, index)
            image = pycolmap.Image(name=name, camera_id=number + 1, image_id=image_id)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image_id, rig_id=number + 1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
        # COLMAP's third and fourth columns are scale and orientation; orientations are not used.
        columns = features.points, features.scales, np.zeros(len(features.scales))
        if not database.exists_keypoints(image_id):
            database.write_keypoints(image_id, np.column_stack(columns).astype(np.float32))
        database.write_descriptors(
            image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, features.descriptors)
        )
