"""The posed scene of a capture: with the cameras that it brings, or with cameras recovered from its photos."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from splatmill.data_sets import TwoDataSets
from splatmill.schema import TrainOptions, known_distance
from splatmill_worker import sfm
from splatmill_worker.errors import Refusal
from splatmill_worker.images.masks import mask_folder
from splatmill_worker.images.overlays import overlays
from splatmill_worker.images.panoramas import faces
from splatmill_worker.images.prepare import Prepared, names_remark, prepare
from splatmill_worker.pipeline import example, given_points, one_place
from splatmill_worker.scene import Scene
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.placed import PlacingObserver
from splatmill_worker.sfm.posed import zipped
from splatmill_worker.wording import plain

OnProgress = Callable[[str, int, int, str], None]
"""Called with the stage, the number of steps done, their total (0 if unknown), and a note."""

CAMERAS_SHARE = 0.5
"""Share of the time of a whole job after which no other way to place more photos is tried."""


@dataclass(frozen=True)
class _Contents:
    """What a capture holds.

    capture: folder with images/, or with photos; that of the unpacked data set where the capture is a zip of one.
    points: file of points to start from.
    cameras: the cameras that it brings; None where they are to be recovered.
    """

    capture: Path
    points: Path | None
    cameras: posed.PosedInput | None

    @property
    def photos(self) -> Path:
        """The folder of the photos without cameras."""
        images = self.capture / "images"
        return images if images.is_dir() else self.capture


def photos_without_cameras(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> Prepared | None:
    """The photos whose cameras `posed_scene` recovers; None where the capture brings cameras.

    Raises Refusal, as `posed_scene` does, and what `prepare` raises.
    """
    contents = _contents(capture, workdir, options, on_progress, cancelled)
    if contents.cameras is not None:
        return None
    return prepare(
        contents.photos,
        mask_folder(contents.capture),
        workdir,
        frames=options.max_video_frames,
        on_progress=on_progress,
        cancelled=cancelled,
    )


def sfm_options(options: TrainOptions) -> sfm.SfmOptions:
    """Those of structure from motion."""
    return sfm.SfmOptions(
        effort=options.sfm_effort.value,
        matcher=options.matcher.value,
        mapper=options.mapper.value,
        frames=options.max_video_frames,
        seed=options.seed,
        seconds=None if options.within is None else CAMERAS_SHARE * options.within,
    )


def posed_scene(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
    observer: PlacingObserver | None = None,
    prepared: Prepared | None = None,
) -> Scene:
    """Return the scene with the cameras that the capture brings, or else with cameras recovered from the photos.

    capture: folder with images/, and masks/ and poses/ where they were given; or the folder of a posed data set. The
        only file in images/ may be a zip of a whole data set, or ask for the example.
    workdir: folder where structure from motion, triangulation and stereo store their results, and from which they
        read earlier ones.
    options: those of structure from motion are read, and those of the points to start from.
    on_progress: called with the progress of structure from motion, triangulation and stereo.
    cancelled: polled; when it returns true, Cancelled is raised.
    observer: called with the cameras and points while structure from motion places them.
    prepared: the photos, where `photos_without_cameras` has found them before.

    Raises Refusal for poses and points that cannot be used and for a scale that cannot be followed, and SfmFailed.
    """
    contents = _contents(capture, workdir, options, on_progress, cancelled)
    capture, points, cameras = contents.capture, contents.points, contents.cameras
    if cameras is not None:
        if options.scale is not None:
            raise Refusal(
                "option_out_of_range",
                "scale is given, and so are the cameras: given cameras are never moved.",
                advice="Leave out the option scale, or scale the given cameras.",
            )
        try:
            scene = faces.cut(overlays.in_views(cameras.load(), workdir))
        except posed.UnreadModel as error:
            raise Refusal("poses_invalid", str(error), advice=error.advice) from error
        except (ValueError, OSError) as error:
            raise Refusal(
                "poses_invalid",
                " ".join(
                    [
                        f"The data set cannot be read: {plain(error)}."
                        if isinstance(error, OSError)
                        else str(error),
                        *names_remark(capture),
                    ]
                ),
                advice="Correct the poses, or remove them to have the cameras recovered from the photos.",
            ) from error
        scene = posed.with_points(
            scene, workdir, seed=options.seed, on_progress=on_progress, cancelled=cancelled
        )
        if points is not None:
            scene = given_points.with_given_points(scene, points, options, on_progress, cancelled)
        return replace(scene, warnings=(*scene.warnings, *one_place.warning(scene)))
    scene = sfm.reconstruct(
        contents.photos,
        mask_folder(capture),
        workdir,
        sfm_options(options),
        on_progress,
        cancelled,
        observer,
        None if options.scale is None else known_distance(options.scale),
        prepared,
    )
    if points is not None:
        scene = given_points.with_given_points(scene, points, options, on_progress, cancelled)
    unread = [*posed.without_cameras(capture), *zipped.unused_cameras(capture, workdir, cancelled)]
    return replace(
        scene, warnings=(*names_remark(capture), *unread, *scene.warnings, *one_place.warning(scene))
    )


def _contents(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> _Contents:
    """What the capture holds. Raises Refusal where it has the cameras of two data sets."""
    capture = example.photographed_capture(capture, workdir, on_progress, cancelled)
    points = given_points.points_path(capture, options)
    capture = zipped.data_set(capture, workdir, cancelled)
    try:
        cameras = posed.find(capture) or zipped.cameras_beside(capture, workdir, cancelled)
    except (TwoDataSets, posed.TwoFiles) as error:
        raise Refusal(
            "poses_invalid", str(error), advice="Give one data set, or photos without cameras."
        ) from error
    return _Contents(capture, points, cameras)
