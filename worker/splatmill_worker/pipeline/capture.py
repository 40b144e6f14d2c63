"""What a job trains on: the posed scene of its capture, the split, the model to start from, and the kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from splatmill.data_sets import TwoDataSets
from splatmill.schema import Backend, TrainOptions, known_distance
from splatmill.schema.quantities import counted, listed
from splatmill_worker import sfm
from splatmill_worker.errors import Refusal
from splatmill_worker.images import overlays
from splatmill_worker.images.copies import warning as copies_warning
from splatmill_worker.images.masks import mask_folder
from splatmill_worker.images.prepare import names_remark
from splatmill_worker.kernels.gpu.device import absence
from splatmill_worker.pipeline.near_copies import near_copies, same_photos
from splatmill_worker.scene import Scene, View, split
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.placed import PlacingObserver
from splatmill_worker.sfm.posed import zipped
from splatmill_worker.splat.plan.plan import Kernels
from splatmill_worker.wording import plain

MOST_NEAR = 0.5
"""Share of the training views that may be left out as near copies of held-out ones."""

OnProgress = Callable[[str, int, int, str], None]
"""Called with the stage, the number of steps done, their total (0 if unknown), and a note."""


def posed_scene(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
    observer: PlacingObserver | None = None,
) -> Scene:
    """Return the scene with the cameras that the capture brings, or else with cameras recovered from the photos.

    capture: folder with images/, and masks/ and poses/ where they were given; or the folder of a posed data set. The
        only file in images/ may be a zip of a whole data set.
    workdir: folder where structure from motion, triangulation and stereo store their results, and from which they
        read earlier ones.
    options: only those of structure from motion are read.
    on_progress: called with the progress of structure from motion, triangulation and stereo.
    cancelled: polled; when it returns true, Cancelled is raised.
    observer: looks at the cameras and points while structure from motion places them.

    Raises Refusal for poses that cannot be used and for a scale that cannot be followed, and SfmFailed.
    """
    capture = zipped.data_set(capture, workdir, cancelled)
    try:
        given = posed.find(capture)
    except TwoDataSets as error:
        raise Refusal(
            "poses_invalid", str(error), advice="Give one data set, or photos without cameras."
        ) from error
    if given is not None:
        if options.scale is not None:
            raise Refusal(
                "option_out_of_range",
                "scale is given, and so are the cameras: given cameras are never moved.",
                advice="Leave out the option scale, or scale the given cameras.",
            )
        try:
            scene = overlays.in_views(given.load(), workdir)
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
        return posed.with_points(
            scene, workdir, seed=options.seed, on_progress=on_progress, cancelled=cancelled
        )
    images = capture / "images"
    wanted = sfm.SfmOptions(
        effort=options.sfm_effort.value,
        matcher=options.matcher.value,
        mapper=options.mapper.value,
        frames=options.max_video_frames,
        seed=options.seed,
    )
    scene = sfm.reconstruct(
        images if images.is_dir() else capture,
        mask_folder(capture),
        workdir,
        wanted,
        on_progress,
        cancelled,
        observer,
        None if options.scale is None else known_distance(options.scale),
    )
    return replace(scene, warnings=(*names_remark(capture), *scene.warnings))


@dataclass(frozen=True)
class Split:
    """The views to train on and the held-out ones.

    training, held_out: the views.
    left_out: the name of each view that is in neither, and the reason.
    warnings: sentences for the user.
    """

    training: tuple[View, ...]
    held_out: tuple[View, ...]
    left_out: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()


def honest_split(scene: Scene, options: TrainOptions) -> Split:
    """Return the views of `split_views`, without copies, and to train on none that is a near copy of a held-out one.

    Where these are more than MOST_NEAR of the training views, as in a slow video, `split` holds out every 16th view
    instead of every 8th, and so on; where even that does not help, all are kept and a warning says what that means.
    Raises as `split_views` does.
    """
    named = set(options.test_views or ())
    held = named | ({view.name for view in scene.views if view.split == "test"} if not named else set())
    same = same_photos(scene)
    # A copy on the other side of the split is a near copy below.
    copies = {name: original for name, original in same.items() if (name in held) == (original in held)}
    chosen = replace(scene, views=tuple(view for view in scene.views if view.name not in copies))
    left_out = [(name, f"it shows the same as {original}") for name, original in copies.items()]
    warnings = copies_warning(list(copies.items()))
    step = options.holdout
    while True:
        train, test = split_views(chosen, options.model_copy(update={"holdout": step}))
        near = near_copies(scene, test, train, same)
        given = options.test_views is not None or any(view.split == "test" for view in test)
        if len(near) <= MOST_NEAR * len(train) or given or len(test) < 2:
            break
        step *= 2
    if len(near) > MOST_NEAR * len(train):
        train, test = split_views(chosen, options)
        copy, original = next(iter(near.items()))
        warnings.append(
            "Most photos were taken from nearly the same place as a held-out one, so the held-out PSNR says little "
            f"about other views: {copy} and {original}, for example. Give photos from more places."
        )
    elif near:
        copy, original = next(iter(near.items()))
        spaced = (
            "" if step == options.holdout else f" Every {step}th photo is held out, since so many are alike."
        )
        warnings.append(
            f"{counted(len(near), 'photo is', 'photos are')} not trained on, since a held-out one was "
            f"taken from nearly the same place, such as {original} and {copy}: the training would be shown what it is "
            f"judged by.{spaced}"
        )
        left_out += [
            (name, f"it is nearly the same as {held}, which is held out") for name, held in near.items()
        ]
        train = tuple(view for view in train if view.name not in near)
    return Split(train, test, tuple(left_out), tuple(warnings))


def split_views(scene: Scene, options: TrainOptions) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Return the views to train on and the held-out ones.

    The held-out views are those that the option `test_views` names. Without that option they are chosen by `split`:
    the test views of the data set, or else every `holdout`-th view. Raises Refusal when a name is unknown or no view is
    left to train on.
    """
    if options.test_views is not None:
        wanted = set(options.test_views)
        unknown = sorted(wanted - {view.name for view in scene.views})
        if unknown:
            raise Refusal(
                "holdout_empty",
                f"test_views has {len(unknown)} of {len(wanted)} names that belong to no photo with a camera: "
                f"{listed(unknown)}.",
                advice="Use the names of the photos in the capture, and only photos whose cameras were recovered.",
                facts={"unknown": unknown},
            )
        ordered = sorted(scene.views, key=lambda view: view.name)
        train = tuple(view for view in ordered if view.name not in wanted)
        test = tuple(view for view in ordered if view.name in wanted)
    else:
        try:
            train, test = split(scene, options.holdout)
        except ValueError as error:
            raise Refusal(
                "holdout_empty", str(error), advice="Set holdout to 2 or more, or to 0 to hold out none."
            ) from error
    if not train:
        raise Refusal(
            "holdout_empty",
            f"All {len(test)} photos with a camera are held out, so no photo is left to train on.",
            advice="Hold out fewer photos: name fewer in test_views, or set a larger holdout.",
        )
    return train, test


