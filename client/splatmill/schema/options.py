"""Every setting of a training run, once: type, default, range and help text.

`/v1/options`, the OpenAPI document and the command line's help are generated from this model.
"""

from enum import StrEnum
from types import NoneType
from typing import Any, Literal, get_args

from annotated_types import Ge, Le, MaxLen, MinLen
from pydantic import Field, field_validator
from pydantic.fields import FieldInfo

from splatmill.schema.base import Request, Response
from splatmill.schema.captures import safe_name
from splatmill.schema.ids import ID
from splatmill.schema.quantities import ByteSize, Duration


class Preset(StrEnum):
    draft = "draft"
    balanced = "balanced"
    quality = "quality"


class Switch(StrEnum):
    auto = "auto"
    on = "on"
    off = "off"


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
    # `global` is a keyword of Python; the wire says "global".
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
    """How to train. What is left out is decided from the photos, and the plan says why."""

    preset: Preset = Field(
        default=Preset.balanced,
        description="How far to go when no budget is given.",
        json_schema_extra=_BUDGET,
    )
    steps: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        description="Stop after this many training steps.",
        json_schema_extra=_BUDGET,
    )
    time_budget: Duration | None = Field(
        default=None,
        ge=1,
        le=7 * 86400,
        description="Lay the training out to end after this long (90s, 5m, 1h30m, or seconds); "
        "recovering the cameras is not counted.",
        json_schema_extra=_BUDGET | {"kind": "duration"},
    )
    target_psnr: float | None = Field(
        default=None,
        ge=5,
        le=60,
        description="Stop when the held-out views reach this PSNR, in dB.",
        json_schema_extra=_BUDGET,
    )
    max_gaussians: int | None = Field(
        default=None,
        ge=1,
        le=50_000_000,
        description="Never hold more Gaussians than this.",
        json_schema_extra=_BUDGET,
    )
    max_memory: ByteSize | None = Field(
        default=None,
        ge=200 * 10**6,
        le=4 * 10**12,
        description="Keep the attempt's memory under this (1.5GB, 2GiB, or bytes).",
        json_schema_extra=_BUDGET | {"kind": "bytes"},
    )
    image_size: int | None = Field(
        default=None,
        ge=16,
        le=8192,
        description="Longest side the photos are trained at, in pixels; they are never enlarged. "
        "Left out: what the photos resolve.",
        json_schema_extra=_PHOTOS,
    )
    holdout: int = Field(
        default=8,
        ge=0,
        le=1000,
        description="Hold out every n-th photo, sorted by name, to measure with; 0 holds out none.",
        json_schema_extra=_PHOTOS,
    )
    test_views: tuple[str, ...] | None = Field(
        default=None,
        min_length=1,
        max_length=10_000,
        description="Hold out exactly the photos with these names, instead of every n-th.",
        json_schema_extra=_PHOTOS,
    )
    max_video_frames: int = Field(
        default=150,
        ge=2,
        le=2000,
        description="How many frames to take from a video, the sharpest ones.",
        json_schema_extra=_PHOTOS,
    )
    start: str | None = Field(
        default=None,
        max_length=512,
        description="Start from a trained model instead of points: the id of a model on the server, or a .ply file, "
        "by its path here or its name among the capture's poses. It must be in the world of the capture's cameras.",
        json_schema_extra=_PHOTOS,
    )
    progress_video: bool = Field(
        default=False,
        description="Also leave a video of one view as it is trained.",
        json_schema_extra=_PHOTOS,
    )
    background: Background = Field(
        default=Background.auto,
        description="What lies behind the scene while training; over random colours no hole passes for a surface, and "
        "transparent photos stay transparent.",
        json_schema_extra=_PHOTOS,
    )
    exposure: Switch = Field(
        default=Switch.auto,
        description="Fit an affine colour per photo, for photos whose exposure or white balance differ.",
        json_schema_extra=_PHOTOS,
    )
    far_shell: Switch = Field(
        default=Switch.auto,
        description="Put a far shell of Gaussians behind the scene, for the sky and for holes.",
        json_schema_extra=_PHOTOS,
    )
    gaps: Switch = Field(
        default=Switch.auto,
        description="Put Gaussians where photos show what no point of the reconstruction describes.",
        json_schema_extra=_PHOTOS,
    )
    mapper: Mapper = Field(
        default=Mapper.auto,
        description="How the cameras are recovered: one photo after another, or all at once.",
        json_schema_extra=_CAMERAS,
    )
    matcher: Matcher = Field(
        default=Matcher.auto,
        description="Which photos are compared: all pairs, neighbours in time, or neighbours by GPS.",
        json_schema_extra=_CAMERAS,
    )
    sfm_effort: Effort = Field(
        default=Effort.auto,
        description="How much detail is looked for in each photo to recover the cameras.",
        json_schema_extra=_CAMERAS,
    )
    pose_refinement: Switch = Field(
        default=Switch.auto,
        description="Keep correcting the cameras while training.",
        json_schema_extra=_CAMERAS,
    )
    sh_degree: int | None = Field(
        default=None,
        ge=0,
        le=3,
        description="Degree of the spherical harmonics that let colour change with the viewing direction.",
        json_schema_extra=_ENGINE,
    )
    densify: Switch = Field(
        default=Switch.auto,
        description="Add Gaussians where the photos ask for more, by cloning and splitting.",
        json_schema_extra=_ENGINE,
    )
    antialias: Switch = Field(
        default=Switch.auto,
        description="Keep the brightness of Gaussians smaller than a pixel, for views at several distances.",
        json_schema_extra=_ENGINE,
    )
    backend: Backend = Field(
        default=Backend.auto,
        description="What computes: plain torch, the C++ kernels, or a GPU.",
        json_schema_extra=_ENGINE,
    )
    seed: int = Field(
        default=0,
        ge=0,
        le=2**31 - 1,
        description="Seed of every random choice; the same seed on the same machine gives the same bytes.",
        json_schema_extra=_ENGINE,
    )

    @field_validator("start")
    @classmethod
    def _model_or_file(cls, start: str | None) -> str | None:
        if start is None or ID.fullmatch(start):
            return start
        if not start.lower().endswith(".ply"):
            raise ValueError(f"{start[:80]!r} is neither a model's id nor the name of a .ply file")
        return safe_name(start)

    @property
    def start_file(self) -> str | None:
        """The file among the capture's poses that `start` names, if it names one."""
        return self.start if self.start is not None and self.start.lower().endswith(".ply") else None

    @property
    def start_model(self) -> str | None:
        """The model that `start` names, if it names one."""
        return None if self.start_file is not None else self.start

    @field_validator("test_views")
    @classmethod
    def _names_once(cls, names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if names is not None and len(set(names)) != len(names):
            raise ValueError("a photo is named twice in test_views; name each once")
        return names


OptionType = Literal["integer", "number", "text", "list", "choice", "duration", "bytes", "flag"]


class OptionHelp(Response):
    """One setting as `/v1/options` and the command line's help show it."""

    name: str
    type: OptionType
    default: bool | int | float | str | list[str] | None = Field(
        description="The value when left out; null where it is decided from the photos."
    )
    minimum: int | float | None = None
    maximum: int | float | None = None
    choices: list[str] | None = None
    group: str = Field(description="Which settings belong together: budget, photos, cameras, engine.")
    help: str

    @property
    def flag(self) -> str:
        """The command line's spelling."""
        return "--" + self.name.replace("_", "-")

    @property
    def range_text(self) -> str:
        """`16..8192`, `auto|on|off`, or nothing."""
        if self.choices:
            return "|".join(self.choices)
        if self.minimum is None or self.maximum is None or self.type == "list":
            return ""
        return f"{self.minimum}..{self.maximum}"


class OptionList(Response):
    """What `/v1/options` answers."""

    options: list[OptionHelp]


def describe_options(model: type[Request] = TrainOptions) -> list[OptionHelp]:
    """Every field of `model`, in order, with its type, default, range or choices, group and help."""
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
