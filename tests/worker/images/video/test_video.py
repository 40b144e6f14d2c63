"""Proves which frames of a video become photos: that motion is measured in shares of the picture, that frames lie at
equal distances of it and are sharp, and what becomes of videos that stand, are short, damaged or cancelled.

Not proven here: hostile files (test_guarded), and what better frames are worth (decisions: keyframes).
"""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageFilter

from splatmill_worker.errors import Cancelled, UnusableVideo
from splatmill_worker.images import flow
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.prepare import prepare
from splatmill_worker.images.video import video
from splatmill_worker.images.video.video import Candidate

WIDTH, HEIGHT = 320, 240


def wall() -> Image.Image:
    """What a camera goes along: noise of every size, the larger the stronger, as pictures of the world have it."""
    random = np.random.default_rng(3)
    layers = [
        np.asarray(
            Image.fromarray(
                random.normal(0, size**0.5, (HEIGHT // size, 1920 // size)).astype(np.float32)
            ).resize((1920, HEIGHT), Image.Resampling.BICUBIC)
        )
        for size in (4, 8, 16, 32, 64, 120)
    ]
    return Image.fromarray((128 + 3 * np.sum(layers, axis=0)).clip(0, 255).astype(np.uint8)).convert("RGB")


WALL = wall()


def shot(left: float, blur: float = 0.0) -> Image.Image:
    """What a camera shows whose left edge is at `left`, in pixels of the wall."""
    frame = WALL.transform(
        (WIDTH, HEIGHT), Image.Transform.AFFINE, (1, 0, left, 0, 1, 0), Image.Resampling.BILINEAR
    )
    return frame.filter(ImageFilter.BoxBlur((blur, 0))) if blur else frame


def filmed(path: Path, frames: list[Image.Image]) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_image(frame)))
        container.mux(stream.encode())
    return path


def numbers(paths: list[Path]) -> list[int]:
    return [int(path.stem.rpartition("_")[2]) for path in paths]


def small(left: float, scale: float = 1.0) -> npt.NDArray[np.float32]:
    """The wall from `left` on, in grey, 96 x 72 pixels; enlarged about its middle."""
    frame = shot(left).resize((96, 72), Image.Resampling.BOX).convert("L")
    about = (1 / scale, 0, 48 * (1 - 1 / scale), 0, 1 / scale, 36 * (1 - 1 / scale))
    frame = frame.transform((96, 72), Image.Transform.AFFINE, about, Image.Resampling.BICUBIC)
    return np.asarray(frame, np.float32)


@pytest.mark.parametrize("pixels", [0.0, 0.3, 1.0, 3.0, 8.0, 16.0])
def test_a_shift_is_measured_in_shares_of_the_longer_side(pixels: float) -> None:
    """To a tenth of a pixel while it is small. A sixth of the picture is found a fifth short: the window blurs it."""
    shift = 96 * flow.displacement(small(400), small(400 + pixels * WIDTH / 96))
    assert shift == pytest.approx(pixels, abs=0.1 if pixels < 10 else pixels / 5)


def test_going_forward_is_motion_too() -> None:
    """Enlarged by a tenth, a pixel moves by a tenth of its distance to the middle: 3 of 96 on average."""
    assert 96 * flow.displacement(small(400), small(400, 1.1)) == pytest.approx(3.0, rel=0.2)


def test_the_flow_of_what_cannot_be_compared_is_finite() -> None:
    flat, other = np.full((72, 96), 90.0, np.float32), small(1200)
    assert flow.displacement(flat, flat) == 0.0
    assert 0.0 <= flow.displacement(flat, other) <= 1.0
    assert 0.0 <= flow.displacement(small(0), other) <= 1.0
    assert np.isfinite(flow.displacement(flat[:3, :3], other[:3, :3]))
    with pytest.raises(ValueError, match="one size"):
        flow.displacement(flat, other[:-1])


def test_frames_lie_at_equal_distances_where_the_camera_went_unevenly(tmp_path: Path) -> None:
    """It stands for 60 frames, goes fast for 30 and slowly for 60, and then stands again."""
    steps = [0.0] * 60 + [30.0] * 30 + [10.0] * 60 + [0.0] * 50
    lefts = np.cumsum(steps)
    path = filmed(tmp_path / "walk.mp4", [shot(left) for left in lefts])
    taken = lefts[numbers(decoders.keyframes(path, tmp_path / "out", 40))]
    gaps = np.diff(taken)
    assert 32 <= len(taken) <= 40
    assert taken[0] <= 60
    assert taken[-1] >= 1440
    assert gaps.max() < 3 * 1500 / 40
    assert (gaps == 0).sum() <= 2, "the camera stood there"


def test_the_sharpest_of_neighbouring_frames_is_taken(tmp_path: Path) -> None:
    """Every fourth frame is sharp, the others are blurred along the way."""
    frames = [shot(4.0 * number, 0.0 if number % 4 == 1 else 6.0) for number in range(120)]
    taken = numbers(decoders.keyframes(filmed(tmp_path / "walk.mp4", frames), tmp_path / "out", 15))
    assert 13 <= len(taken) <= 15
    assert all(number % 4 == 1 for number in taken)


