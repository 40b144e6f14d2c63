"""Changed files and headers end each parser with a result or a problem that has a name, and never take much memory.

`SPLATMILL_FUZZ_SECONDS=600 python -m pytest tests/hostile/test_fuzz.py --timeout 0` draws new inputs for ten minutes a
parser; otherwise each gets a few, the same ones every time. Not proven: that what a parser makes of a changed file is
what its author meant.
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from splatmill_server.answers.sse import Position
from tests.support.hostile import archives, models, pictures, videos
from tests.support.hostile.bench import Answer, Bench, bench
from tests.support.hostile.mutations import mutations, text_mutations

pytestmark = pytest.mark.slow

SECONDS = float(os.environ.get("SPLATMILL_FUZZ_SECONDS", "0"))
FEW = 12
"""Inputs of each parser in a run of all tests."""

MEMORY = 1 << 30
"""Bytes by which this process may grow over all inputs of a parser; the decoders have limits of their own."""

NAMED = ("used", "not used", "left out", "the job fails: `")


@pytest.fixture(scope="module")
def parts() -> Iterator[Bench]:
    with bench() as started:
        yield started


def fuzz(inputs: st.SearchStrategy[bytes], give: Callable[[bytes], object]) -> None:
    """Give a parser inputs: a few, or new ones until SECONDS are over."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    end = time.monotonic() + SECONDS
    once = not SECONDS

    @settings(
        max_examples=FEW if once else 200,
        derandomize=once,
        database=None,
        deadline=None,
        print_blob=True,
        phases=[Phase.generate] if once else [Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    @given(data=inputs)
    def check(data: bytes) -> None:
        give(data)

    check()
    while time.monotonic() < end:
        check()
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    assert grown < MEMORY


def named(answer: Answer) -> None:
    assert answer.kind.startswith(NAMED), answer
    assert "internal_error" not in answer.kind, answer


PHOTOS = {
    "photo.jpg": pictures.photo(),
    "photo.png": pictures.encoded(pictures.noise(), "PNG"),
    "photo.webp": pictures.encoded(pictures.noise(), "WEBP"),
    "turned.jpg": pictures.with_exif(pictures.turned_with_rubbish()),
    "photos.zip": archives.packed({"a.jpg": pictures.photo(1), "b/c.jpg": pictures.photo(2)}, 8),
    "video.mp4": videos.video(),
}


@pytest.mark.parametrize("name", PHOTOS)
def test_photos_zips_and_videos(parts: Bench, name: str) -> None:
    fuzz(mutations(PHOTOS[name]), lambda data: named(parts.prepared(f"images/{name}", data)))


def test_exif(parts: Bench) -> None:
    def give(data: bytes) -> None:
        named(parts.prepared("images/exif.jpg", pictures.with_exif(data[:60_000])))

    fuzz(mutations(pictures.turned_with_rubbish()), give)


def test_masks(parts: Bench) -> None:
    mask = pictures.encoded(pictures.noise().convert("L"), "PNG")
    fuzz(mutations(mask), lambda data: named(parts.prepared("masks/good.jpg.png", data)))


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_binary_colmap_models(parts: Bench, name: str) -> None:
    files = models.binary()
    if name == "points3D":
        files[name] = models.point_with_track(2) + bytes(16)

    def give(data: bytes) -> None:
        changed = files | {name: data}
        named(parts.posed({f"poses/sparse/0/{stem}.bin": content for stem, content in changed.items()}))

    fuzz(mutations(files[name]), give)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_colmap_models_as_text(parts: Bench, name: str) -> None:
    files = {stem: content.encode() for stem, content in models.text().items()}
    if name == "points3D":
        files[name] = b"1 0.5 0.5 2 255 0 0 0.1 1 0 2 0\n2 0.1 0.5 2 0 0 0 0.1 1 0\n"

    def give(data: bytes) -> None:
        changed = files | {name: data}
        named(parts.posed({f"poses/{stem}.txt": content for stem, content in changed.items()}))

    fuzz(text_mutations(files[name]), give)


def test_transforms(parts: Bench) -> None:
    fuzz(
        text_mutations(models.transforms()),
        lambda data: named(parts.posed({"poses/transforms.json": data})),
    )


STARTS = {
    ".ply": models.ply(3),
    ".compressed.ply": models.compressed_ply(chunks=1, count=256),
    ".spz": models.spz_of_zstd(count=4, held=4),
    ".ksplat": models.ksplat_header(0),
    ".splat": bytes(32 * 4),
}


@pytest.mark.parametrize("suffix", STARTS)
def test_models_to_start_from(parts: Bench, suffix: str) -> None:
    fuzz(mutations(STARTS[suffix]), lambda data: named(parts.start(data, suffix)))


FORM = (
    b'--B\r\nContent-Disposition: form-data; name="images"; filename="a.jpg"\r\nContent-Type: image/jpeg\r\n\r\n'
    b'photo\r\n--B\r\nContent-Disposition: form-data; name="options"\r\n\r\n{"steps": 5}\r\n--B--\r\n'
)


def test_forms(parts: Bench) -> None:
    def give(data: bytes) -> None:
        answer = parts.request("POST /v1/jobs", data, "Content-Type: multipart/form-data; boundary=B")
        assert answer.kind[:2] in ("20", "40", "41", "42"), answer

    fuzz(mutations(FORM), give)
    assert parts.request("GET /readyz").kind == "200"


def test_positions_in_a_stream_of_events() -> None:
    def give(data: bytes) -> None:
        text = data.decode("latin-1")
        position = Position.parse(text)
        assert position is None or Position.parse(str(position)) == position

    fuzz(text_mutations(b"1700000000000-3_1700000000000-1_2_5-0_6-1_7-2"), give)
