"""File names of a capture: whatever is accepted stays inside the capture's folder, and is accepted unchanged again.

Does not prove that the storage accepts every such name; the server's tests store the awkward ones.
"""

import unicodedata
from pathlib import PurePosixPath, PureWindowsPath

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from splatmill.schema import CaptureFile, Role, UnsafeName, safe_name

# Arbitrary text hardly ever contains the dangerous parts; these are mixed in on purpose.
PARTS = st.one_of(
    st.text(max_size=8), st.sampled_from(["..", ".", "", "~", "C:", "a", "\\", "\0", "#1", " ", "photo.jpg"])
)
NAMES = st.lists(PARTS, max_size=6).map("/".join)


@given(NAMES)
def test_an_accepted_name_cannot_leave_its_folder(name: str):
    try:
        safe = safe_name(name)
    except UnsafeName:
        return
    for flavour in (PurePosixPath, PureWindowsPath):
        path = flavour(safe)
        assert not path.is_absolute()
        assert not path.drive
        assert ".." not in path.parts
        assert path.parts == tuple(safe.split("/"))
    assert not any(unicodedata.category(char) == "Cc" for char in safe)
    assert safe_name(safe) == safe


@pytest.mark.parametrize(
    "name",
    [
        "",
        "/etc/passwd",
        "../x.jpg",
        "a/../../x.jpg",
        "a/./x.jpg",
        "a//x.jpg",
        "a/",
        "..",
        "C:/x.jpg",
        "c:x.jpg",
        "..\\x.jpg",
        "\\\\server\\x.jpg",
        "x\0.jpg",
        "x\n.jpg",
        "x\x7f.jpg",
        "\ud800.jpg",
        " x.jpg",
        "a /x.jpg",
        "x.jpg#17",
        "a" * 201,
        "é" * 101,
        "/".join(["a"] * 17),
        "/".join(["a" * 100] * 6),
    ],
)
def test_refused_names_are_explained(name: str):
    with pytest.raises(UnsafeName) as refused:
        safe_name(name)
    text = str(refused.value)
    assert text.endswith(".")
    assert len(text) < 400
    assert text.isascii(), "a name with control characters must not reach a terminal as it is"


@pytest.mark.parametrize(
    "name", ["IMG_0001.JPG", "train/r_0.png", "a b/ü (2).jpg", "写真.heic", "x#1.jpg", "...a", "100%.png"]
)
def test_ordinary_names_stay_as_they_are(name: str):
    assert safe_name(name) == name


def test_two_spellings_of_one_accent_are_one_name():
    assert safe_name("e\u0301.jpg") == safe_name("\u00e9.jpg") == "\u00e9.jpg"


def test_a_capture_file_has_a_safe_name_and_a_digest():
    CaptureFile(role=Role.images, name="a.jpg", size=1, sha256="0" * 64)
    with pytest.raises(ValidationError, match=r"contains the part '\.\.'"):
        CaptureFile(role=Role.images, name="../a.jpg", size=1, sha256="0" * 64)
    with pytest.raises(ValidationError, match="pattern"):
        CaptureFile(role=Role.images, name="a.jpg", size=1, sha256="0" * 63 + "G")