def test_a_camera_that_stands_gives_few_frames(tmp_path: Path) -> None:
    """What moves is the noise of the sensor. Before a turntable, too, most of the picture stands."""
    random = np.random.default_rng(0)
    still = np.asarray(shot(300), float)
    frames = [
        Image.fromarray((still + random.normal(0, 3, still.shape)).clip(0, 255).astype(np.uint8))
        for _ in range(150)
    ]
    taken = decoders.keyframes(filmed(tmp_path / "tripod.mp4", frames), tmp_path / "out", 100)
    assert video.FEWEST // 2 <= len(taken) <= video.FEWEST


def test_frames_come_in_order_under_their_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    filmed(folder / "walk.mp4", [shot(12.0 * number) for number in range(24)])
    result = prepare(folder, None, tmp_path / "work", frames=100)
    names = [photo.name for photo in result.photos]
    assert names == sorted(names) == [f"walk_{number:06d}.jpg" for number in range(24)]
    assert all(photo.sequence == "walk.mp4" for photo in result.photos)


def test_one_frame_is_enough(tmp_path: Path) -> None:
    path = filmed(tmp_path / "blink.mp4", [shot(0)])
    assert numbers(decoders.keyframes(path, tmp_path / "out", 150)) == [0]


def test_of_a_video_with_a_damaged_end_the_frames_before_it_are_used(tmp_path: Path) -> None:
    whole = filmed(tmp_path / "whole.mkv", [shot(10.0 * number) for number in range(90)]).read_bytes()
    path = tmp_path / "cut.mkv"
    path.write_bytes(whole[: len(whole) * 2 // 3])
    taken = numbers(decoders.keyframes(path, tmp_path / "out", 20))
    assert 10 <= len(taken) <= 20
    assert 40 < taken[-1] < 75


def frame_size(path: Path) -> tuple[int, int]:
    with Image.open(path) as frame:
        return frame.size


def turned(path: Path) -> Path:
    """A video of a phone that is turned while it records: 20 frames of 320x240 pixels, then 20 of 240x320."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuvj420p"
        for number in range(40):
            frame = shot(10.0 * number)
            encoder = av.CodecContext.create("mjpeg", "w")
            encoder.width, encoder.height = frame.size if number < 20 else frame.size[::-1]
            encoder.pix_fmt, encoder.time_base = "yuvj420p", Fraction(1, 30)
            upright = frame if number < 20 else frame.transpose(Image.Transpose.ROTATE_90)
            for packet in encoder.encode(av.VideoFrame.from_image(upright).reformat(format="yuvj420p")):
                packet.stream, packet.pts, packet.dts = stream, number, number
                packet.time_base = encoder.time_base
                container.mux(packet)
    return path


def test_a_video_whose_frames_change_their_size_gives_frames_of_both(tmp_path: Path) -> None:
    paths = decoders.keyframes(turned(tmp_path / "walk.avi"), tmp_path / "out", 10)
    assert len(paths) == 10
    assert {frame_size(path) for path in paths} == {(WIDTH, HEIGHT), (HEIGHT, WIDTH)}


def test_reading_is_cancelled_in_both_passes(tmp_path: Path) -> None:
    path = filmed(tmp_path / "walk.mp4", [shot(10.0 * number) for number in range(40)])
    for after in (5, 45):
        asked = iter(range(1000))
        with pytest.raises(Cancelled):
            decoders.keyframes(path, tmp_path / "out", 10, cancelled=lambda: next(asked) >= after)  # noqa: B023


def test_no_frames_cannot_be_asked_for(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        decoders.keyframes(tmp_path / "walk.mp4", tmp_path / "out", 0)
    (tmp_path / "walk.mp4").write_bytes(b"no video")
    with pytest.raises(UnusableVideo):
        decoders.keyframes(tmp_path / "walk.mp4", tmp_path / "out", 5)


@given(
    moved=st.lists(st.floats(0, 1e3), min_size=1, max_size=60),
    sharp=st.lists(st.floats(0, 1e6), min_size=60, max_size=60),
    count=st.integers(1, 80),
)
def test_the_choice_keeps_its_bounds(moved: list[float], sharp: list[float], count: int) -> None:
    candidates = [
        Candidate(3 * index, sharpness, step)
        for index, (step, sharpness) in enumerate(zip(moved, sharp, strict=False))
    ]
    taken = video.chosen(candidates, count)
    assert 1 <= len(taken) <= count
    assert taken == sorted(set(taken))
    assert set(taken) <= {candidate.number for candidate in candidates}


def test_neighbours_of_equal_motion_are_at_least_the_least_motion_apart() -> None:
    """600 candidates along an arc of 1.2 pictures: 120 frames, a hundredth apart each."""
    candidates = [Candidate(number, 1.0, 0.002001) for number in range(600)]
    assert len(video.chosen(candidates, 150)) == 120
    assert len(video.chosen(candidates, 60)) == 60
    assert len(video.chosen([Candidate(number, 1.0, 0.0) for number in range(600)], 150)) == 1
