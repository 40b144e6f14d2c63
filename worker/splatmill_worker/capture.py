"""What a capture gives to train on: its cameras, its held-out views, and the kernels that will do the work."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from splatmill.schema import Backend, TrainOptions
from splatmill_worker import sfm
from splatmill_worker.errors import Refusal
from splatmill_worker.kernels.gpu.device import absence
from splatmill_worker.scene import Scene, View, split
from splatmill_worker.sfm import posed
from splatmill_worker.splat.plan.plan import Kernels

OnProgress = Callable[[str, int, int, str], None]


def cameras_of(
    capture: Path,
    workdir: Path,
    options: TrainOptions,
    on_progress: OnProgress,
    cancelled: Callable[[], bool],
) -> Scene:
    """The posed scene: the cameras that came with the photos, or those recovered from them.

    `capture` holds images/, and masks/ and poses/ where given (or is a data set's own folder). Raises Refusal
    for poses that cannot be used, and what `posed.with_stereo_points` and `sfm.reconstruct` raise.
    """
    given = posed.find(capture)
    if given is not None:
        try:
            scene = given.load()
        except (ValueError, OSError) as error:
            raise Refusal(
                "poses_invalid",
                str(error),
                advice="Correct the poses, or leave them out to have the cameras recovered from the photos.",
            ) from error
        return posed.with_stereo_points(scene, workdir, on_progress, cancelled)
    images = capture / "images"
    masks = capture / "masks"
    wanted = sfm.SfmOptions(
        effort=options.sfm_effort.value,
        matcher=options.matcher.value,
        mapper=options.mapper.value,
        frames=options.max_video_frames,
        seed=options.seed,
    )
    return sfm.reconstruct(
        images if images.is_dir() else capture,
        masks if masks.is_dir() else None,
        workdir,
        wanted,
        on_progress,
        cancelled,
    )


def held_out_of(scene: Scene, options: TrainOptions) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Training and held-out views: those named by `test_views`, else the data set's own, else every n-th.

    Raises Refusal when a name is unknown or nothing is left to train on.
    """
    if options.test_views is not None:
        wanted = set(options.test_views)
        unknown = sorted(wanted - {view.name for view in scene.views})
        if unknown:
            raise Refusal(
                "holdout_empty",
                f"test_views names photos that have no camera: {', '.join(unknown[:5])}.",
                advice="Name photos as the capture does, and only those that were registered.",
                facts={"unknown": unknown},
            )
        ordered = sorted(scene.views, key=lambda view: view.name)
        train = tuple(view for view in ordered if view.name not in wanted)
        test = tuple(view for view in ordered if view.name in wanted)
    else:
        try:
            train, test = split(scene, options.holdout)
        except ValueError as error:
            raise Refusal("holdout_empty", str(error), advice="Hold out fewer photos.") from error
    if not train:
        raise Refusal(
            "holdout_empty",
            f"All {len(test)} views are held out; nothing is left to train on.",
            advice="Hold out fewer photos.",
        )
    return train, test


def start_file(capture: Path, workdir: Path, options: TrainOptions) -> Path | None:
    """The .ply to start from: named among the capture's poses, or a model's own, fetched as start.ply; None without.

    Raises Refusal where the capture has no such file.
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
        f"The capture has no file {options.start_file!r} among its poses.",
        advice="Upload the .ply to the capture's poses, or leave start out.",
    )


def kernels_of(options: TrainOptions) -> Kernels:
    """The kernels to train with: those asked for, else the GPU's where there is one, else the CPU's.

    Raises Refusal where the ones asked for do not run.
    """
    if options.backend is Backend.auto:
        return "gpu" if absence() is None else "cpu"
    if options.backend is Backend.gpu and (reason := absence()) is not None:
        raise Refusal(
            "backend_unavailable",
            f"The gpu backend was asked for. {reason}",
            advice="Leave backend at auto, or run a worker on a machine with a GPU.",
        )
    named: dict[Backend, Kernels] = {Backend.reference: "reference", Backend.cpu: "cpu", Backend.gpu: "gpu"}
    return named[options.backend]
