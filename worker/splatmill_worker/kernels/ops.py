"""The public functions of the kernels: every op once, on the backend asked for or, by default, the tensors' own.

Backends are `reference` (plain torch in any dtype, which defines the ops), `cpu` (C++, float32) and `gpu` (Triton,
float32). A backend without an op raises NotImplementedError; none is replaced by another.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Literal, cast

import torch
from torch import Tensor

from . import checks
from .records import MEDIAN, TILE, Bins, Projected, Waves

__all__ = [
    "Backend",
    "Bins",
    "Projected",
    "Waves",
    "backend_for",
    "bin",
    "composite",
    "correlate",
    "knn",
    "loss",
    "median_depth",
    "photo_stats",
    "project",
]

Backend = Literal["reference", "cpu", "gpu"]


def backend_for(tensor: Tensor) -> Backend:
    """Return the backend that ops use for this tensor by default: `gpu` on CUDA devices, else `cpu`."""
    return "gpu" if tensor.device.type == "cuda" else "cpu"


def project(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    degree: int,
    near: float = 0.01,
    antialias: bool = False,
    backend: Backend | None = None,
) -> Projected:
    """Project Gaussians into one pinhole camera (EWA splatting, Zwicker et al. 2002; Kerbl et al. 2023).

    means [N,3] world; log_scales [N,3]; quats [N,4] wxyz of any norm > 0; logit_opacities [N]; sh [N, (degree+1)^2 to
    16, 3]; viewmat [4,4] world to camera, OpenCV axes; K [3,3] pixels without skew; near: the smallest depth that is
    drawn, world units; antialias: scale opacities by the compensation of the blur (Yu et al. 2024). Differentiable in
    the five groups and viewmat. Raises TypeError or ValueError that names the argument.
    """
    name = _backend(backend, means)
    kind = _kind(name, means)
    checks.gaussians(means, log_scales, quats, logit_opacities, sh, **kind)
    checks.camera(viewmat, K, width, height, degree, near, **kind)
    if not (degree + 1) ** 2 <= sh.shape[1] <= 16:
        raise ValueError(
            f"sh: degree {degree} needs {(degree + 1) ** 2} to 16 coefficients, got {sh.shape[1]}"
        )
    op = _op(name, "project")
    rows: Projected = op(
        means,
        log_scales,
        quats,
        logit_opacities,
        sh,
        viewmat,
        K,
        width,
        height,
        degree=degree,
        near=near,
        antialias=antialias,
    )
    return rows


def bin(projected: Projected, width: int, height: int, *, backend: Backend | None = None) -> Bins:
    """List for every 16x16 tile the Gaussians whose 1/255 ellipse reaches it, front to back, equal depths by index."""
    name = _backend(backend, projected.means2d)
    _check_projected(projected, name)
    checks.image_size(width, height)
    lists: Bins = _op(name, "bin")(projected, width, height)
    return lists


def composite(
    projected: Projected,
    bins: Bins,
    width: int,
    height: int,
    *,
    background: Tensor | None = None,
    waves: Waves | None = None,
    backend: Backend | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend front to back into color [H,W,3], alpha [H,W] and depth [H,W] = sum of weight times z, not over alpha.

    background [3]: its colour is weighted by the transmittance left; None is black. waves: what varies the colours
    over the splats; not on gpu. Differentiable in the background, the waves' values and every field of projected but
    the extents.
    """
    name = _backend(backend, projected.means2d)
    kind = _check_projected(projected, name)
    checks.image_size(width, height)
    _check_bins(bins, width, height, kind["device"])
    if background is not None:
        checks.tensor("background", background, (3,), **kind)
    extra: dict[str, Any] = {}
    if waves is not None:
        if name == "gpu":
            raise NotImplementedError(
                "composite with waves: the backend gpu does not have it; use cpu or reference."
            )
        checks.waves(waves, len(projected.means2d), **kind)
        extra["waves"] = waves
    image: tuple[Tensor, Tensor, Tensor] = _op(name, "composite")(
        projected, bins, width, height, background=background, **extra
    )
    return image


