"""Proves that the faults of a file are reported in plain words: no message of Python, and no path of the machine.

Not proven here: that every damaged file is refused at all (tests/hostile).
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.errors import Refusal, WorkerError
from splatmill_worker.images import guarded, signatures
from splatmill_worker.images.archives import archive
from splatmill_worker.images.examine import examine
from splatmill_worker.splat.formats import registry
from tests.support.posed_sets import frames, loaded, model, photos

PYTHON = re.compile(
    r"argument|object |NoneType|codec|Expecting|Errno|base 10|could not convert|delimiter|char \d|subscript|__|/tmp"
)


def plain(said: str, words: str) -> None:
    assert words in said
    assert PYTHON.search(said) is None, said


def zipped(*names: str) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as made:
        for name in names:
            made.writestr(name, "x" * 100)
    return data.getvalue()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (zipped(), "it is an empty zip file: there is no file in it"),
        (zipped("a.jpg")[:-30], "not a complete zip file (the list of its files, at its end, is missing"),
        (b"rubbish" * 100, "or no zip at all"),
        (b"Rar!\x1a\7\0" + bytes(100), "it is a RAR archive; unpack it, or pack the photos as a zip"),
        (zipped("a.jpg").replace(b"x" * 100, b"y" * 100), "its packed data are damaged or cut off"),
    ],
)
def test_zips(data: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(data)
    with pytest.raises(archive.UnsafeArchive) as error:
        archive.unpack(tmp_path / "a.zip", tmp_path / "out")
    plain(str(error.value), words)


def _frame(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda document: [frame.update(values) for frame in document["frames"]]


STRETCHED = np.diag([1.0, 1.0, 2.0, 1.0]).tolist()
SHEARED = [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_frame(transform_matrix=[[None] * 4] * 4), "transform_matrix has values that are not finite"),
        (_frame(transform_matrix=[[{}] * 4] * 4), "has other values than 4 x 4 or 3 x 4 numbers"),
        (_frame(transform_matrix=[[1, 2], [3]]), "has other values than 4 x 4 or 3 x 4 numbers"),
        (_frame(fl_x=[60]), "fl_x is '[60]', which is no number"),
        (_frame(k1="wide"), "k1 is 'wide', which is no number"),
        (_frame(w={}), "w is '{}', which is no number"),
        (_frame(transform_matrix=STRETCHED), "x, y and z are 1, 1, 2 long and at 90, 90, 90 degrees"),
        (_frame(transform_matrix=SHEARED), "x, y and z are 1, 1.12, 1 long and at 63, 90, 90 degrees"),
        (lambda document: document["frames"].append([]), "Frame 12 of transforms.json has no file_path"),
    ],
)
def test_frames(change: Callable[[dict[str, Any]], object], words: str, tmp_path: Path) -> None:
    photos(tmp_path / "images")
    document = {"w": 64, "h": 48, "fl_x": 60, "frames": frames()[:12]}
    change(document)
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    try:
        said = " ".join(reason for _, reason in loaded(tmp_path).left_out)
    except ValueError as error:
        said = str(error)
    plain(said, words)


def test_null_is_a_field_that_is_missing(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    document = {"w": 64, "h": 48, "fl_x": 60, "fl_y": None, "cx": None, "k1": None, "frames": frames()}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    camera = loaded(tmp_path).views[0].camera
    assert (camera.fy, camera.cx) == (60.0, 32.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b'{"frames": [\n1,,]}', "line 2 column 3 is no JSON"),
        (b"[" * 100_000, "nests too many objects or lists"),
    ],
)
def test_json(text: bytes, words: str, tmp_path: Path) -> None:
    photos(tmp_path / "images")
    (tmp_path / "transforms.json").write_bytes(text)
    with pytest.raises(ValueError, match=r"transforms\.json is not readable JSON") as error:
        loaded(tmp_path)
    plain(str(error.value), words)


@pytest.mark.parametrize(
    ("of", "to"), [("PINHOLE 64", "PINHOLE wide"), ("PINHOLE 64 48 60", "PINHOLE 64 48 f")]
)
def test_numbers_of_a_colmap_model(of: str, to: str, tmp_path: Path) -> None:
    photos(tmp_path / "images")
    model(tmp_path / "sparse/0", change=lambda text: text.replace(of, to).encode())
    with pytest.raises(ValueError, match=r"cameras\.txt could not be read") as error:
        loaded(tmp_path)
    plain(str(error.value), "number is needed")


def test_points_that_are_missing_are_a_warning(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    document = {"w": 64, "h": 48, "fl_x": 60, "frames": frames(), "ply_file_path": "sparse_pc.ply"}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    (said,) = loaded(tmp_path).warnings
    plain(
        said, "The points in sparse_pc.ply, which ply_file_path names, are not used: there is no such file."
    )


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.sog", b"PK\3\4" + b"\xfd" * 100, "it is no zip archive, or it is cut off"),
        ("a.sog", zipped("meta.json"), "line 1 column 1 is no JSON"),
        ("a.sog", zipped("other.json"), "meta.json is missing in it"),
        ("meta.json", b'{"version": 2, "count": 1, "means": 7}', "a value in it is of another kind"),
        ("meta.json", b'{"version": 2}', "'count' is missing"),
        ("a.spz", b"\x1f\x8b\x08" + bytes(60), "its gzip data are damaged"),
        ("a.glb", b"glTF\2\0\0\0\x20\0\0\0\x0c\0\0\0JSON{mesh:1}xxxx", "is no JSON"),
        ("a.splat", b"12345", "are no whole number of rows"),
        ("a.ksplat", b"12345", "could not be read as a .ksplat file"),
        ("a.glb", b"glT", "could not be read as a .glb"),
    ],
)
def test_models(name: str, data: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(WorkerError) as error:
        registry.read(tmp_path / name)
    plain(error.value.message, words)


FLOATS = (
    b"II*\0\x08\0\0\0\x03\0\x02\x01\x03\0\x01\0\0\0\x20\0\0\0"
    + b"\x15\x01\x03\0\x01\0\0\0\x03\0\0\0"
    + b"\x53\x01\x03\0\x01\0\0\0\x03\0\0\0"
    b"\0\0\0\0"
)
"""A TIFF of three channels of 32-bit floating-point numbers, without its pixels."""


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (FLOATS, "a TIFF whose 3 channels are 32-bit floating-point numbers, which may be linear light"),
        (FLOATS.replace(b"\x53\x01", b"\x12\xc6"), "a raw photo (DNG or another raw format in a TIFF)"),
        (b"\0\0\0\x18ftypcrx " + bytes(40), "a raw photo of Canon (CR3); develop it"),
        (b"v/1\x01" + bytes(40), "an OpenEXR picture, of linear light"),
        (b"GIF89a" + bytes(40), "a GIF picture; save it as PNG or JPEG"),
        (b"<html><body>404", "a text of HTML or XML, such as an error page of a download"),
        (b"version https://git-lfs.github.com/spec/v1\n", "a pointer of Git LFS in place of the file"),
        (bytes(40), "it is not an image, or its format is not supported; give JPEG"),
    ],
)
def test_pictures_that_are_not_read_are_named(data: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(data)
    said = examine(tmp_path / "a.jpg", "a.jpg")
    assert isinstance(said, str)
    plain(said, words)


def test_photos_that_cannot_be_read_are_not_blamed_on_the_poses(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    for path in (tmp_path / "images").iterdir():
        path.write_bytes(FLOATS)
    model(tmp_path / "sparse/0")
    with pytest.raises(Refusal) as error:
        loaded(tmp_path)
    assert error.value.code == "no_images"
    plain(
        error.value.message,
        "None of the 12 photos with a camera can be used, such as 'view 00.jpg': it is a TIFF",
    )


def test_a_photo_of_the_known_formats_is_not_taken_for_another(tmp_path: Path) -> None:
    """The signatures are asked of files that no reader takes: they must not be those of photos that are read."""
    for suffix in ("jpg", "png", "webp", "avif"):
        Image.new("RGB", (32, 32)).save(tmp_path / f"a.{suffix}")
        assert signatures.recognised(tmp_path / f"a.{suffix}") is None
    with guarded.opened(tmp_path / "a.png") as image:
        assert image.size == (32, 32)
