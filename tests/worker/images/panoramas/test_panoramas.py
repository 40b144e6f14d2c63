"""Proves which photos are taken for panoramas: by their XMP, by their shape and edges, and by the photos beside them;
that cropped photos and cut-outs of the same shape are not; and the sentences about each. A tripod
below is masked.

Does not prove how they are trained: test_faces.py does, and tests/worker/sfm/test_panoramas.py.
"""

from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from splatmill_worker.images.panoramas import panoramas
from splatmill_worker.images.panoramas.panoramas import Candidate, Sphere, decided
from splatmill_worker.images.prepare import Prepared, prepare
from tests.support.files.spherical_video import call_spherical
from tests.support.panoramas import gpano, striped, walk, write


def prepared(folder: Path) -> Prepared:
    return prepare(folder, None, folder.parent / "work")


@pytest.mark.parametrize(
    "xmp",
    [
        gpano(ProjectionType="equirectangular"),
        b"<GPano:ProjectionType>equirectangular</GPano:ProjectionType>",
        gpano(ProjectionType="equirectangular", CroppedAreaImageWidthPixels=4096, FullPanoWidthPixels=4096),
    ],
)
def test_panoramas_by_their_xmp_are_used_without_a_word(tmp_path: Path, xmp: bytes) -> None:
    striped(tmp_path / "images/0.jpg", xmp)
    result = prepared(tmp_path / "images")
    assert [photo.is_panorama for photo in result.photos] == [True]
    assert result.warnings == ()


@pytest.mark.parametrize(
    ("xmp", "said"),
    [
        (gpano(ProjectionType="cylindrical"), "it is a panorama (cylindrical by its metadata)"),
        (
            gpano(
                ProjectionType="equirectangular", CroppedAreaImageWidthPixels=1024, FullPanoWidthPixels=4096
            ),
            "a part of a panorama, 25% of its width and 100% of its height",
        ),
    ],
)
def test_other_panoramas_are_left_out_with_a_reason(tmp_path: Path, xmp: bytes, said: str) -> None:
    striped(tmp_path / "images/0.jpg", xmp)
    result = prepared(tmp_path / "images")
    assert result.photos == ()
    assert said in result.skipped[0][1]


def test_xmp_of_a_panorama_on_a_photo_of_another_shape_names_both_readings(tmp_path: Path) -> None:
    striped(tmp_path / "whole.jpg")
    (tmp_path / "images").mkdir()
    with Image.open(tmp_path / "whole.jpg") as image:
        image.crop((0, 0, 300, 200)).save(
            tmp_path / "images/0.jpg", xmp=gpano(ProjectionType="equirectangular")
        )
    ((_, reason),) = prepared(tmp_path / "images").skipped
    assert "300 x 200 pixels" in reason
    assert "part of a panorama" in reason
    assert "ordinary photo" in reason


def test_panoramas_by_their_edges_are_said_and_others_of_the_shape_stay_photos(tmp_path: Path) -> None:
    images = tmp_path / "images"
    for number in range(2):
        striped(images / f"{number}.jpg", seed=number)
    random = np.random.default_rng(0)
    for number in range(2):
        pixels = random.integers(0, 256, (16, 32, 3), np.uint8)
        Image.fromarray(pixels).resize((512, 256)).save(images / f"photo{number}.jpg")
    with Image.open(images / "0.jpg") as image:
        image.crop((100, 0, 400, 150)).save(images / "cropped.jpg")
    product = np.full((256, 512, 3), 255, np.uint8)
    product[60:200, 150:350] = random.integers(0, 256, (140, 200, 3))
    Image.fromarray(product).save(images / "product.png")
    result = prepared(images)
    assert [photo.name for photo in result.photos if photo.is_panorama] == ["0.jpg", "1.jpg"]
    assert len(result.photos) == 6
    (warning,) = result.warnings
    assert warning.startswith("2 photos are taken for 360-degree panoramas, such as 0.jpg")
    assert "ordinary lens" in warning


