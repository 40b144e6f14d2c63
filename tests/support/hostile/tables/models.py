"""Small files of models, cameras and points that are made to fill the memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from tests.support.hostile import model_bombs, models
from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.entry import Hostile

_SAID = {
    "one PNG of 250 megapixels serves every plane": "named as several of its images",
    "planes are PNGs of 250 megapixels": "15800 x 15800 pixels",
    "planes have 16 million pixels": "4000 x 4000 pixels",
    "announces 4 million Gaussians": "more than 400 times",
    "palette has 16,000 rows": "16000 rows of centroids",
    "a plane that inflates to 256 MB": "268435456 bytes",
    "60,000 members": "its list of files has",
    "5 million objects": "meta.json has",
    "attributes all lie in the same bytes": "more than 400 times",
    "a document of 4 million objects": "plausible size",
    "8 million Gaussians of degree 3": "more than 400 times",
}


def _start(what: str) -> Hostile:
    suffix, made = model_bombs.MODELS[what]
    (said,) = [said for part, said in _SAID.items() if part in what]

    def give(bench: Bench) -> Answer:
        return bench.start(made(), suffix)

    return Hostile("Models to start from", what, give, "the job fails: `start_unusable`", said)


def _posed(what: str, files: Callable[[], Mapping[str, bytes]], kind: str, said: str) -> Hostile:
    return Hostile("Poses", what, lambda bench: bench.posed(files()), kind, said)


def _text(**changes: str) -> dict[str, bytes]:
    return {f"poses/{name}.txt": text.encode() for name, text in (models.text() | changes).items()}


INVALID = "the job fails: `poses_invalid`"

MODELS = (
    *map(_start, model_bombs.MODELS),
    _posed(
        "300,000 cameras for three photos",
        lambda: _text(cameras="".join(f"{number} FOV 9 9 1 1 1 1 1\n" for number in range(300_000))),
        INVALID,
        "more than 200000 cameras",
    ),
    _posed(
        "300,000 photos without a name",
        lambda: {
            "poses/cameras.bin": models.binary()["cameras"],
            "poses/images.bin": model_bombs.short_images(300_000),
        },
        INVALID,
        "more than 200000 images",
    ),
    _posed(
        "a point seen by a photo 10 million times, in one line of text",
        lambda: _text(points3D="1 0 0 0 9 9 9 0.5" + " 1 0" * 10**7),
        INVALID,
        "1048576 bytes or more",
    ),
    _posed(
        "10 million empty objects in a transforms.json of 30 MB",
        lambda: {"poses/transforms.json": model_bombs.nested_json(10**7)},
        INVALID,
        "its lists and objects would take",
    ),
    _posed(
        "a file of points that announces 10^12 of them",
        lambda: {
            "poses/transforms.json": models.transforms_with_points(),
            "poses/points.ply": models.ply(10**12, rows=1),
        },
        "used: 3 cameras",
        "1000000000000 vertex rows",
    ),
)
