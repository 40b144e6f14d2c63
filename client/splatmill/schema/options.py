"""The options of a training: type, default, range and help text of each.

`/v1/options`, the OpenAPI document and the command line are generated from this model.
"""

from enum import StrEnum
from types import NoneType
from typing import Any, Literal, Self, get_args

from annotated_types import Ge, Le, MaxLen, MinLen
from pydantic import Field, field_validator, model_validator
from pydantic.fields import FieldInfo

from splatmill.schema.base import ByteSize, Duration, Request, Response, without_controls
from splatmill.schema.conflicts import check_conflicts
from splatmill.schema.files.formats import is_start_file, start_suffixes
from splatmill.schema.files.names import safe_name
from splatmill.schema.frames import known_distance
from splatmill.schema.ids import ID


class Preset(StrEnum):
    draft = "draft"
    balanced = "balanced"
    quality = "quality"


PRESET_STEPS = {Preset.draft: 1000, Preset.balanced: 3000, Preset.quality: 10_000}
"""Training steps that a preset lays out where no budget is given, however few the photos are."""

PRESET_VISITS = {Preset.draft: 12, Preset.balanced: 36, Preset.quality: 120}
"""Training steps for each photo that a preset lays out, where these are more. With the paper's 30,000 steps, each of
its scenes' 100 to 300 photos comes 100 to 300 times."""

PRESET_LONGEST = 4
"""Largest multiple of its steps that a preset trains: they are doubled while the last doubling gained enough
(decisions: PRESET_LONGEST)."""

PRESET_GAIN = {Preset.draft: 0.5, Preset.balanced: 0.2, Preset.quality: 0.05}
"""dB on validation photos: a preset ends the training once the last doubling of the steps has gained less
(decisions: PRESET_GAIN)."""

MOST_TILES = 1024
"""Largest number of tiles of a scene."""

PHOTOS_PER_VALIDATION = 12
"""Training photos for each one that is set aside to measure what a doubling gains: fewer than are held out, since
training misses them."""


def preset_steps(preset: Preset, photos: int) -> int:
    """Return the number of steps that a training of so many photos is laid out for where no budget is given."""
    return max(PRESET_STEPS[preset], PRESET_VISITS[preset] * photos)


class Switch(StrEnum):
    auto = "auto"
    on = "on"
    off = "off"


class ProgressVideo(StrEnum):
    off = "off"
    view = "view"
    orbit = "orbit"


class Background(StrEnum):
    auto = "auto"
    black = "black"
    white = "white"
    random = "random"


class Backend(StrEnum):
    auto = "auto"
    reference = "reference"
    cpu = "cpu"
    gpu = "gpu"


class Mapper(StrEnum):
    auto = "auto"
    incremental = "incremental"
    # `global` is a keyword of Python.
    global_ = "global"


class Matcher(StrEnum):
    auto = "auto"
    exhaustive = "exhaustive"
    sequential = "sequential"
    spatial = "spatial"


class Effort(StrEnum):
    auto = "auto"
    lean = "lean"
    standard = "standard"
    high = "high"


def _group(name: str) -> dict[str, Any]:
    return {"group": name}


_BUDGET, _PHOTOS, _CAMERAS, _ENGINE = map(_group, ("budget", "photos", "cameras", "engine"))


