"""Hostile cameras that come with photos, and models to start from."""

from __future__ import annotations

import gzip
import json
import struct

from PIL import Image

from tests.support.hostile import archives, models, pictures
from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.entry import Hostile
from tests.support.hostile.pictures import encoded, photo

INVALID = "the job fails: `poses_invalid`"
USED = "used: 3 cameras"
UNUSABLE = "the job fails: `start_unusable`"


def _transforms(what: str, data: bytes, kind: str = INVALID, said: str = "") -> Hostile:
    return Hostile("Poses", what, lambda bench: bench.posed({"poses/transforms.json": data}), kind, said)


def _beside(what: str, name: str, data: bytes | None, kind: str, said: str) -> Hostile:
    """Cameras as they should be, and one other file; None: the bomb."""

    def give(bench: Bench) -> Answer:
        content = pictures.bomb() if data is None else data
        return bench.posed({"poses/transforms.json": models.transforms(), name: content})

    return Hostile("Photos and masks with given cameras", what, give, kind, said)


def _colmap(what: str, changes: dict[str, bytes | None], kind: str = INVALID, said: str = "") -> Hostile:
    """A binary COLMAP model with some of its files changed, or left out where None."""

    def give(bench: Bench) -> Answer:
        files = {name: data for name, data in (models.binary() | changes).items() if data is not None}
        return bench.posed({f"poses/sparse/0/{name}.bin": data for name, data in files.items()})

    return Hostile("Poses", what, give, kind, said)


def _text(what: str, changes: dict[str, str], kind: str = INVALID, said: str = "") -> Hostile:
    def give(bench: Bench) -> Answer:
        files = models.text() | changes
        return bench.posed({f"poses/{name}.txt": data.encode() for name, data in files.items()})

    return Hostile("Poses", what, give, kind, said)


def _document(**values: object) -> bytes:
    return json.dumps(json.loads(models.transforms()) | values).encode()


def _start(what: str, data: bytes, kind: str = UNUSABLE, said: str = "", *, suffix: str = ".ply") -> Hostile:
    return Hostile("Models to start from", what, lambda bench: bench.start(data, suffix), kind, said)


def _scaled(factors: tuple[float, float, float]) -> list[list[float]]:
    rows = models.matrix(1.0)
    return [[value * factor for value, factor in zip(row, (*factors, 1.0), strict=True)] for row in rows]


HUGE = struct.pack("<Q", 1 << 50)

