"""The passes of one training step, timed apart, against the time that their bytes take at the card's bandwidth.

A floor counts what a pass must read and write once: every input and output of its kernels that no cache can be relied
on to hold between them. The compositing passes calculate more than they move, so their floors are far below them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from _rows import Row

from .scene import cloud
from .timing import Place

DEGREE = 3
FLOATS = 59
"""Parameters of a Gaussian."""

RECORD, GRADIENT = 48, 64
"""Bytes of a projected Gaussian and of its gradient."""


@dataclass(frozen=True)
class Counts:
    """What a step's bytes follow from: Gaussians, those visible, (tile, Gaussian) pairs, pixels of the image, segments
    of the lists, and pixels of a tile.
    """

    gaussians: int
    visible: int
    pairs: int
    pixels: int
    segments: int
    tile_pixels: int


def floors(c: Counts) -> dict[str, int]:
    """Bytes of each pass of a step at degree 3 with kept statistics of the photo and no mask."""
    state = 4 * FLOATS * c.visible  # one array of parameters, gradients or moments
    planes = 36 * c.pixels  # three float32 planes of three channels
    # A visible splat's depth and number pass through four 8-bit digits of a radix sort, a pair's tile and place (16-bit
    # key, 64-bit place) through two; each digit reads and writes once.
    by_depth, by_tile = 4 * 2 * (4 + 8) * c.visible, 2 * 2 * (2 + 8) * c.pairs
    # A culled Gaussian of `project` is read, and its record, gradient and gradient planes are written as zeros.
    return {
        "project": 4 * FLOATS * c.gaussians + RECORD * c.gaussians,
        "lists": 2 * 32 * c.gaussians
        + by_depth
        + 2 * RECORD * c.visible
        + by_tile
        + (2 + 4 + 8 + 4 + 4) * c.pairs,
        "blend": RECORD * c.visible + 4 * c.pairs + 16 * c.pixels + 16 * c.tile_pixels * c.segments,
        "loss": (15 + 24 + 15 + 12) * c.pixels + 6 * planes,
        "blend backward": GRADIENT * (c.gaussians + 2 * c.visible)
        + RECORD * c.visible
        + 4 * c.pairs
        + 28 * c.pixels
        + 16 * c.tile_pixels * c.segments,
        "project backward": 2 * RECORD * c.gaussians
        + 2 * GRADIENT * c.visible
        + state
        + 4 * FLOATS * c.gaussians,
        "scores": RECORD * c.gaussians + 32 * c.visible + 2 * 12 * c.visible,
        "adam": 7 * state + (1 + 2 * 4 + 2 * 12) * c.gaussians,
    }


def measure(place: Place) -> Iterator[Row]:
    """Milliseconds and floor bytes of each pass, of the whole step, and of a rendering without a step."""
    from splatmill_worker.kernels.gpu import adam
    from splatmill_worker.kernels.gpu.bin import Room, lists
    from splatmill_worker.kernels.gpu.blended import SEGMENT
    from splatmill_worker.kernels.gpu.composite import blend
    from splatmill_worker.kernels.gpu.composite_backward import blend_backward
    from splatmill_worker.kernels.gpu.loss import loss_and_gradient, photo_stats
    from splatmill_worker.kernels.gpu.project import project_records
    from splatmill_worker.kernels.gpu.project_backward import project_backward
    from splatmill_worker.kernels.gpu.step import Step
    from splatmill_worker.kernels.records import BETA2, TILE, Rates

    n, side = (6, 12) if place.dry else (1_000_000, 1024)
    view = cloud(n, side, side)
    step = Step(*view.groups, where=place.device)
    viewmat, K, photo = (x.to(place.device) for x in (view.viewmat, view.K, view.photo))
    size, groups = (view.width, view.height), step._groups(step._params)
    still = Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def project() -> torch.Tensor:
        return project_records(groups, viewmat, K, *size, degree=DEGREE, near=0.01, antialias=False, planar=n)

    records = project()
    used = [int(x) for x in lists(records, *size, None).used.tolist()]
    room = Room(used[0], used[1])
    made = lists(records, *size, room)
    image = blend(records, made.bins, *size, None, depth=False, checkpoints=True)
    stats = photo_stats(photo)
    count = torch.full((), float(side * side), device=place.device)

    def compare() -> tuple[torch.Tensor, torch.Tensor | None]:
        return loss_and_gradient(image.color, photo, dssim_weight=0.2, mask=None, stats=stats, count=count)

    d_color = compare()[1]
    assert d_color is not None
    gradient = blend_backward(records, made.bins, image, *size, d_color)
    visible, last = made.shown.to(torch.uint8), torch.zeros(n, dtype=torch.int32, device=place.device)
    refused = torch.zeros(1, dtype=torch.int32, device=place.device)
    first, second = (torch.zeros_like(step._params) for _ in range(2))
    scored = step._shown(view.viewmat, view.K, *size, DEGREE, None, False, 0.01, depth=False, whole=False)

    def update() -> None:
        missed = adam.CatchUp(visible, last, 1, BETA2)
        adam.apply_planes(
            step._params, step._gradient, first, second, [0.0] * 6, FLOATS, 1, BETA2, refused, missed
        )  # fmt: skip

    works: dict[str, Callable[[], object]] = {
        "project": project,
        "lists": lambda: lists(records, *size, room),
        "blend": lambda: blend(records, made.bins, *size, None, depth=False, checkpoints=True),
        "loss": compare,
        "blend backward": lambda: blend_backward(records, made.bins, image, *size, d_color),
        "project backward": lambda: project_backward(
            groups, viewmat, K, *size, records, gradient, degree=DEGREE, antialias=False, planar=n,
            into=step._groups(step._gradient),
        ),
        "scores": lambda: step._score(scored, gradient),
        "adam": update,
    }  # fmt: skip
    lengths = torch.diff(made.bins.offsets)
    segments = int((-(-lengths // SEGMENT)).sum())
    counts = Counts(n, used[0], used[1], side * side, segments, TILE * TILE)
    common = {"gaussians": n, "visible": used[0], "pairs": used[1], "pixels": side * side, "tile": TILE}
    bytes_of = floors(counts)
    assert set(bytes_of) == set(works)
    for name, work in works.items():
        yield {**common, "pass": name, "bytes": bytes_of[name], "ms": place.median_ms(work)}

    def train() -> None:
        step.train(view.viewmat, view.K, view.photo, degree=DEGREE, rates=still, step=1)

    def show() -> None:
        step.forward(view.viewmat, view.K, *size, degree=DEGREE)

    whole = sum(bytes_of.values())
    row = {**common, "pass": "whole step", "bytes": whole, "ms": place.median_ms(train)}
    yield {**row, "host_ms": place.host_ms(train)}
    shown = sum(bytes_of[name] for name in ("project", "lists", "blend"))
    yield {**common, "pass": "rendering", "bytes": shown, "ms": place.median_ms(show)}


def measure_small_tiles(place: Place) -> Iterator[Row]:
    """The same with tiles of 8 pixels. The kernels read the side when they are imported, so a process of its own."""
    from splatmill_worker.kernels import records

    records.TILE = 8
    yield from measure(place)