def median_depth(
    projected: Projected,
    bins: Bins,
    width: int,
    height: int,
    *,
    tilts: Tensor | None = None,
    transmittance: float = MEDIAN,
    backend: Backend | None = None,
) -> Tensor:
    """Return the median depth [H,W]: z of the first splat that leaves a transmittance of 1/2 or less, 0 without one.

    tilts [N,2]: of the plane that each Gaussian counts as. At the offset d from its mean2d, in pixels, z = depth /
    (1 - tilt . d); beyond 1000 times its depth there is none. None is 0. transmittance: in place of 1/2, from 0.1 to
    1: a larger one is nearer to the camera. Not differentiable.
    """
    name = _backend(backend, projected.means2d)
    kind = _check_projected(projected, name)
    checks.image_size(width, height)
    _check_bins(bins, width, height, kind["device"])
    if not 0.1 <= transmittance <= 1.0:
        raise ValueError(f"transmittance: expected 0.1 to 1, got {transmittance}")
    if tilts is None:
        tilts = torch.zeros_like(projected.means2d)
    checks.tensor("tilts", tilts, (len(projected.means2d), 2), **kind)
    return cast(
        Tensor,
        _op(name, "median_depth")(projected, bins, width, height, tilts=tilts, transmittance=transmittance),
    )


def loss(
    color: Tensor,
    photo: Tensor,
    *,
    dssim_weight: float = 0.2,
    mask: Tensor | None = None,
    stats: Any = None,
    backend: Backend | None = None,
) -> Tensor:
    """Return (1 - w) mean|color - photo/255| + w (1 - mean SSIM) with w = dssim_weight; differentiable in color.

    color [H,W,3]; photo uint8 [H,W,3]; mask [H,W], nonzero where a pixel is used; stats from `photo_stats` of the same
    photo, mask and backend. SSIM has an 11-tap Gaussian window of sigma 1.5 and zero padding (Wang et al. 2004).
    """
    name = _backend(backend, color)
    kind = _kind(name, color)
    checks.tensor("color", color, (None, None, 3), **kind)
    height, width = color.shape[:2]
    checks.image_size(width, height)
    checks.tensor("photo", photo, (height, width, 3), dtype=torch.uint8, device=kind["device"])
    _check_mask(mask, height, width, kind["device"])
    op = _op(name, "loss")
    return cast(Tensor, op(color, photo, dssim_weight=dssim_weight, mask=mask, stats=stats))


def photo_stats(photo: Tensor, *, mask: Tensor | None = None, backend: Backend | None = None) -> Any:
    """Return what `loss` computes from photo and mask alone, to be kept for photos that are used often."""
    name = _backend(backend, photo)
    checks.tensor("photo", photo, (None, None, 3), dtype=torch.uint8, device=photo.device.type)
    _check_mask(mask, photo.shape[0], photo.shape[1], photo.device.type)
    return _op(name, "loss", "photo_stats")(photo, mask=mask)


def knn(points: Tensor, *, backend: Backend | None = None) -> Tensor:
    """Return the mean distance [N] from each of points [N,3] to its three nearest others."""
    name = _backend(backend, points)
    checks.tensor("points", points, (None, 3), **_kind(name, points))
    return cast(Tensor, _op(name, "knn")(points))