POSES = (
    _transforms(
        "a matrix of NaN", models.transforms(transform_matrix=[[float("nan")] * 4] * 4), said="not finite"
    ),
    _transforms(
        "a singular rotation", models.transforms(transform_matrix=_scaled((1, 1, 0))), said="determinant"
    ),
    _transforms(
        "a mirrored rotation", models.transforms(transform_matrix=_scaled((1, 1, -1))), said="determinant"
    ),
    _transforms("a matrix of text", models.transforms(transform_matrix="rm -rf"), said="Frame 0"),
    _transforms(
        "a position of 1e300", models.transforms(transform_matrix=models.matrix(1e300)), said="above"
    ),
    _transforms(
        "names of no photo", models.transforms(3).replace(b".jpg", b"x.jpg"), said="none of their photos"
    ),
    _transforms(
        "`file_path` of another place",
        models.transforms(file_path="../../etc/passwd"),
        "used: 2 cameras",
        "no such photo",
    ),
    _transforms(
        "`ply_file_path` of another place",
        _document(ply_file_path="../../../etc/passwd"),
        USED,
        "outside the capture",
    ),
    _transforms("`mask_path` with a NUL byte", models.transforms(mask_path="a\0b"), USED),
    _transforms("a width of infinity", models.transforms(w=float("inf")), said="Frame 0"),
    _transforms("a width of 10^400", models.transforms(w=10**400), said="Frame 0"),
    _transforms(
        "an angle of zero",
        _document(
            fl_x=None,
            frames=[{"file_path": "1.jpg", "transform_matrix": models.matrix(1.0), "camera_angle_x": 0}],
        ),
        said="Frame 0",
    ),
    _transforms("`test_filenames` that is a number", _document(test_filenames=7), said="test_filenames"),
    _transforms("100,000 brackets", b"[" * 100_000, said="not readable JSON"),
    _transforms("bytes that are not UTF-8", b'{"frames": "\xff"}', said="no list `frames`"),
    _transforms("a list for an object", b"[]", said="frames"),
    _transforms("65 MB", b" " * 65 * 2**20, said="at most"),
    _transforms("a principal point at 1e300", models.transforms(cx=1e300), said="Frame 0"),
    _beside("a photo of 675 megapixels", "images/1.jpg", None, "used: 2 cameras", "27000 x 25000 pixels"),
    _beside(
        "a photo that is cut off", "images/1.jpg", photo()[:-600], "used: 2 cameras", "not decode completely"
    ),
    _beside("a photo that is an EPS", "images/1.jpg", pictures.EPS, "used: 2 cameras", "not an image"),
    _beside(
        "a mask of 675 megapixels", "masks/1.png", None, "the job fails: `image_too_large`", "masks/1.png"
    ),
    _beside(
        "a mask of another shape than its photo",
        "masks/1.png",
        encoded(Image.new("L", (64, 64)), "PNG"),
        USED,
        "shape differs",
    ),
    _colmap("no points", {"points3D": None}, USED),
    _colmap("an empty file of points", {"points3D": b""}, USED),
    _colmap("2^50 points in 8 bytes", {"points3D": HUGE}, said="points3D.bin"),
    _colmap("2^50 photos in 8 bytes", {"images": HUGE}, said="images.bin"),
    _colmap(
        "2^40 features of a photo, in none", {"images": models.image_with_points(1 << 40)}, said="images.bin"
    ),
    _colmap(
        "2^40 sightings of a point, in none",
        {"points3D": models.point_with_track(1 << 40)},
        said="points3D.bin",
    ),
    _colmap("no cameras", {"images": b""}, said="images.bin"),
    _text("a rotation of zeros", {"images": "1 0 0 0 0 1 0 5 1 1.jpg\n\n"}, said="rotation of '1.jpg'"),
    _text("a focal length of -60", {"cameras": "1 PINHOLE 64 48 -60 60 32 24\n"}, said="Camera 1"),
    _text("a lens that does not exist", {"cameras": "1 FISH 64 48 60 32 24\n"}, said="could not be read"),
    _text("points seen by no photo", {"points3D": "1 0 0 0 9 9 9 0.5 77 0\n"}, said="could not be read"),
    _start("no .ply", b"rubbish", said="begin with 'ply'"),
    _start("a header without an end", b"ply\n" + b"comment x\n" * 10_000, said="does not end"),
    _start("10^12 Gaussians in 52 bytes", models.ply(10**12, rows=1), said="1000000000000 vertex rows"),
    _start("-1 Gaussians", models.ply(-1, rows=0), said="-1 vertex rows"),
    _start(
        "10^12 Gaussians of text", models.ply(10**12, rows=1, kind="ascii"), said="1000000000000 vertex rows"
    ),
    _start("NaN in every Gaussian", models.ply(3, value=float("nan")), said="no Gaussian with finite values"),
    _start(
        "lists for numbers",
        models.ply(1, value=-1.0).replace(b"property float x", b"property list uint float x"),
        said="ends in row 0 of 1 vertex rows",
    ),
    _start(
        "a mesh",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
        said="missing",
    ),
    _start(
        "chunks of a compressed .ply for fewer Gaussians than it has",
        models.compressed_ply(chunks=1, count=300),
        said="300 Gaussians and 1 chunks",
    ),
    _start(
        "an .spz of 90 bytes that announces 4 thousand million Gaussians",
        gzip.compress(models.spz_header(2**32 - 1) + bytes(900), mtime=0),
        said="4,294,967,295 Gaussians would take",
        suffix=".spz",
    ),
    _start(
        "an .spz of 200 kB that expands to 200 MB",
        archives.gzip_of_zeros(models.spz_header(10**7), 200),
        said="more than 400 times",
        suffix=".spz",
    ),
    _start(
        "an .spz that is cut off",
        gzip.compress(models.spz_header(9) + bytes(180))[:-12],
        said="gzip data end",
        suffix=".spz",
    ),
    _start(
        "an .spz whose zstd frames hold more than they announce",
        models.spz_of_zstd(count=4, held=400),
        said="more than 36 bytes",
        suffix=".spz",
    ),
    _start("a .splat of half a row", bytes(48), said="no whole number of rows", suffix=".splat"),
    _start("a .splat of NaN", b"\xff" * 64, said="no Gaussian with finite values", suffix=".splat"),
    _start(
        "a .ksplat that announces 4 thousand million sections",
        models.ksplat_header(sections=2**32 - 1),
        said="4294967295 sections",
        suffix=".ksplat",
    ),
    _start(
        "a .ksplat with 4 thousand million Gaussians in a section",
        models.ksplat_header(sections=1) + bytes.fromhex("ffffffff" * 2) + bytes(1016),
        said="ends at byte",
        suffix=".ksplat",
    ),
)