def start_model_path(capture: Path, workdir: Path, options: TrainOptions) -> Path | None:
    """Return the path of the model file to start from, or None when the training starts from points.

    It is a file among the capture's poses if the option `start` names one, else the stored model that the service has
    copied to `workdir/start.ply`. Raises Refusal when the capture has no such file.
    """
    if options.start is None:
        return None
    if options.start_file is None:
        return workdir / "start.ply"
    for folder in (capture / "poses", capture):
        if (folder / options.start_file).is_file():
            return folder / options.start_file
    raise Refusal(
        "start_unusable",
        f"There is no file {options.start_file!r} among the poses of the capture.",
        advice="Upload the model file to the poses of the capture, or leave out the option start.",
    )


def choose_kernels(options: TrainOptions) -> Kernels:
    """Return the kernels to train with: those that `backend` names; for auto, the GPU's if usable, else the CPU's.

    Raises Refusal when the requested ones do not run on this machine.
    """
    if options.backend is Backend.auto:
        return "gpu" if absence() is None else "cpu"
    if options.backend is Backend.gpu and (reason := absence()) is not None:
        raise Refusal(
            "backend_unavailable",
            f"The backend gpu was requested, but it does not run on this machine. {reason}",
            advice="Set backend to auto or cpu, or run a worker on a machine with a GPU.",
        )
    named: dict[Backend, Kernels] = {Backend.reference: "reference", Backend.cpu: "cpu", Backend.gpu: "gpu"}
    return named[options.backend]