def correlate(
    image: Tensor,
    rays: Tensor,
    patches: Tensor,
    inverse_depths: Tensor,
    turn: Tensor,
    shift: Tensor,
    *,
    margin: float,
    least_variance: float,
    backend: Backend | None = None,
) -> Tensor:
    """Return the normalised cross-correlation [N,D] of patches with what another image shows at each of D depths.

    image [H,W] grey values, of two rows and columns at least; rays [N,M,3] from the patches' camera to the M points of
    each patch, at depth 1, the patch's centre in the middle; patches [N,M] grey values of mean 0 and norm 1;
    inverse_depths [D]; turn [3,3] and shift [3]: the ray r at the inverse depth w is seen at the pixel (x/z, y/z) of
    turn r + w shift, and the centre of pixel (0, 0) is (0.5, 0.5). The image is read bilinearly, and beyond its border
    as at its border; what it shows counts as of `least_variance` at least. A patch whose centre is behind the other
    camera, or at most `margin` pixels from the border, has -1. Not differentiable, and not on gpu.
    """
    name = _backend(backend, image)
    kind = _kind(name, image)
    checks.tensor("image", image, (None, None), **kind)
    checks.image_size(image.shape[1], image.shape[0])
    if min(image.shape) < 2:
        raise ValueError(f"image: expected two rows and columns at least, got shape {list(image.shape)}")
    checks.tensor("rays", rays, (None, None, 3), **kind)
    checks.tensor("patches", patches, (rays.shape[0], rays.shape[1]), **kind)
    if not rays.shape[1] % 2:
        raise ValueError(f"rays: expected an odd number of points in a patch, got {rays.shape[1]}")
    checks.tensor("inverse_depths", inverse_depths, (None,), **kind)
    checks.tensor("turn", turn, (3, 3), **kind)
    checks.tensor("shift", shift, (3,), **kind)
    if not (margin >= 0 and least_variance > 0):
        raise ValueError(
            f"margin, least_variance: expected at least 0 and more than 0, got {margin} and {least_variance}"
        )
    op = _op(name, "correlate")
    scores: Tensor = op(
        image, rays, patches, inverse_depths, turn, shift, margin=margin, least_variance=least_variance
    )
    return scores


def _backend(asked: Backend | None, tensor: object) -> Backend:
    if asked is None:
        return backend_for(tensor) if isinstance(tensor, Tensor) else "cpu"
    if asked not in ("reference", "cpu", "gpu"):
        raise ValueError(f"backend: expected 'reference', 'cpu' or 'gpu', got {asked!r}")
    return asked


def _op(backend: Backend, stem: str, function: str | None = None) -> Callable[..., Any]:
    """Return the function of that stem in the backend's package; raises NotImplementedError where there is none."""
    module = f"{__package__}.{backend}.{stem}"
    try:
        op = getattr(importlib.import_module(module), function or stem)
    except ModuleNotFoundError as error:
        if error.name == "triton":
            from .gpu.device import GpuUnavailable, absence

            raise GpuUnavailable(absence() or str(error)) from None
        if error.name is not None and module.startswith(error.name):
            raise NotImplementedError(
                f"The {backend} backend has no op '{stem}'; use backend='reference', which has all."
            ) from None
        raise
    return cast(Callable[..., Any], op)


def _kind(backend: Backend, like: object) -> dict[str, Any]:
    """Return the dtype and device that the op's tensors must have; the reference takes any that all of them share."""
    if backend == "cpu":
        return {"dtype": torch.float32, "device": "cpu"}
    if not isinstance(like, Tensor):
        return {"dtype": torch.float32, "device": "cpu"}
    return {"dtype": like.dtype if backend == "reference" else torch.float32, "device": like.device.type}


def _check_projected(projected: Projected, backend: Backend) -> dict[str, Any]:
    kind = _kind(backend, projected.means2d)
    checks.tensor("projected.means2d", projected.means2d, (None, 2), **kind)
    n = len(projected.means2d)
    shapes: dict[str, tuple[int, ...]] = {
        "conics": (n, 3), "opacities": (n,), "colors": (n, 3), "depths": (n,), "extents": (n, 2)
    }  # fmt: skip
    for name, shape in shapes.items():
        checks.tensor(f"projected.{name}", getattr(projected, name), shape, **kind)
    return kind


def _check_bins(bins: Bins, width: int, height: int, device: str) -> None:
    tiles = -(-width // TILE) * -(-height // TILE)
    checks.tensor("bins.offsets", bins.offsets, (tiles + 1,), dtype=torch.int64, device=device)
    checks.tensor("bins.ids", bins.ids, (None,), dtype=torch.int32, device=device)


def _check_mask(mask: Tensor | None, height: int, width: int, device: str) -> None:
    if mask is not None:
        checks.tensor("mask", mask, (height, width), dtype=None, device=device)
        if mask.dtype not in (torch.uint8, torch.bool):
            raise TypeError(f"mask: expected uint8 or bool, got {mask.dtype}")
