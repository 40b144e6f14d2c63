"""What a file is that is no photo of a format that is read: by its first bytes, and of a TIFF by its tags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL.TiffImagePlugin import ImageFileDirectory_v2

SIGNATURES = (
    (b"Rar!", 0, "a RAR archive; unpack it, or pack the photos as a zip"),
    (b"7z\xbc\xaf\x27\x1c", 0, "a 7z archive; unpack it, or pack the photos as a zip"),
    (b"\x1f\x8b", 0, "a gzip archive; unpack it, or pack the photos as a zip"),
    (b"PK\x03\x04", 0, "a zip archive"),
    (b"ftypcrx", 4, "a raw photo of Canon (CR3); develop it as JPEG or TIFF"),
    (b"FUJIFILMCCD-RAW", 0, "a raw photo of Fujifilm (RAF); develop it as JPEG or TIFF"),
    (b"IIU\0", 0, "a raw photo of Panasonic (RW2); develop it as JPEG or TIFF"),
    (b"IIRO", 0, "a raw photo of Olympus (ORF); develop it as JPEG or TIFF"),
    *(
        (brand, 4, "a video; give its name the suffix .mp4 or .mov")
        for brand in (b"ftypqt", b"ftypisom", b"ftypmp4")
    ),
    (b"v/1\x01", 0, "an OpenEXR picture, of linear light; convert it to sRGB and save it as PNG or TIFF"),
    (b"#?RADIANCE", 0, "a Radiance HDR picture, of linear light; convert it to sRGB and save it as PNG"),
    (b"BM", 0, "a BMP picture; save it as PNG or JPEG"),
    (b"GIF8", 0, "a GIF picture; save it as PNG or JPEG"),
    (b"8BPS", 0, "a picture of Photoshop; save it as PNG or TIFF"),
    (b"\xff\x0a", 0, "a JPEG XL picture; save it as PNG or JPEG"),
    (b"JXL ", 4, "a JPEG XL picture; save it as PNG or JPEG"),
    (b"jP  ", 4, "a JPEG 2000 picture; save it as PNG or JPEG"),
    (b"%PDF", 0, "a PDF document; save its pictures as JPEG"),
    (
        b"version https://git-lfs",
        0,
        "a pointer of Git LFS in place of the file; fetch it with `git lfs pull`",
    ),
    (b"<", 0, "a text of HTML or XML, such as an error page of a download; fetch the photo again"),
)
"""First bytes of files, with their offset: what the file is, and what to do."""

TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
BITS, COMPRESSION, PHOTOMETRIC, SAMPLES, FORMAT, DNG = 258, 259, 262, 277, 339, 50706
"""Tags of TIFF."""

CFA, LINEAR_RAW = 32803, 34892
"""Values of PHOTOMETRIC for the values of a sensor."""

FORMATS = {1: "integers", 2: "integers with a sign", 3: "floating-point numbers"}


def recognised(path: Path) -> str | None:
    """What the file is, and what to do, as a part of a sentence; None where it is not known."""
    with path.open("rb") as file:
        start = file.read(32)
        if not start.startswith(TIFF):
            return next((what for magic, at, what in SIGNATURES if start[at:].startswith(magic)), None)
        try:
            tags = ImageFileDirectory_v2(start[:8])
            file.seek(tags.next)
            tags.load(file)
        except Exception:  # whatever a damaged file leads to
            return None
    return _tiff(tags)


def _tiff(tags: Any) -> str:
    if DNG in tags or tags.get(PHOTOMETRIC) in (CFA, LINEAR_RAW):
        return "a raw photo (DNG or another raw format in a TIFF); develop it as JPEG or TIFF"
    bits, kinds = tags.get(BITS, (1,)), tags.get(FORMAT, (1,))
    kind = FORMATS.get(kinds[0] if isinstance(kinds, tuple) else kinds, "values of another kind")
    width = bits[0] if isinstance(bits, tuple) else bits
    linear = ", which may be linear light or values of sRGB" if kind == FORMATS[3] else ""
    return (
        f"a TIFF whose {tags.get(SAMPLES, 1)} channels are {width}-bit {kind}{linear}, with the compression "
        f"{tags.get(COMPRESSION, 1)}, which is not read; save it with 8 or 16 bits per channel, as sRGB"
    )
