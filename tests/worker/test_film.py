"""Proves that a video is complete or absent, that an error while it is written is the one raised, and its size.

Does not prove what the frames show: `test_fit_image` and `test_pipeline` decode theirs.
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import av
import numpy as np
import pytest
from PIL import Image

from splatmill.files import replacing
from splatmill_worker.film import Film, with_even_sides
from splatmill_worker.pipeline.progress_film import HELD, ProgressFilm
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.views import TrainingView

GREY = np.full((16, 32, 3), 128, np.uint8)


def progress(folder: Path, *, anew: bool = False) -> ProgressFilm:
    """A film that is only written; the view and the plan, which are for taking shots, are absent."""
    return ProgressFilm(folder, cast(TrainingView, None), cast(Plan, None), None, anew=anew)


def test_a_film_appears_when_it_is_complete(tmp_path: Path) -> None:
    with replacing(tmp_path / "a.mp4") as part, Film(part, 32, 16, 24) as film:
        film.add(GREY)
        assert not (tmp_path / "a.mp4").exists()
    with av.open(str(tmp_path / "a.mp4")) as video:
        assert len(list(video.decode(video=0))) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("pictures", [0, 3])
def test_an_error_leaves_the_earlier_film_and_is_raised(tmp_path: Path, pictures: int) -> None:
    def break_off() -> None:
        with replacing(tmp_path / "a.mp4") as part, Film(part, 32, 16, 24) as film:
            for _ in range(pictures):
                film.add(GREY)
            raise ZeroDivisionError

    (tmp_path / "a.mp4").write_text("an earlier one")
    with pytest.raises(ZeroDivisionError):
        break_off()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_text() == "an earlier one"


@pytest.mark.parametrize(
    ("size", "expected"), [((5, 8), (20, 32)), ((16, 33), (16, 34)), ((1, 1), (16, 16)), ((17, 21), (18, 22))]
)
def test_odd_and_tiny_images_get_even_sides(size: tuple[int, int], expected: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    shown = with_even_sides(pixels)
    assert shown.shape == (*expected, 3)
    factor = expected[0] // size[0]
    np.testing.assert_array_equal(shown[: size[0] * factor : factor, : size[1] * factor : factor], pixels)


def test_shots_become_a_film_and_none_become_none(tmp_path: Path) -> None:
    film = progress(tmp_path / "shots")
    assert film.develop(tmp_path / "none.mp4") is False
    assert [path.name for path in tmp_path.iterdir()] == ["shots"]
    for name in ("000", "007"):
        Image.fromarray(GREY).save(tmp_path / "shots" / f"{name}.jpg")
    assert film.develop(tmp_path / "some.mp4") is True
    with av.open(str(tmp_path / "some.mp4")) as video:
        assert len(list(video.decode(video=0))) == 2 + HELD
    assert progress(tmp_path / "shots", anew=True).develop(tmp_path / "none.mp4") is False


def test_a_shot_that_is_no_picture_leaves_no_film(tmp_path: Path) -> None:
    film = progress(tmp_path / "shots")
    Image.fromarray(GREY).save(tmp_path / "shots" / "000.jpg")
    (tmp_path / "shots" / "001.jpg").write_text("torn")
    with pytest.raises(OSError, match="cannot identify"):
        film.develop(tmp_path / "a.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["shots"]