class TrainOptions(Request):
    """How to train. The worker decides from the photos what is left out, and its plan gives the reasons."""

    preset: Preset = Field(
        default=Preset.balanced,
        description=(
            "Draft for a quick look, quality for the best result: how far to train where no time and no number of "
            "steps is given, and the largest photo size where image_size is not given."
        ),
        json_schema_extra=_BUDGET,
    )
    steps: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        description=(
            "Number of training steps. With a time beside it, training ends by whichever is reached first. Left out, "
            "the time or else the preset sets the length of the training."
        ),
        json_schema_extra=_BUDGET,
    )
    time_budget: Duration | None = Field(
        default=None,
        ge=1,
        le=7 * 86400,
        description=(
            "Time for the training alone: 90s, 5m, 1h30m, or a number of seconds. The whole schedule is fitted into "
            "it. Finding the cameras before it and measuring quality after it take additional time."
        ),
        json_schema_extra=_BUDGET | {"kind": "duration"},
    )
    within: Duration | None = Field(
        default=None,
        ge=5,
        le=7 * 86400,
        description=(
            "Time for the whole job, from its first photo to the finished model: 90s, 5m, 1h30m, or a number of "
            "seconds. Training gets what finding the cameras leaves of it, less what measuring and storing will take. "
            "A time that is too short by the jobs that have finished on this server is refused, with the least that "
            "is enough."
        ),
        json_schema_extra=_BUDGET | {"kind": "duration"},
    )
    target_psnr: float | None = Field(
        default=None,
        ge=5,
        le=60,
        description=(
            "Stop as soon as validation photos reach this mean PSNR, in dB. These are a few training photos that are "
            "set aside for it. Without another budget, training ends at the latest after the steps of the preset "
            "quality."
        ),
        json_schema_extra=_BUDGET,
    )
    max_gaussians: int | None = Field(
        default=None,
        ge=1,
        le=50_000_000,
        description=(
            "Largest number of Gaussians. Left out, the detail of the scene decides, up to what the pixels of the "
            "photos resolve and memory holds; set it for a smaller file or faster rendering."
        ),
        json_schema_extra=_BUDGET,
    )
    max_memory: ByteSize | None = Field(
        default=None,
        ge=200 * 10**6,
        le=4 * 10**12,
        description=(
            "Memory for training: 1.5GB, 2GiB, or a number of bytes. It limits the number of Gaussians, and photos "
            "that need more than an eighth of it are kept on the disk. The program and what recovering the cameras "
            "has left in memory count, but half of it at least is for Gaussians. Left out, half of the machine's free "
            "memory, or the free memory of the GPU."
        ),
        json_schema_extra=_BUDGET | {"kind": "bytes"},
    )
    tiles: int | None = Field(
        default=None,
        ge=2,
        le=MOST_TILES,
        description=(
            "Number of parts that a large scene is trained in, after a coarse model of everything: each needs less "
            "memory, and workers that are free train them beside each other. Left out, the scene is trained in one "
            "piece, which small scenes are faster in."
        ),
        json_schema_extra=_BUDGET,
    )
    image_size: int | None = Field(
        default=None,
        ge=16,
        le=8192,
        description=(
            "Longest side of the photos in training, in pixels; smaller photos are not enlarged. Left out, "
            "the preset limits it, and photos without fine detail are reduced to half."
        ),
        json_schema_extra=_PHOTOS,
    )
    holdout: int = Field(
        default=8,
        ge=0,
        le=1000,
        description=(
            "Hold out every n-th photo, in order of name, to measure quality on photos that were not trained "
            "on. 0 holds out none. A test split that comes with the data set takes precedence."
        ),
        json_schema_extra=_PHOTOS,
    )
    test_views: tuple[str, ...] | None = Field(
        default=None,
        min_length=1,
        max_length=10_000,
        description="Names of the photos to hold out, in place of every n-th.",
        json_schema_extra=_PHOTOS,
    )
    max_video_frames: int = Field(
        default=150,
        ge=2,
        le=2000,
        description=(
            "Largest number of frames taken from a video. Frames are spaced by equal amounts of image motion, and the "
            "sharpest one near each position is taken. Raise it for a long video."
        ),
        json_schema_extra=_PHOTOS,
    )
    start: str | None = Field(
        default=None,
        max_length=512,
        description=(
            "Model to start from, in place of the points of the reconstruction: the id of a model on the server, or "
            "a model file (.ply, .spz, ...). Or a file of points to start from beside these (.las, .laz, .e57, .pcd, "
            ".xyz, .pts, .ply). A file is given by its path or by its name among the capture's poses. A model "
            "must be in the coordinates of the capture's cameras; points with colours may be in any."
        ),
        json_schema_extra=_PHOTOS,
    )
    progress_video: ProgressVideo = Field(
        default=ProgressVideo.off,
        description=(
            "Also write progress.mp4, a video of the scene in the course of the training: from the view of one photo, "
            "or from an orbit around the scene."
        ),
        json_schema_extra=_PHOTOS,
    )
    time_lapse: Switch = Field(
        default=Switch.auto,
        description=(
            "Keep snapshots of the training with the model, at most 24 and 64 MB, to watch it form on the page of the "
            "model. With auto, jobs of a server do; trainings on this machine do not."
        ),
        json_schema_extra=_PHOTOS,
    )
    background: Background = Field(
        default=Background.auto,
        description=(
            "Colour behind the scene in training. With random, every step draws a new one, so "
            "that no hole is "
            "hidden by a matching colour. With auto, it is random, except for a few opaque photos, where it "
            "is black."
        ),
        json_schema_extra=_PHOTOS,
    )
    exposure: Switch = Field(
        default=Switch.auto,
        description=(
            "Bring the training photos to the exposure and white balance of the photos taken around them. "
            "With auto, this is done where the points they share show that one photo in ten departs from these."
        ),
        json_schema_extra=_PHOTOS,
    )
    far_shell: Switch = Field(
        default=Switch.auto,
        description=(
            "Add a distant shell of Gaussians around the scene, for the sky and for what is seen through "
            "holes. With auto, opaque photos get one, unless they are few, look to one side and show little sky."
        ),
        json_schema_extra=_PHOTOS,
    )
    gaps: Switch = Field(
        default=Switch.auto,
        description=(
            "Add Gaussians before training where the photos show surfaces on which the reconstruction has no "
            "points. With auto, this is done where such surfaces fill much of the photos, there are enough "
            "photos to correct the guessed depths, and these look over half a turn at most."
        ),
        json_schema_extra=_PHOTOS,
    )
    mapper: Mapper = Field(
        default=Mapper.auto,
        description=(
            "Method that recovers the cameras: incremental adds one photo after another, global solves for "
            "all at once. With auto, incremental is used, and global is tried if too few photos can be placed."
        ),
        json_schema_extra=_CAMERAS,
    )
    matcher: Matcher = Field(
        default=Matcher.auto,
        description=(
            "Pairs of photos that are matched: exhaustive matches all pairs, sequential neighbours in order "
            "of name, spatial neighbours by GPS. With auto, all pairs of a small set are matched, otherwise "
            "those that a quick comparison suggests."
        ),
        json_schema_extra=_CAMERAS,
    )
    sfm_effort: Effort = Field(
        default=Effort.auto,
        description=(
            "Number and resolution of the features from which the cameras are recovered. With auto, lean is "
            "tried first, or standard if there are few photos, and more effort is spent only if too few "
            "can be placed. Choose high for photos with little texture."
        ),
        json_schema_extra=_CAMERAS,
    )
    pose_refinement: Switch = Field(
        default=Switch.auto,
        description=(
            "Refine the training cameras during training. With auto, this is done where their reprojection "
            "error exceeds one pixel. The gpu backend cannot refine cameras."
        ),
        json_schema_extra=_CAMERAS,
    )
    scale: str | None = Field(
        default=None,
        max_length=512,
        description=(
            'Distance between the cameras of two photos, as in "a.jpg b.jpg 2.5m", in mm, cm, m, km, in or ft: '
            "the model is then in metres. Left out, metres follow from GPS where the photos have it and cover enough "
            "ground, and the unit is arbitrary otherwise. Not for cameras that were given, which are never moved."
        ),
        json_schema_extra=_CAMERAS,
    )
    sh_degree: int | None = Field(
        default=None,
        ge=0,
        le=3,
        description=(
            "Degree of the spherical harmonics, which let colour depend on the viewing direction; 0 makes it "
            "constant. Left out, the angles between the views of a point decide."
        ),
        json_schema_extra=_ENGINE,
    )
    densify: Switch = Field(
        default=Switch.auto,
        description=(
            "Add Gaussians during training by splitting them along their longest axis. With auto, this is done "
            "unless the training starts with as many as it may have."
        ),
        json_schema_extra=_ENGINE,
    )
    cluster_culling: Switch = Field(
        default=Switch.auto,
        description=(
            "Leave the parts of a large scene that a photo does not show out of the steps on it, which makes them "
            "faster. With auto, this is done where photos have at most half of the scene in view. Only on the cpu "
            "backend."
        ),
        json_schema_extra=_ENGINE,
    )
    antialias: Switch = Field(
        default=Switch.auto,
        description=(
            "Compensate the opacity of Gaussians smaller than a pixel, so that their brightness does not "
            "change with distance. With auto, this is done where points are seen from widely different "
            "distances."
        ),
        json_schema_extra=_ENGINE,
    )
    lpips: Switch = Field(
        default=Switch.auto,
        description=(
            "Measure LPIPS, a distance of pictures by image networks, on the held-out photos at the end. With auto, "
            "this is done where the weights of these networks are installed on the machine that trains, unless a "
            "time budget is set or more than 64 photos are held out; with on, a machine without them refuses the job."
        ),
        json_schema_extra=_ENGINE,
    )
    backend: Backend = Field(
        default=Backend.auto,
        description=(
            "Implementation that trains: reference is plain PyTorch and slow, cpu the C++ kernels, gpu the "
            "Triton kernels. With auto, the GPU is used where the machine has a usable one, otherwise the "
            "CPU."
        ),
        json_schema_extra=_ENGINE,
    )
    seed: int = Field(
        default=0,
        ge=0,
        le=2**31 - 1,
        description=(
            "Seed of every random choice. Without a time budget, the same seed on the same machine gives the "
            "same bytes."
        ),
        json_schema_extra=_ENGINE,
    )

    @field_validator("start")
    @classmethod
    def _model_or_file(cls, start: str | None) -> str | None:
        if start is None or ID.fullmatch(start):
            return start
        if not is_start_file(start):
            raise ValueError(
                f"{start[:80]!r} is neither the id of a model nor the name of a {start_suffixes()} file"
            )
        return safe_name(start)

    @field_validator("progress_video", mode="before")
    @classmethod
    def _filmed_or_not(cls, video: Any) -> Any:
        """Read true and false as view and off."""
        return (
            {True: ProgressVideo.view, False: ProgressVideo.off}[video] if isinstance(video, bool) else video
        )

    @field_validator("scale")
    @classmethod
    def _distance(cls, scale: str | None) -> str | None:
        if scale is not None:
            known_distance(without_controls(scale))
        return scale

    @model_validator(mode="after")
    def _compatible(self) -> Self:
        check_conflicts(vars(self))
        return self

    @property
    def ending(self) -> Preset:
        """The preset that ends a training without a budget: quality where a target may end it sooner."""
        return self.preset if self.target_psnr is None else Preset.quality

    @property
    def timed(self) -> bool:
        """Whether time limits the training."""
        return self.time_budget is not None or self.within is not None

    def doubles(self, photos: int) -> bool:
        """Whether a training on so many photos doubles the steps of its preset while that gains enough: where no budget
        is given, and some of the photos can be set aside to measure it. A given model may have been trained on them.
        """
        return (
            self.steps is None
            and not self.timed
            and self.start_model is None
            and (self.target_psnr is not None or photos >= PHOTOS_PER_VALIDATION)
        )

    def held_out_of(self, photos: int) -> int:
        """How many of so many photos are held out, where none says of itself that it is."""
        if self.test_views is not None:
            return min(photos, len(self.test_views))
        return -(-photos // self.holdout) if self.holdout else 0

    @property
    def start_file(self) -> str | None:
        """The name of a file among the capture's poses, if `start` is one."""
        return self.start if self.start is not None and is_start_file(self.start) else None

    @property
    def start_model(self) -> str | None:
        """The id of a model, if `start` is one."""
        return None if self.start_file is not None else self.start

    @field_validator("test_views")
    @classmethod
    def _names_once(cls, names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if names is not None and len(set(names)) != len(names):
            raise ValueError("a photo is named twice in test_views; name each once")
        for name in names or ():
            without_controls(name)
        return names


OptionType = Literal["integer", "number", "text", "list", "choice", "duration", "bytes", "flag"]


class OptionHelp(Response):
    """One option as `/v1/options` and the help of the command line show it."""

    name: str
    type: OptionType
    default: bool | int | float | str | list[str] | None = Field(
        description="Value used when the option is left out; null where it is decided from the photos."
    )
    minimum: int | float | None = None
    maximum: int | float | None = None
    choices: list[str] | None = None
    group: str = Field(description="Group of related options: budget, photos, cameras or engine.")
    help: str

    @property
    def flag(self) -> str:
        """The option on the command line: `--time-budget`."""
        return "--" + self.name.replace("_", "-")

    @property
    def range_text(self) -> str:
        """The accepted values as text: `16..8192`, `auto|on|off`, or empty."""
        if self.choices:
            return "|".join(self.choices)
        if self.minimum is None or self.maximum is None or self.type == "list":
            return ""
        return f"{self.minimum}..{self.maximum}"


class OptionList(Response):
    """The response of `/v1/options`."""

    options: list[OptionHelp]


def describe_options(model: type[Request] = TrainOptions) -> list[OptionHelp]:
    """Return a description of every field of `model`, in order."""
    return [_describe(name, field) for name, field in model.model_fields.items()]


_SCALARS: dict[Any, OptionType] = {int: "integer", float: "number", str: "text", bool: "flag"}


def _describe(name: str, field: FieldInfo) -> OptionHelp:
    extra = field.json_schema_extra
    assert isinstance(extra, dict)
    kinds = [kind for kind in get_args(field.annotation) if kind is not NoneType] or [field.annotation]
    kind = kinds[0]
    is_choice = isinstance(kind, type) and issubclass(kind, StrEnum)
    choices: list[str] | None = [member.value for member in kind] if is_choice else None
    named = extra.get("kind")
    option_type: OptionType
    if named == "duration":
        option_type = "duration"
    elif named == "bytes":
        option_type = "bytes"
    elif is_choice:
        option_type = "choice"
    else:
        option_type = _SCALARS.get(kind, "list")
    bounds: dict[str, Any] = {}
    for mark in field.metadata:
        match mark:
            case Ge(ge=low) | MinLen(min_length=low):
                bounds["minimum"] = low
            case Le(le=high) | MaxLen(max_length=high):
                bounds["maximum"] = high
            case _:
                pass
    return OptionHelp(
        name=name,
        type=option_type,
        default=field.default,
        choices=choices,
        group=str(extra["group"]),
        help=field.description or "",
        **bounds,
    )
