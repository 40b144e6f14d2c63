"""Every parser of bytes from strangers: what it is given, and what must be true of what becomes of it.

`tests/hostile/test_fuzz.py` gives each parser a few inputs, `splatmill bench fuzz` new ones for minutes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from starlette.datastructures import Headers

from splatmill.schema.headers import read_retry_after
from splatmill_server.access.browsers import check_origin
from splatmill_server.base.outgoing import AddressRefused, Outgoing
from splatmill_server.base.paging import read_cursor, write_cursor
from splatmill_server.base.problems import ProblemError
from splatmill_server.responses.sse import Position
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import registry
from tests.support.gaussians import some_gaussians
from tests.support.hostile import archives, models, pictures, videos
from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.mutations import mutations, text_mutations

NAMED = ("used", "not used", "left out", "the job fails: `")


@dataclass(frozen=True)
class Parser:
    """A parser and the files that it is given.

    valid: returns a file that it accepts, which is changed.
    change: draws changed files.
    give: gives the parser a file, fails an assertion where the outcome is none that it may have, and returns the
        outcome in a word or two.
    """

    valid: Callable[[], bytes]
    change: Callable[[bytes], st.SearchStrategy[bytes]]
    give: Callable[[Bench, bytes], str]

    def try_changed(self, give: Callable[[bytes], object], count: int, number: int) -> None:
        """Call `give` with `count` changed files, the same ones for the same number. A failure names the shortest."""

        @seed(number)
        @settings(
            max_examples=count,
            database=None,
            deadline=None,
            phases=[Phase.generate, Phase.shrink],
            suppress_health_check=list(HealthCheck),
        )
        @given(data=self.change(self.valid()))
        def check(data: bytes) -> None:
            give(data)

        check()


def _outcome(answer: Answer) -> str:
    assert answer.kind.startswith(NAMED), answer
    assert "internal_error" not in answer.kind, answer
    return answer.kind.partition(":")[0] if answer.kind.startswith("used") else answer.kind


def _photo(name: str, valid: Callable[[], bytes]) -> Parser:
    return Parser(valid, mutations, lambda bench, data: _outcome(bench.prepared(f"images/{name}", data)))


def _exif(bench: Bench, data: bytes) -> str:
    return _outcome(bench.prepared("images/exif.jpg", pictures.with_exif(data[:60_000])))


def _colmap(stem: str, suffix: str) -> Parser:
    binary = suffix == ".bin"
    folder = "poses/sparse/0/" if binary else "poses/"

    def files() -> dict[str, bytes]:
        if binary:
            return models.binary() | {"points3D": models.point_with_track(2) + bytes(16)}
        contents = {name: content.encode() for name, content in models.text().items()}
        return contents | {"points3D": b"1 0.5 0.5 2 255 0 0 0.1 1 0 2 0\n2 0.1 0.5 2 0 0 0 0.1 1 0\n"}

    def give(bench: Bench, data: bytes) -> str:
        changed = files() | {stem: data}
        return _outcome(
            bench.posed({f"{folder}{name}{suffix}": content for name, content in changed.items()})
        )

    return Parser(lambda: files()[stem], mutations if binary else text_mutations, give)


def _start(suffix: str, valid: Callable[[], bytes]) -> Parser:
    """The reader of a format, in this process: one of its own for each file would be most of the time."""

    def give(bench: Bench, data: bytes) -> str:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"start{suffix}"
            path.write_bytes(data)
            try:
                registry.read(path)
            except ModelUnreadable:
                return "not used"
        return "used"

    return Parser(valid, mutations, give)


@cache
def _written(suffix: str) -> bytes:
    """A model of a few Gaussians in a format that this project writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"model{suffix}"
        registry.write(path, some_gaussians(3, 1))
        return path.read_bytes()


_FORM = (
    b'--B\r\nContent-Disposition: form-data; name="images"; filename="a.jpg"\r\nContent-Type: image/jpeg\r\n\r\n'
    b'photo\r\n--B\r\nContent-Disposition: form-data; name="options"\r\n\r\n{"steps": 5}\r\n--B--\r\n'
)


