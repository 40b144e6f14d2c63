"""Proves that photos come out as sRGB, whatever their colours are stored in: pictures are written from known sRGB
colours with profiles, tags and depths of their own, and decoded.

Not proven here: photos without a profile or tags, which are sRGB (test_images), and videos (test_video_frame).
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pillow_heif
import pytest
from PIL import Image, ImageCms

from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import decode, examine
from splatmill_worker.images.colors.colors import ADOBE_RGB, Colors, _rgb_to_xyz, _to_srgb, srgb
from splatmill_worker.images.colors.photo_colors import PhotoColors
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.prepare import prepare
from splatmill_worker.sfm import posed
from tests.support.posed_sets import frames
from tests.worker.images.video.test_video_frame import (
    KR_KB,
    TO_BT2020,
    TO_P3,
    chart,
    gamma,
    hlg,
    linear,
    pq,
    yuv,
)

Values = npt.NDArray[np.float64]

D50 = (0.9642, 1.0, 0.8249)
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
TO_ADOBE = np.array([[0.7152, 0.2848, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0412, 0.9588]])
"""Linear sRGB in the primaries of Adobe RGB."""


def icc(space: bytes, name: str, colorants: npt.NDArray[np.float64] | None, curve: float) -> bytes:
    """A profile of version 2 with the gamma `curve`: of RGB with `colorants` (columns, for D50), or of grey."""

    def xyz(values: Any) -> bytes:
        return b"XYZ \0\0\0\0" + b"".join(struct.pack(">i", round(value * 65536)) for value in values)

    text = name.encode() + b"\0"
    gray_or_red = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(curve * 256)) + b"\0\0"
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(78),
        b"cprt": b"text\0\0\0\0none\0",
        b"wtpt": xyz(D50),
    }
    if colorants is None:
        tags[b"kTRC"] = gray_or_red
    else:
        for channel, column in zip("rgb", colorants.T, strict=True):
            tags[f"{channel}XYZ".encode()] = xyz(column)
            tags[f"{channel}TRC".encode()] = gray_or_red
    table, body = struct.pack(">I", len(tags)), b""
    for tag, data in tags.items():
        table += tag + struct.pack(">II", 132 + 12 * len(tags) + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(
        ">IIII4s4s4s", 132 + 12 * len(tags) + len(body), 0, 0x02400000, 0x6D6E7472, space, b"XYZ ", bytes(4)
    )
    head = head[:36].ljust(36, b"\0") + b"acsp"
    head = head.ljust(68, b"\0") + xyz(D50)[8:]
    return head.ljust(128, b"\0") + table + body


def colorants(primaries: str) -> npt.NDArray[np.float64]:
    """Of D65, adapted to D50 by Bradford."""
    matrix = _rgb_to_xyz(primaries)
    ratio = (BRADFORD @ D50) / (BRADFORD @ matrix.sum(axis=1))
    return np.asarray(np.linalg.inv(BRADFORD) @ np.diag(ratio) @ BRADFORD @ matrix, np.float64)


DISPLAY_P3 = icc(b"RGB ", "Display P3", colorants("Display P3"), 2.2)
ADOBE = icc(b"RGB ", "Adobe RGB (1998)", colorants("Adobe RGB"), 2.2)


def stored(to: npt.NDArray[np.float64], curve: float = 2.2) -> npt.NDArray[np.uint8]:
    """The chart in other primaries, by a power."""
    light = (linear(chart()) @ to.T).clip(0, 1)
    return (light ** (1 / curve) * 255).round().astype(np.uint8)


def read(path: Path) -> npt.NDArray[np.int64]:
    return np.asarray(decode.decode(path).convert("RGB"), np.int64)


def warnings_of(folder: Path) -> tuple[str, ...]:
    return prepare(folder, None, folder.parent / "work").warnings


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp", "heic", "avif"])
@pytest.mark.parametrize(("profile", "to"), [(DISPLAY_P3, TO_P3), (ADOBE, TO_ADOBE)])
def test_profiles_are_followed_in_every_format(
    suffix: str, profile: bytes, to: Values, tmp_path: Path
) -> None:
    images = tmp_path / "images"
    images.mkdir()
    pillow_heif.register_heif_opener()
    options: dict[str, Any] = {"icc_profile": profile}
    if suffix in ("jpg", "webp", "heic", "avif"):
        options |= {"quality": 98, "subsampling": "4:4:4"} if suffix != "webp" else {"lossless": True}
    Image.fromarray(stored(to)).save(images / f"a.{suffix}", **options)
    error = read(images / f"a.{suffix}") - chart()
    assert np.abs(error).mean() < 1.5
    name = "Display P3" if profile == DISPLAY_P3 else "Adobe RGB (1998)"
    assert warnings_of(images) == (f"Colours of 1 of 1 photos: converted to sRGB from {name}.",)


def test_the_profile_of_srgb_changes_nothing(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(chart()).save(images / "a.png", icc_profile=profile)
    assert (read(images / "a.png") == chart()).all()
    assert warnings_of(images) == ()


def test_alpha_stays_and_grey_has_a_profile_too(tmp_path: Path) -> None:
    alpha = np.arange(64 * 96, dtype=np.uint8).reshape(64, 96, 1)
    Image.fromarray(np.concatenate([stored(TO_P3), alpha], axis=2)).save(
        tmp_path / "a.png", icc_profile=DISPLAY_P3
    )
    pixels = np.asarray(decode.decode(tmp_path / "a.png"), int)
    assert (pixels[..., 3:] == alpha).all()
    assert np.abs(pixels[..., :3] - chart()).mean() < 1.5
    grey = chart()[..., 0]
    light = linear(grey) ** (1 / 1.8) * 255
    Image.fromarray(light.round().astype(np.uint8)).save(
        tmp_path / "g.png", icc_profile=icc(b"GRAY", "Gray Gamma 1.8", None, 1.8)
    )
    assert np.abs(read(tmp_path / "g.png")[..., 0] - grey.astype(int)).mean() < 1.0


@pytest.mark.parametrize(
    "profile", [b"no profile", DISPLAY_P3[:200], icc(b"GRAY", "Gray Gamma 2.2", None, 2.2)]
)
def test_a_profile_that_cannot_be_used_is_a_warning(profile: bytes, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    Image.fromarray(chart()).save(images / "a.png", icc_profile=profile)
    assert (read(images / "a.png") == chart()).all()
    (warning,) = warnings_of(images)
    assert "taken as sRGB" in warning


def test_adobe_rgb_by_exif_alone(tmp_path: Path) -> None:
    """As cameras write it: the index of interoperability R03, and no profile."""
    exif = Image.Exif()
    exif.get_ifd(0xA005)[1] = "R03"
    exif[0x8769] = {0xA005: {1: "R03"}, 0xA001: 0xFFFF}
    Image.fromarray(stored(TO_ADOBE, 563 / 256)).save(
        tmp_path / "_DSC0001.jpg", exif=exif, quality=98, subsampling=0
    )
    with Image.open(tmp_path / "_DSC0001.jpg") as image:
        assert image.getexif().get_ifd(0xA005)[1] == "R03"
    assert np.abs(read(tmp_path / "_DSC0001.jpg") - chart()).mean() < 1.5
    assert decoders.photo_colors(tmp_path / "_DSC0001.jpg", "a") == "converted to sRGB from Adobe RGB"


DEEP = {
    "HLG": ((9, 18, 9), hlg, TO_BT2020),
    "PQ": ((9, 16, 9), pq, TO_BT2020),
    "Display P3": ((12, 13, 6), gamma, TO_P3),
    "sRGB": ((1, 13, 6), gamma, np.eye(3)),
}


def write_heic(path: Path, signal: Values, tags: tuple[int, int, int]) -> None:
    deep = (signal.clip(0, 1) * 65535).round().astype(np.uint16)
    image = pillow_heif.from_bytes(mode="RGB;16", size=deep.shape[1::-1], data=deep.tobytes())
    primaries, transfer, matrix = tags
    image.save(
        path,
        quality=98,
        chroma=444,
        color_primaries=primaries,
        transfer_characteristics=transfer,
        matrix_coefficients=matrix,
        full_range_flag=1,
    )


def write_avif(path: Path, signal: Values, tags: tuple[int, int, int]) -> None:
    with av.open(str(path), "w", format="avif") as container:
        stream: Any = container.add_stream("libsvtav1", rate=1, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = signal.shape[1], signal.shape[0], "yuv420p10le"
        context = stream.codec_context
        context.color_primaries, context.color_trc, context.colorspace = tags
        context.color_range = 1
        frame = yuv(signal.clip(0, 1), "yuv420p10le", KR_KB[{9: 9, 6: 5}[tags[2]]], full=False)
        frame.pts, frame.time_base = 0, Fraction(1, 1)
        frame.color_primaries, frame.color_trc, frame.colorspace = tags
        frame.color_range = 1
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_png(path: Path, signal: Values, tags: tuple[int, int, int]) -> None:
    """Behind the header of 25 bytes, the chunk cICP."""
    data = io.BytesIO()
    Image.fromarray((signal.clip(0, 1) * 255).round().astype(np.uint8)).save(data, "PNG")
    chunk = b"cICP" + bytes([*tags[:2], 0, 1])
    chunk = struct.pack(">I", 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    path.write_bytes(data.getvalue()[:33] + chunk + data.getvalue()[33:])


@pytest.mark.parametrize("kind", DEEP)
@pytest.mark.parametrize("suffix", ["heic", "avif", "png"])
def test_photos_of_ten_bits_are_read_by_their_tags(kind: str, suffix: str, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    tags, encode, to = DEEP[kind]
    signal = encode((linear(chart()) @ to.T).clip(0, None))
    write = {"heic": write_heic, "avif": write_avif, "png": write_png}[suffix]
    write(images / f"a.{suffix}", signal, tags)
    error = read(images / f"a.{suffix}") - chart()
    matt = (linear(chart()).max(axis=2) < 0.83)[..., None]
    # The readers give 8 bits; those of PQ are steps of two levels, and the encoder of AVIF is lossy.
    assert np.abs(error * matt).mean() < (3.0 if kind == "PQ" else 2.0)
    assert [kind in warning for warning in warnings_of(images)] == ([] if kind == "sRGB" else [True])


def with_chunks(data: bytes, **chunks: bytes) -> bytes:
    """A PNG with chunks behind its header of 33 bytes."""
    made = b"".join(
        struct.pack(">I", len(body))
        + kind.encode()
        + body
        + struct.pack(">I", zlib.crc32(kind.encode() + body))
        for kind, body in chunks.items()
    )
    return data[:33] + made + data[33:]


def points(*values: float) -> bytes:
    return struct.pack(f">{len(values)}I", *(round(value * 100_000) for value in values))


GAMMA = {power: points(1 / power) for power in (1.0, 1.8, 2.2)}
P3_POINTS = points(0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
WIDE = (0.3457, 0.3585, 0.7347, 0.2653, 0.1596, 0.8404, 0.0366, 0.0001)
"""ProPhoto, whose white is D50."""
CICP_P3, SRGB_CHUNK = bytes([12, 13, 0, 1]), b"\0"
PROFILE = b"p\0\0" + zlib.compress(ADOBE)


@pytest.mark.parametrize(
    ("chunks", "power", "to", "named"),
    [
        ({"gAMA": GAMMA[1.0]}, 1.0, np.eye(3), "sRGB, linear"),
        ({"gAMA": GAMMA[1.8]}, 1.8, np.eye(3), "sRGB, gamma 1.8"),
        ({"gAMA": GAMMA[2.2]}, None, np.eye(3), ""),
        ({"gAMA": GAMMA[2.2], "cHRM": P3_POINTS}, None, TO_P3, "Display P3"),
        ({"gAMA": GAMMA[1.0], "cHRM": P3_POINTS}, 1.0, TO_P3, "Display P3, linear"),
        ({"cHRM": points(*WIDE)}, None, np.linalg.inv(_to_srgb(WIDE)), "primaries of its own"),
        ({"cHRM": points(0.3, 0.3, *[0.5] * 6)}, None, np.eye(3), ""),
        ({"gAMA": points(0)}, None, np.eye(3), ""),
        ({"sRGB": SRGB_CHUNK, "gAMA": GAMMA[1.0]}, None, np.eye(3), ""),
        ({"gAMA": GAMMA[1.0], "iCCP": PROFILE}, 2.2, TO_ADOBE, "Adobe RGB (1998)"),
        ({"cICP": CICP_P3, "gAMA": GAMMA[1.0], "iCCP": PROFILE}, None, TO_P3, "Display P3"),
    ],
)
def test_a_png_is_read_by_the_first_of_its_chunks(
    chunks: dict[str, bytes], power: float | None, to: Values, named: str, tmp_path: Path
) -> None:
    light = (linear(chart()) @ to.T).clip(0, 1)
    signal = gamma(light) if power is None else light ** (1 / power)
    data = io.BytesIO()
    Image.fromarray((signal * 255).round().astype(np.uint8)).save(data, "PNG")
    path = tmp_path / "a.png"
    path.write_bytes(with_chunks(data.getvalue(), **chunks))
    # Eight bits of linear light are too few for the dark.
    bright = chart() > (120 if power == 1.0 else 0)
    assert np.abs((read(path) - chart()) * bright).mean() < 1.5
    remark = f"converted to sRGB from {named}" if named else ""
    assert decoders.photo_colors(path, "a").partition(";")[0] == remark


def adobe_space(space: int, **tags: Any) -> Image.Exif:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = space
    exif[0x8769] = {0xA001: space, **({0xA500: tags["power"]} if "power" in tags else {})}
    if "points" in tags:
        exif[0x013E], exif[0x013F] = tags["points"][:2], tags["points"][2:]
    return exif


ADOBE_POINTS = (0.3127, 0.329, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06)


@pytest.mark.parametrize(
    ("exif", "named"),
    [
        (adobe_space(2), "converted to sRGB from Adobe RGB"),
        (adobe_space(0xFFFF, points=ADOBE_POINTS, power=2.2), "converted to sRGB from Adobe RGB"),
        (adobe_space(1, points=ADOBE_POINTS), ""),
        (
            adobe_space(0xFFFF),
            "taken as sRGB, since their EXIF says that they are in another colour space and names none",
        ),
    ],
)
@pytest.mark.parametrize("suffix", ["jpg", "webp", "tif"])
def test_other_spaces_by_exif_alone(exif: Image.Exif, named: str, suffix: str, tmp_path: Path) -> None:
    Image.fromarray(chart()).save(tmp_path / f"a.{suffix}", exif=exif)
    assert decoders.photo_colors(tmp_path / f"a.{suffix}", "a") == named


def test_the_power_of_exif(tmp_path: Path) -> None:
    light = (linear(chart()) * 255).round().astype(np.uint8)
    Image.fromarray(light).save(
        tmp_path / "a.jpg", exif=adobe_space(0xFFFF, power=1.0), quality=100, subsampling=0
    )
    assert np.abs((read(tmp_path / "a.jpg") - chart()) * (chart() > 120)).mean() < 1.5


def test_a_profile_of_grey_holds_with_transparent_pixels_too(tmp_path: Path) -> None:
    grey = chart()[..., 0]
    light = (linear(grey) ** (1 / 1.8) * 255).round().astype(np.uint8)
    alpha = np.full_like(light, 200)
    profile = icc(b"GRAY", "Gray Gamma 1.8", None, 1.8)
    Image.merge("LA", [Image.fromarray(light), Image.fromarray(alpha)]).save(
        tmp_path / "a.png", icc_profile=profile
    )
    pixels = np.asarray(decode.decode(tmp_path / "a.png"), int)
    assert np.abs(pixels[..., 0] - grey.astype(int)).mean() < 1.0
    assert (pixels[..., 3] == 200).all()


def test_lab_and_cmyk_without_a_profile(tmp_path: Path) -> None:
    photo = Image.fromarray(chart())
    lab = ImageCms.profileToProfile(
        photo, ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB"), outputMode="LAB"
    )
    assert lab is not None
    lab.save(tmp_path / "lab.tif")
    assert np.abs(read(tmp_path / "lab.tif") - chart()).mean() < 2.0
    photo.convert("CMYK").save(tmp_path / "cmyk.tif")
    assert "CMYK without an ICC profile" in decoders.photo_colors(tmp_path / "cmyk.tif", "a")
    Image.fromarray(chart()[..., 0].astype(np.float32) / 255).save(tmp_path / "float.tif")
    assert (read(tmp_path / "float.tif")[..., 0] == chart()[..., 0]).all()
    assert "taken as values of sRGB" in decoders.photo_colors(tmp_path / "float.tif", "a")


def test_floats_beyond_white_are_left_out(tmp_path: Path) -> None:
    Image.fromarray(chart()[..., 0].astype(np.float32)).save(tmp_path / "float.tif")
    reason = f"its floating-point numbers reach {chart()[..., 0].max()}, and are read from 0 to 1"
    with pytest.raises(UnusablePicture, match=reason):
        read(tmp_path / "float.tif")
    assert str(examine.examine(tmp_path / "float.tif", "float.tif")).startswith(reason)


@pytest.mark.parametrize(("suffix", "codec"), [("png", "png"), ("tif", "tiff")])
def test_sixteen_bits_are_read_as_eight(suffix: str, codec: str, tmp_path: Path) -> None:
    deep = chart().astype(np.uint16) * 257
    encoder: Any = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height = deep.shape[1], deep.shape[0]
    encoder.pix_fmt, encoder.time_base = ("rgb48be" if codec == "png" else "rgb48le"), Fraction(1, 1)
    frame = av.VideoFrame.from_ndarray(deep, format="rgb48le").reformat(format=encoder.pix_fmt)
    (tmp_path / f"a.{suffix}").write_bytes(b"".join(bytes(packet) for packet in encoder.encode(frame)))
    assert (read(tmp_path / f"a.{suffix}") == chart()).all()
    Image.fromarray(deep[..., 0]).save(tmp_path / f"g.{suffix}")
    assert (np.asarray(decode.decode(tmp_path / f"g.{suffix}")) == chart()[..., 0]).all()


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_a_fine_ramp_of_sixteen_bits_is_neither_banded_nor_clipped(suffix: str, tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(0, 65535, 4096).round().astype(np.uint16), (16, 1))
    deep = np.stack([ramp] * 3, axis=-1)
    encoder: Any = av.CodecContext.create("png" if suffix == "png" else "tiff", "w")
    encoder.width, encoder.height = ramp.shape[1], ramp.shape[0]
    encoder.pix_fmt, encoder.time_base = ("rgb48be" if suffix == "png" else "rgb48le"), Fraction(1, 1)
    frame = av.VideoFrame.from_ndarray(deep, format="rgb48le").reformat(format=encoder.pix_fmt)
    (tmp_path / f"a.{suffix}").write_bytes(b"".join(bytes(packet) for packet in encoder.encode(frame)))
    Image.fromarray(ramp).save(tmp_path / f"g.{suffix}")
    for values in (
        read(tmp_path / f"a.{suffix}")[..., 1],
        np.asarray(decode.decode(tmp_path / f"g.{suffix}")),
    ):
        assert np.abs(values[8] - ramp[8] / 257.0).max() < 1.0
        assert len(np.unique(values[8])) == 256


@pytest.mark.parametrize("layout", ["gray16", "rgb48", "rgba64"])
@pytest.mark.parametrize("suffix", ["png", "raw.tif", "lzw.tif"])
def test_sixteen_bits_are_rounded_to_the_nearest_level(suffix: str, layout: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    deep = rng.permuted(np.tile(np.arange(65536, dtype=np.uint16), (4, 1)), axis=1).reshape(4, 128, 512)
    deep = np.ascontiguousarray(
        np.moveaxis(deep, 0, 2)[..., : {"gray16": 1, "rgb48": 3, "rgba64": 4}[layout]]
    )
    options = {"compression_algo": suffix.split(".")[0]} if suffix != "png" else {}
    encoder: Any = av.CodecContext.create("png" if suffix == "png" else "tiff", "w")
    encoder.width, encoder.height, encoder.options = 512, 128, options
    encoder.pix_fmt, encoder.time_base = layout + ("be" if suffix == "png" else "le"), Fraction(1, 1)
    frame = av.VideoFrame.from_ndarray(deep[..., 0] if deep.shape[2] == 1 else deep, format=f"{layout}le")
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(
        b"".join(bytes(packet) for packet in encoder.encode(frame.reformat(format=encoder.pix_fmt)))
    )
    values = np.asarray(decode.decode(path), np.float64).reshape(deep.shape)
    assert np.abs(values - deep / 257.0).max() <= 0.5


@pytest.mark.parametrize(
    ("tags", "step"),
    [
        (Colors("BT.2020", "PQ"), 4),
        (Colors("BT.2020", "HLG"), 2),
        (Colors("sRGB", "linear"), 13),
        (Colors("sRGB", "gamma 1.8"), 2),
        (Colors("Display P3", "sRGB"), 1),
        (ADOBE_RGB, 2),
    ],
)
def test_tones_that_are_lost_are_said_with_the_figure(tags: Colors, step: int) -> None:
    colors = PhotoColors(tags=tags)
    assert colors.largest_step() == step
    assert (f" {step} of 255 levels" in colors.remark("RGB")) == (step > 2)


def test_a_linear_profile_is_said_to_lose_tones_as_linear_tags_are() -> None:
    profile = icc(b"RGB ", "linear", colorants("Display P3"), 1.0)
    assert PhotoColors(profile).largest_step() == 13
    assert " 13 of 255 levels" in PhotoColors(profile).remark("RGB")
    assert "levels" not in PhotoColors(DISPLAY_P3).remark("RGB")


@pytest.mark.parametrize(
    "colors", [Colors("BT.2020", "PQ"), Colors("BT.2020", "HLG"), Colors("sRGB", "PQ")], ids=str
)
def test_hdr_photos_are_converted_as_the_rule_has_it_in_all_colours(colors: Colors) -> None:
    grey = np.repeat(np.arange(256)[:, None], 3, axis=1)
    values = np.concatenate([grey, np.random.default_rng(0).integers(0, 256, (4096, 3))]).astype(np.uint8)
    converted = np.asarray(PhotoColors(tags=colors).srgb(Image.fromarray(values[None])), np.float64)[0]
    assert np.abs(converted - srgb(values / 255.0, colors) * 255.0).max() <= 0.75


def test_photos_that_come_with_cameras_are_named_too(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    names = [f"{number}.jpg" for number in range(3)]
    for number, name in enumerate(names):
        profile = DISPLAY_P3 if number else None
        Image.fromarray(stored(TO_P3)).save(
            tmp_path / "images" / name, icc_profile=profile, quality=90 + number
        )
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames(names)}))
    poses = posed.find(tmp_path)
    assert poses is not None
    assert "Colours of 2 of 3 photos: converted to sRGB from Display P3." in poses.load().warnings


def test_masks_keep_black_and_white_whatever_their_profile(tmp_path: Path) -> None:
    mask = np.zeros((64, 96, 3), np.uint8)
    mask[:32] = 255
    Image.fromarray(mask).save(tmp_path / "a.png", icc_profile=ADOBE)
    assert (read(tmp_path / "a.png") == mask).all()


def test_the_names_of_colours() -> None:
    assert str(Colors("BT.2020", "PQ")) == "BT.2020, PQ"
    assert str(Colors("Display P3", "sRGB")) == "Display P3"
    assert io.BytesIO(DISPLAY_P3).getbuffer().nbytes == struct.unpack(">I", DISPLAY_P3[:4])[0]