@pytest.mark.parametrize("is_called", [True, False])
def test_frames_of_a_360_degree_video_are_panoramas(tmp_path: Path, is_called: bool) -> None:
    """By the metadata of the video, of which the frames show nothing; without it, they are photos."""
    (tmp_path / "images").mkdir()
    path = tmp_path / "images/walk.mp4"
    random = np.random.default_rng(0)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        for _ in range(20):
            frame = Image.fromarray(random.integers(0, 256, (8, 16, 3), np.uint8)).resize((128, 64))
            container.mux(stream.encode(av.VideoFrame.from_image(frame)))
        container.mux(stream.encode())
    if is_called:
        call_spherical(path)
    result = prepared(tmp_path / "images")
    assert len(result.photos) > 3
    assert {photo.is_panorama for photo in result.photos} == {is_called}


@pytest.mark.slow
def test_the_tripod_below_is_masked_and_nothing_in_panoramas_without_one(tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    write(plain, walk(12), 256, samples=1)
    assert prepared(plain).overlays == ()
    noise = np.random.default_rng(3).integers(0, 256, (16, 32, 3), np.uint8)
    legs = np.asarray(Image.fromarray(noise).resize((256, 128), Image.Resampling.BICUBIC))
    latitude = 90 - 180 * (np.arange(128) + 0.5) / 128
    hidden = latitude[:, None] < -68 + 12 * np.cos(4 * np.pi * np.arange(256) / 256)
    (tmp_path / "images").mkdir()
    for path in plain.iterdir():
        with Image.open(path) as image:
            pixels = np.where(hidden[:, :, None], legs, np.asarray(image))
        Image.fromarray(pixels).save(
            tmp_path / "images" / path.name, quality=92, xmp=gpano(ProjectionType="equirectangular")
        )
    result = prepared(tmp_path / "images")
    assert all(photo.is_panorama and photo.mask is not None for photo in result.photos)
    ((shown,), (warning,)) = result.overlays, result.warnings
    assert "at the bottom, never changes in 12 photos" in warning
    region = np.asarray(Image.fromarray(shown.region).resize((256, 128)))
    assert region[hidden].mean() > 0.98
    assert (region & ~hidden).sum() < 0.4 * hidden.sum()  # what surrounds it by a few pixels of 160


def candidates(*spheres: Sphere, is_frame: bool = False) -> list[Candidate]:
    return [Candidate(f"{i}", 64, 32, "a", is_frame, sphere) for i, sphere in enumerate(spheres)]


@pytest.mark.parametrize(
    ("spheres", "expected"),
    [
        (("unclear", "closed"), [True, True]),
        (("unclear", "stated", "stated", ""), [True, True, True, True]),
        (("closed", "", ""), [True, False, False]),
        (("unclear", "", ""), [False, False, False]),
        (("unclear", "unclear", "unclear", "closed"), [False, False, False, True]),
    ],
)
def test_what_edges_leave_unclear_is_decided_by_the_folder(
    spheres: tuple[Sphere, ...], expected: list[bool]
) -> None:
    chosen, said = decided(candidates(*spheres))
    assert chosen == expected
    unclear = [i for i, sphere in enumerate(spheres) if sphere == "unclear" and not expected[i]]
    assert any("taken for photos of an ordinary lens" in sentence for sentence in said) == bool(unclear)


@pytest.mark.parametrize(
    ("spheres", "all_are"), [(("closed", "", "closed"), True), (("closed", "", ""), False)]
)
def test_all_frames_of_a_video_are_of_one_kind(spheres: tuple[Sphere, ...], all_are: bool) -> None:
    chosen, _ = decided(candidates(*spheres, is_frame=True))
    assert chosen == [all_are] * 3


def test_a_plain_picture_of_the_shape_is_no_panorama() -> None:
    assert panoramas.by_edges(Image.new("RGB", (64, 32), (9, 99, 99))) == ""