def _form(bench: Bench, data: bytes) -> str:
    answer = bench.request("POST /v1/jobs", data, "Content-Type: multipart/form-data; boundary=B")
    assert answer.kind[:2] in ("20", "40", "41", "42"), answer
    assert bench.request("GET /readyz").kind == "200"
    return answer.kind


def _position(bench: Bench, data: bytes) -> str:
    position = Position.parse(data.decode("latin-1"))
    assert position is None or Position.parse(str(position)) == position
    return "not used" if position is None else "used"


def _pause(bench: Bench, data: bytes) -> str:
    seconds = read_retry_after(data.decode("latin-1"))
    assert seconds is None or 0.0 <= seconds < 1e15
    return "not used" if seconds is None else "used"


def _cursor(bench: Bench, data: bytes) -> str:
    try:
        moment, _ = read_cursor(data.decode("latin-1"))
    except ProblemError as error:
        return error.problem.code
    assert 0 <= moment < 10**15
    return "used"


def _address(bench: Bench, data: bytes) -> str:
    try:
        url = Outgoing().checked(data.decode("latin-1"))
    except AddressRefused:
        return "refused"
    assert url.host
    return "used"


def _origin(bench: Bench, data: bytes) -> str:
    headers = Headers({"host": "localhost", "origin": data.decode("latin-1")})
    try:
        check_origin({"method": "POST"}, headers, ["*.example.org"], required=True)
    except ProblemError as error:
        return error.problem.code
    return "used"


PARSERS: dict[str, Parser] = {
    "JPEG": _photo("photo.jpg", pictures.photo),
    "PNG": _photo("photo.png", lambda: pictures.encoded(pictures.noise(), "PNG")),
    "WebP": _photo("photo.webp", lambda: pictures.encoded(pictures.noise(), "WEBP")),
    "orientation of a photo": _photo(
        "turned.jpg", lambda: pictures.with_exif(pictures.turned_with_rubbish())
    ),
    "EXIF": Parser(pictures.turned_with_rubbish, mutations, _exif),
    "mask": Parser(
        lambda: pictures.encoded(pictures.noise().convert("L"), "PNG"),
        mutations,
        lambda bench, data: _outcome(bench.prepared("masks/good.jpg.png", data)),
    ),
    "zip": _photo(
        "photos.zip", lambda: archives.packed({"a.jpg": pictures.photo(1), "b/c.jpg": pictures.photo(2)}, 8)
    ),
    "video": _photo("video.mp4", videos.video),
    **{
        f"COLMAP {stem}{suffix}": _colmap(stem, suffix)
        for suffix in (".bin", ".txt")
        for stem in ("cameras", "images", "points3D")
    },
    "transforms.json": Parser(
        models.transforms,
        text_mutations,
        lambda bench, data: _outcome(bench.posed({"poses/transforms.json": data})),
    ),
    "points of transforms.json": Parser(
        lambda: models.ply(3),
        mutations,
        lambda bench, data: _outcome(
            bench.posed({"poses/transforms.json": models.transforms_with_points(), "poses/points.ply": data})
        ),
    ),
    ".ply": _start(".ply", lambda: models.ply(3)),
    ".compressed.ply": _start(".compressed.ply", lambda: models.compressed_ply(chunks=1, count=256)),
    ".spz": _start(".spz", lambda: models.spz_of_zstd(count=4, held=4)),
    ".ksplat": _start(".ksplat", lambda: models.ksplat_header(0)),
    ".splat": _start(".splat", lambda: bytes(32 * 4)),
    ".sog": _start(".sog", lambda: _written(".sog")),
    ".glb": _start(".glb", lambda: _written(".glb")),
    "form": Parser(lambda: _FORM, mutations, _form),
    "Retry-After": Parser(lambda: b"Mon, 01 Jan 2024 00:00:00 GMT", text_mutations, _pause),
    "cursor": Parser(lambda: write_cursor(1_700_000_000_000, "0" * 16).encode(), text_mutations, _cursor),
    "address": Parser(lambda: b"https://xn--bcher-kva.example:8443/a%20b.jpg?c", text_mutations, _address),
    "Origin": Parser(lambda: b"https://a.example.org:8443", text_mutations, _origin),
    "Last-Event-ID": Parser(
        lambda: b"1700000000000-3_1700000000000-1_2_5-0_6-1_7-2", text_mutations, _position
    ),
}
"""By the name of what is parsed."""
