"""Proves that frames of a video have the colours, the shape and the orientation that its tags name, at times that begin
anywhere: clips are encoded from known RGB pictures by each kind of tags, and the frames are compared with these.

Not proven here: which frames are taken (test_video).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from splatmill_worker.images.colors.colors import Colors, srgb, srgb_pixels
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.prepare import prepare
from splatmill_worker.images.video import video_frame

Pixels = npt.NDArray[np.uint8]
Values = npt.NDArray[np.float64]
WIDTH, HEIGHT = 96, 64

TO_BT2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
TO_P3 = np.array([[0.8225, 0.1775, 0.0], [0.0332, 0.9668, 0.0], [0.0171, 0.0724, 0.9105]])
"""Linear sRGB in other primaries, as BT.2087 and Apple publish it."""


def chart(width: int = WIDTH, height: int = HEIGHT) -> Pixels:
    """Smooth colours of every hue, dark and light, which chroma subsampling changes little."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    light = 0.15 + 0.7 * y
    hue = np.stack([np.cos(6.283 * (x - shift)) for shift in (0.0, 1 / 3, 2 / 3)], axis=-1)
    return ((light[..., None] + 0.13 * hue) * 255).round().clip(0, 255).astype(np.uint8)


def linear(picture: npt.NDArray[Any]) -> Values:
    values = picture / 255.0
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def gamma(light: Values) -> Values:
    light = light.clip(0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def hlg(light: Values) -> Values:
    """BT.2100's OETF of light whose reference white is at 75 %."""
    e = light.clip(0) * 0.26497
    return np.where(
        e <= 1 / 12, np.sqrt(3 * e), 0.17883277 * np.log(np.maximum(12 * e - 0.28466892, 1e-6)) + 0.55991073
    )


def pq(light: Values) -> Values:
    """BT.2100's inverse EOTF of light whose reference white is at 203 cd/m2."""
    power = (light.clip(0) * 203 / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


def clip(
    path: Path,
    pictures: Sequence[Values],
    *,
    codec: str = "ffv1",
    form: str = "yuv444p",
    tags: tuple[int, int, int, int] = (2, 2, 2, 0),
    matrix: int | None = None,
    full: bool = False,
    stamps: Sequence[int] | None = None,
    aspect: Fraction | None = None,
    options: dict[str, str] | None = None,
) -> Path:
    """A video of pictures with values from 0 to 1; tags are primaries, transfer function, matrix and range.

    matrix: the one that is used, by swscale's number.
    stamps: milliseconds.
    """
    height, width = pictures[0].shape[:2]
    with av.open(str(path), "w", options=options or {}) as container:
        stream: Any = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = width, height, form
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        if codec.startswith("libx26"):
            stream.options = {"crf": "4"}
        if aspect:
            stream.codec_context.sample_aspect_ratio = aspect
        context = stream.codec_context
        context.color_primaries, context.color_trc, context.colorspace, context.color_range = tags
        for number, picture in enumerate(pictures):
            frame = yuv(picture, form, None if matrix is None else KR_KB[matrix], full)
            frame.color_primaries, frame.color_trc, frame.colorspace, frame.color_range = tags
            frame.time_base = Fraction(1, 1000)
            frame.pts = number * 100 if stamps is None else stamps[number]
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


KR_KB = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 7: (0.212, 0.087), 9: (0.2627, 0.0593)}
"""Weights of red and blue in the luma of BT.709, BT.601, SMPTE 240M and BT.2020."""


def yuv(picture: Values, form: str, weights: tuple[float, float] | None, full: bool) -> av.VideoFrame:
    """A frame of values from 0 to 1, by the definition of H.273; without weights as RGB."""
    if weights is None:
        rgb = (picture.clip(0, 1) * 255).round().astype(np.uint8)
        return av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(format=form)
    (kr, kb), (red, green, blue) = weights, np.moveaxis(picture, 2, 0)
    luma = kr * red + (1 - kr - kb) * green + kb * blue
    chroma = (blue - luma) / (2 - 2 * kb), (red - luma) / (2 - 2 * kr)
    frame = av.VideoFrame(picture.shape[1], picture.shape[0], form)
    bits = frame.format.components[0].bits
    unit, largest = 1 << (bits - 8), (1 << bits) - 1
    kind = np.uint8 if bits == 8 else np.uint16
    for plane, values in zip(frame.planes, (luma, *chroma), strict=True):
        level = 0.0 if values is luma else 128.0 * unit
        base, height = (
            (level, largest) if full else (max(level, 16.0 * unit), (219 if values is luma else 224) * unit)
        )
        rows, columns = picture.shape[0] // plane.height, picture.shape[1] // plane.width
        mean = values.reshape(plane.height, rows, plane.width, columns).mean(axis=(1, 3))
        padded = np.zeros((plane.height, plane.line_size // kind().itemsize), kind)
        padded[:, : plane.width] = (base + height * mean).round().clip(0, largest)
        plane.update(padded.tobytes())
    return frame


def first(path: Path, folder: Path) -> npt.NDArray[np.int64]:
    with Image.open(decoders.keyframes(path, folder, 5)[0]) as picture:
        return np.asarray(picture, np.int64)


SDR = {
    "BT.709, limited range": ((1, 1, 1, 1), 1, False, "yuv444p"),
    "BT.709, full range": ((1, 1, 1, 2), 1, True, "yuv444p"),
    "BT.709, 10 bits": ((1, 1, 1, 1), 1, False, "yuv420p10le"),
    "BT.601 of NTSC": ((6, 6, 6, 1), 5, False, "yuv420p"),
    "BT.601 of PAL": ((5, 6, 5, 1), 5, False, "yuv420p"),
    "sRGB of a phone, full range": ((1, 13, 6, 2), 5, True, "yuv420p"),
    "SMPTE 240M": ((7, 7, 7, 1), 7, False, "yuv444p"),
    "no tags, small": ((2, 2, 2, 0), 5, False, "yuv444p"),
    "RGB": ((1, 13, 0, 2), None, True, "bgr0"),
}


@pytest.mark.parametrize("kind", SDR)
def test_sdr_comes_out_as_it_was_encoded(kind: str, tmp_path: Path) -> None:
    tags, matrix, full, form = SDR[kind]
    path = clip(tmp_path / "a.mkv", [chart() / 255.0], tags=tags, matrix=matrix, full=full, form=form)
    error = first(path, tmp_path / "out") - chart()
    assert np.abs(error).mean() < 1.0
    assert np.abs(error).max() <= 5, (
        "2 are of the rounding of YUV, and others of the JPEG, whose quality is 95"
    )
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.2


def test_without_tags_the_size_names_the_matrix(tmp_path: Path) -> None:
    picture = chart(1280, 720)
    path = clip(tmp_path / "a.mkv", [picture / 255.0], matrix=1)
    assert np.abs(first(path, tmp_path / "out") - picture).max() <= 6
    assert ["BT.709" in said for said in decoders.video_remarks(path)] == [True]


def test_full_range_mjpeg(tmp_path: Path) -> None:
    path = clip(tmp_path / "a.avi", [chart() / 255.0], codec="mjpeg", form="yuvj444p", matrix=5, full=True)
    assert np.abs(first(path, tmp_path / "out") - chart()).mean() < 2.5


WIDE = {
    "HLG": ((9, 18, 9, 1), hlg, TO_BT2020, 9),
    "HLG of an iPhone with P3": ((12, 18, 9, 1), hlg, TO_P3, 9),
    "PQ": ((9, 16, 9, 1), pq, TO_BT2020, 9),
    "PQ without primaries": ((2, 16, 9, 1), pq, TO_BT2020, 9),
    "SDR with BT.2020": ((9, 14, 9, 1), gamma, TO_BT2020, 9),
    "SDR with Display P3": ((12, 1, 1, 1), gamma, TO_P3, 1),
}


@pytest.mark.parametrize("kind", WIDE)
def test_hdr_and_wide_gamut_show_the_colours_of_sdr(kind: str, tmp_path: Path) -> None:
    tags, encode, primaries, matrix = WIDE[kind]
    picture = chart()
    signal = encode(linear(picture) @ primaries.T)
    path = clip(tmp_path / "a.mkv", [signal], tags=tags, matrix=matrix, form="yuv420p10le")
    error = first(path, tmp_path / "out") - picture
    matt = (linear(picture).max(axis=2) < 0.83)[..., None]
    assert np.abs(error * matt).mean() < 1.2
    assert np.abs(error * matt).max() <= 5
    assert any("converted" in said for said in decoders.video_remarks(path))


COLORS = {
    "PQ": ((9, 16), Colors("BT.2020", "PQ")),
    "HLG": ((9, 18), Colors("BT.2020", "HLG")),
    "PQ with P3": ((12, 16), Colors("Display P3", "PQ")),
    "HLG with SDR's primaries": ((1, 18), Colors("sRGB", "HLG")),
    "SDR with BT.2020": ((9, 14), Colors("BT.2020", "sRGB")),
    "SDR with Display P3": ((12, 1), Colors("Display P3", "sRGB")),
    "linear": ((1, 8), Colors("sRGB", "linear")),
}


@pytest.mark.parametrize("kind", COLORS)
def test_every_colour_is_that_of_the_rule(kind: str) -> None:
    """Of random colours, outside of sRGB too, by the rule in float64; 3 levels are swscale's way to 16 bits."""
    (primaries, transfer), colors = COLORS[kind]
    signal = np.random.default_rng(3).integers(0, 1 << 10, (120, 160, 3))
    signal[:20] = signal[:20, :, :1]  # greys
    exact = 255.0 * srgb(signal / 1023, colors)
    frame = av.VideoFrame.from_ndarray(signal.astype(np.uint16), format="gbrp10le")
    frame.color_primaries, frame.color_trc, frame.colorspace, frame.color_range = primaries, transfer, 0, 2
    assert np.abs(np.asarray(video_frame.picture(frame, None)) - exact).max() < 3.0
    pixels = np.rint(signal / 1023 * 65535).astype(np.uint16)
    assert np.abs(srgb_pixels(pixels, colors) - exact).max() < 0.56


@pytest.mark.parametrize("transfer", ["HLG", "PQ"])
def test_highlights_rise_and_keep_their_hue(transfer: str) -> None:
    """Of a ramp of an orange of the scene up to the largest signal."""
    light = np.array([1.0, 0.6, 0.3]) * np.linspace(0.01, 3.7, 400)[:, None]
    signal = {"HLG": hlg, "PQ": pq}[transfer](light)
    rgb = srgb(signal, Colors("sRGB", transfer))
    assert (np.diff(rgb, axis=0) >= 0).all()
    assert rgb.max() <= 1.0
    shown = linear(rgb * 255)
    assert np.allclose(shown[:, 1] / shown[:, 0], 0.6, atol=0.01)
    assert np.allclose(shown[:, 2] / shown[:, 0], 0.3, atol=0.01)


def test_colours_outside_of_srgb_keep_their_luminance_and_approach_grey() -> None:
    green = srgb(np.array([[0.0, 0.6, 0.0]]), Colors("BT.2020", "sRGB"))[0]
    assert green[0] == pytest.approx(0.0, abs=1e-6)
    light = linear(green * 255)
    assert light @ [0.2126, 0.7152, 0.0722] == pytest.approx(0.678 * linear(np.array(153)), rel=0.01)


REMARKS = {
    "complete": ((1, 1, 1, 1), "yuv444p", []),
    "nothing": ((2, 2, 2, 0), "yuv444p", ["does not name its primaries or transfer function or matrix"]),
    "the matrix alone": ((2, 2, 1, 1), "yuv444p", ["does not name its primaries or transfer function;"]),
    "the matrix of RGB": ((1, 1, 0, 1), "yuv444p", ["does not name its matrix"]),
    "a logarithm": ((1, 9, 1, 1), "yuv444p", ["transfer function 9"]),
    "constant luminance": ((9, 14, 10, 1), "yuv444p10le", ["matrix 10", "colours of BT.2020"]),
    "ICtCp": ((9, 16, 14, 1), "yuv444p10le", ["matrix 14", "is HDR (BT.2020, PQ)"]),
    "HLG with SDR's primaries": ((1, 18, 1, 1), "yuv444p10le", ["is unusual", "is HDR"]),
}


@pytest.mark.parametrize("kind", REMARKS)
def test_what_is_assumed_is_a_warning(kind: str, tmp_path: Path) -> None:
    tags, form, said = REMARKS[kind]
    images = tmp_path / "images"
    images.mkdir()
    clip(images / "walk.mkv", [chart() / 255.0], tags=tags, matrix=1, form=form)
    warnings = prepare(images, None, tmp_path / "work").warnings
    assert len(warnings) == len(said)
    for warning, part in zip(warnings, said, strict=True):
        assert warning.startswith("walk.mkv")
        assert part in warning


@pytest.mark.parametrize(("aspect", "size"), [("4/3", (128, 64)), ("10/11", (96, 70)), ("2", (192, 64))])
@pytest.mark.parametrize("container", ["mp4", "mov", "mkv"])
def test_pixels_are_made_square(aspect: str, size: tuple[int, int], container: str, tmp_path: Path) -> None:
    path = clip(
        tmp_path / f"a.{container}",
        [chart() / 255.0],
        codec="libx264",
        form="yuv420p",
        tags=(1, 1, 1, 1),
        matrix=1,
        aspect=Fraction(aspect),
    )
    picture = first(path, tmp_path / "out")
    assert picture.shape[1::-1] == size
    expected = np.asarray(Image.fromarray(chart()).resize(size, Image.Resampling.LANCZOS), np.int64)
    assert np.abs(picture - expected).mean() < 2.0
    assert [Fraction(aspect) == 1 or "not square" in said for said in decoders.video_remarks(path)] == [True]


def test_an_aspect_ratio_that_no_camera_has_is_not_followed() -> None:
    frame = av.VideoFrame.from_ndarray(chart(), format="rgb24")
    for aspect in (Fraction(1, 900), Fraction(900), Fraction(9, 2)):
        assert video_frame.picture(frame, aspect).size == (WIDTH, HEIGHT)
        assert any("no camera has" in said for said in video_frame.remarks(frame, aspect))


def shifted(count: int) -> list[Values]:
    """A wall of noise, further along in each picture."""
    noise = np.random.default_rng(0).integers(0, 256, (8, WIDTH + 8 * count >> 3, 3), np.uint8)
    wide = np.asarray(Image.fromarray(noise).resize((WIDTH + 8 * count, HEIGHT))) / 255.0
    return [wide[:, 8 * number : 8 * number + WIDTH] for number in range(count)]


STAMPS = {
    "from zero": [100 * number for number in range(30)],
    "from one hour": [3_600_000 + 100 * number for number in range(30)],
    "a jump of an hour": [100 * number + 3_600_000 * (number >= 15) for number in range(30)],
    "a jump before the last": [100 * number + 3_600_000 * (number == 29) for number in range(30)],
    "a frame each ten seconds": [10_000 * number for number in range(30)],
    "variable rate": [int(200 * number + 90 * np.sin(number)) for number in range(30)],
}


@pytest.mark.parametrize("kind", STAMPS)
@pytest.mark.parametrize("container", ["mp4", "mkv"])
def test_all_frames_are_found_wherever_the_stamps_begin(kind: str, container: str, tmp_path: Path) -> None:
    path = clip(
        tmp_path / f"a.{container}", shifted(30), codec="libx264", form="yuv420p", stamps=STAMPS[kind]
    )
    assert len(decoders.keyframes(path, tmp_path / "out", 100)) >= 28


def test_frames_that_an_edit_list_leaves_out_are_not_taken(tmp_path: Path) -> None:
    """The writer of MP4 makes an edit list that begins at the stamp 0, and frames before it are not shown."""
    stamps = [100 * number - 1_000 for number in range(30)]
    path = clip(tmp_path / "a.mp4", shifted(30), codec="libx264", form="yuv420p", stamps=stamps)
    with av.open(str(path)) as container:
        shown = sum(1 for _ in container.decode(video=0))
    taken = [int(each.stem[-6:]) for each in decoders.keyframes(path, tmp_path / "out", 100)]
    assert len(taken) >= shown - 2
    assert max(taken) < shown


@pytest.mark.parametrize(("signs", "turn"), video_frame.TURNS.items())
def test_each_display_matrix_makes_frames_upright(
    signs: tuple[int, int, int, int], turn: Image.Transpose | None, tmp_path: Path
) -> None:
    """The matrix is written into the track header of an MP4, where phones have it."""
    path = clip(
        tmp_path / "a.mp4", [chart() / 255.0], codec="libx264", form="yuv420p", tags=(1, 1, 1, 1), matrix=1
    )
    data = bytearray(path.read_bytes())
    identity = b"".join(value.to_bytes(4, "big") for value in (65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30))
    place = data.index(identity, data.index(b"tkhd"))
    a, b, c, d = (int(sign) * 65536 for sign in signs)
    matrix = (a, b, 0, c, d, 0, 0, 0, 1 << 30)
    data[place : place + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in matrix)
    path.write_bytes(data)
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    to_x, to_y = signs[0] * x + signs[2] * y, signs[1] * x + signs[3] * y
    expected = np.zeros((np.ptp(to_y) + 1, np.ptp(to_x) + 1, 3), np.int64)
    expected[to_y - to_y.min(), to_x - to_x.min()] = chart()
    picture = first(path, tmp_path / "out")
    assert picture.shape == expected.shape
    assert np.abs(picture - expected).mean() < 2.0
    assert decoders.video_remarks(path) == []


def test_interlaced_frames_lose_every_second_line_and_not_their_shape(tmp_path: Path) -> None:
    """The lines between show the chart mirrored, as if it had moved that far, with chroma of its own."""
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream: Any = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"crf": "4", "x264-params": "interlaced=1"}
        frame = yuv(chart() / 255.0, "yuv420p", KR_KB[5], full=False)
        mirrored = yuv(chart()[:, ::-1] / 255.0, "yuv420p", KR_KB[5], full=False)
        for plane, other in zip(frame.planes, mirrored.planes, strict=True):
            lines = np.frombuffer(bytes(plane), np.uint8).reshape(plane.height, -1).copy()
            lines[1::2] = np.frombuffer(bytes(other), np.uint8).reshape(plane.height, -1)[1::2]
            plane.update(lines.tobytes())
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    picture = first(tmp_path / "a.mp4", tmp_path / "out")
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(picture - chart()).mean() < 3.0
    assert any("interlaced" in said for said in decoders.video_remarks(tmp_path / "a.mp4"))


def test_no_time_stamps_at_all(tmp_path: Path) -> None:
    """Of raw H.264 in AVI, stamps are missing or count packets; frames are then spaced by their numbers."""
    path = clip(tmp_path / "a.avi", shifted(30), codec="libx264", form="yuv420p")
    assert len(decoders.keyframes(path, tmp_path / "out", 100)) >= 28
