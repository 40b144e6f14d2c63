"""The keyword arguments of `train`, `render`, `orbit`, `mesh` and `present`, for editors and type checkers.

Generated from the schema by `make generated`.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

from splatmill.schema import (
    Annotation,
    Backend,
    Background,
    Box,
    CameraPath,
    CameraSpec,
    Effort,
    Format,
    Mapper,
    Matcher,
    Measurement,
    MeshFormat,
    Output,
    Preset,
    ProgressVideo,
    Scale,
    Switch,
)


class TrainArguments(TypedDict, total=False):
    """The settings of a training: the fields of `TrainOptions`."""

    preset: Preset | Literal["draft", "balanced", "quality"]
    steps: int | None
    time_budget: float | str | None
    within: float | str | None
    target_psnr: float | None
    max_gaussians: int | None
    max_memory: int | str | None
    tiles: int | None
    image_size: int | None
    holdout: int
    test_views: Sequence[str] | None
    max_video_frames: int
    start: str | os.PathLike[str] | None
    progress_video: ProgressVideo | Literal["off", "view", "orbit"]
    time_lapse: Switch | Literal["auto", "on", "off"]
    background: Background | Literal["auto", "black", "white", "random"]
    exposure: Switch | Literal["auto", "on", "off"]
    far_shell: Switch | Literal["auto", "on", "off"]
    gaps: Switch | Literal["auto", "on", "off"]
    mapper: Mapper | Literal["auto", "incremental", "global"]
    matcher: Matcher | Literal["auto", "exhaustive", "sequential", "spatial"]
    sfm_effort: Effort | Literal["auto", "lean", "standard", "high"]
    pose_refinement: Switch | Literal["auto", "on", "off"]
    scale: str | None
    sh_degree: int | None
    densify: Switch | Literal["auto", "on", "off"]
    cluster_culling: Switch | Literal["auto", "on", "off"]
    antialias: Switch | Literal["auto", "on", "off"]
    lpips: Switch | Literal["auto", "on", "off"]
    backend: Backend | Literal["auto", "reference", "cpu", "gpu"]
    seed: int


class RenderArguments(TypedDict, total=False):
    """How an image is rendered: the fields of `RenderRequest` but the camera."""

    output: Output | Literal["color", "depth", "median_depth", "normal", "alpha"]
    format: Format | Literal["png", "jpeg", "webp", "npy"]
    background: Literal["black", "white", "transparent"]
    quality: int


class OrbitArguments(TypedDict, total=False):
    """How a video is rendered: the fields of `OrbitRequest`."""

    seconds: float
    fps: int
    width: int
    height: int
    fov_y_deg: float | None
    background: Literal["black", "white"]
    camera_path: CameraPath | Mapping[str, Any] | None


class MeshArguments(TypedDict, total=False):
    """How a mesh is made: the fields of `MeshRequest`."""

    format: MeshFormat | Literal["glb", "ply"]
    faces: int
    voxel: float | None
    box: Box | Mapping[str, Any] | None
    texture: int | None


class PresentationArguments(TypedDict, total=False):
    """How a model is shown to people: the fields of `Presentation`."""

    start_view: CameraSpec | Mapping[str, Any] | None
    background: Literal["black", "white"]
    auto_rotate: bool
    scale: Scale | Mapping[str, Any] | None
    camera_path: CameraPath | Mapping[str, Any] | None
    measurements: Sequence[Measurement | Mapping[str, Any]]
    annotations: Sequence[Annotation | Mapping[str, Any]]
