"""What the jobs of a soak train: small captures of the still life, each from photos to model with the real engine."""

from dataclasses import dataclass
from typing import Any

from _still_life import photos, posed_capture, video

PHOTOS = 11
WIDTH, HEIGHT = 160, 120
TILES = 2
_GAUSSIANS = 1000
"""Limit of Gaussians, for models of a quarter of a megabyte."""

_STEPS = (100, 600, 2000)
"""Training steps, in turn. The first checkpoint is stored after 2.5 s of training, which the longer ones reach."""


@dataclass(frozen=True)
class Work:
    """A capture and how it is trained.

    kind: key of `KINDS`.
    files: what is uploaded, by the path in a capture.
    photos: number of photos that its model must come from, none left out.
    options: those of the job.
    """

    kind: str
    files: dict[str, bytes]
    photos: int
    options: dict[str, Any]


KINDS = {
    "photos": f"SfM and training of {PHOTOS} photos",
    "video": f"frames, SfM and training of a video of {PHOTOS} frames",
    "cameras": f"training of {PHOTOS} photos with given cameras",
    "tiles": f"SfM and training of {PHOTOS} photos in {TILES} tiles",
}
"""What a job of each kind does."""

_TURN = ("photos", "tiles", "cameras", "photos", "video", "photos", "tiles")


def captures() -> dict[str, dict[str, bytes]]:
    """Return the files of a capture of each kind."""
    several = photos(PHOTOS, WIDTH, HEIGHT)
    return {
        "photos": several,
        "tiles": several,
        "video": video(PHOTOS, WIDTH, HEIGHT),
        "cameras": posed_capture(PHOTOS, WIDTH, HEIGHT),
    }


def nth(number: int, files: dict[str, dict[str, bytes]]) -> Work:
    """Return the work of the job with this number. Every fourth one in one piece writes a film of its training.

    files: those of a capture of each kind.
    """
    kind = _TURN[number % len(_TURN)]
    options = {
        "steps": _STEPS[(number + number // len(_TURN)) % len(_STEPS)],
        "max_gaussians": _GAUSSIANS,
        **(
            {"tiles": TILES} if kind == "tiles" else {"progress_video": "orbit" if number % 4 == 0 else "off"}
        ),
    }
    return Work(kind, files[kind], PHOTOS, options)
