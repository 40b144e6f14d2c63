"""Proves that undistorted photos show what the equations of each lens say, no wider than a pinhole holds, and nothing
beyond the rays that the lens sees; and that lenses of usual width keep their pinhole.

Does not prove what training gains.
"""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.images import lens
from splatmill_worker.images.load import load_view
from splatmill_worker.images.panoramas import faces
from splatmill_worker.scene import Lens, View

W, H = 480, 360
FULL_FRAME = Lens("OPENCV_FISHEYE", (191.0, 191.0, 240.0, 180.0, 0.0, 0.0, 0.0, 0.0), W, H)
"""180 degrees from corner to corner."""


def equidistant(x: np.ndarray, y: np.ndarray, *k: float) -> tuple[np.ndarray, np.ndarray]:
    r = np.hypot(x, y)
    theta = np.arctan(r)
    bent = theta * (1.0 + sum(value * theta ** (2 * order) for order, value in enumerate(k, 1)))
    scale = bent / np.maximum(r, 1e-12)
    return scale * x, scale * y


def brown(
    x: np.ndarray, y: np.ndarray, k1: float, k2: float, p1: float, p2: float
) -> tuple[np.ndarray, np.ndarray]:
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
    )


def field_of_view(x: np.ndarray, y: np.ndarray, omega: float) -> tuple[np.ndarray, np.ndarray]:
    r = np.maximum(np.hypot(x, y), 1e-12)
    scale = np.arctan(2.0 * r * math.tan(omega / 2.0)) / (omega * r)
    return scale * x, scale * y


def thin_prism(x: np.ndarray, y: np.ndarray, *c: float) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3, k4, s1, s2 = c
    u, v = equidistant(x, y)
    r2 = u * u + v * v
    radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    return (
        u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u) + s1 * r2,
        v * radial + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v) + s2 * r2,
    )


LENSES = [
    ("OPENCV_FISHEYE", (191.0, 191.0), (0.0, 0.0, 0.0, 0.0), equidistant),
    ("OPENCV_FISHEYE", (110.0, 112.0), (0.02, -0.01, 0.003, -0.001), equidistant),
    ("RADIAL_FISHEYE", (150.0,), (0.03, -0.02), equidistant),
    ("FOV", (200.0, 201.0), (1.2,), field_of_view),
    ("THIN_PRISM_FISHEYE", (170.0, 172.0), (0.02, -0.01, 1e-3, -2e-3, 0.002, -0.001, 1e-3, 2e-3), thin_prism),
    ("OPENCV", (210.0, 211.0), (-0.15, 0.02, 1e-3, -1e-3), brown),
    ("OPENCV", (430.0, 431.0), (-0.12, 0.02, 1e-3, -2e-3), brown),
]


def glass(model: str, focal: tuple[float, ...], extra: tuple[float, ...]) -> Lens:
    return Lens(model, (*focal, 243.0, 178.0, *extra), W, H)


@pytest.mark.parametrize(("model", "focal", "extra", "equations"), LENSES)
def test_a_pixel_of_the_undistorted_photo_is_where_the_lens_puts_its_ray(
    model: str, focal: tuple[float, ...], extra: tuple[float, ...], equations
) -> None:
    own = glass(model, focal, extra)
    camera = lens.pinhole(own, np.eye(4))
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(0, W, 41), np.linspace(0, H, 31)))
    x, y = camera.normalized(u, v)
    pixels = lens.distort(own, np.stack([x, y, np.ones_like(x)], axis=1))
    visible = pixels[:, 0] > lens.NOWHERE / 2
    assert visible.mean() > 0.9
    bent_x, bent_y = equations(x[visible], y[visible], *extra)
    expected = np.stack([focal[0] * bent_x + 243.0, focal[-1] * bent_y + 178.0], axis=1)
    # An angle in radians is a distance in pixels over the focal length.
    assert np.abs(pixels[visible] - expected).max() / min(focal) < 1e-6


@pytest.mark.parametrize(("model", "focal", "extra", "equations"), LENSES)
def test_no_undistorted_photo_is_wider_than_a_pinhole_holds(
    model: str, focal: tuple[float, ...], extra: tuple[float, ...], equations
) -> None:
    camera = lens.pinhole(glass(model, focal, extra), np.eye(4))
    sides = np.abs([*camera.normalized(0.0, 0.0), *camera.normalized(float(W), float(H))])
    assert math.degrees(math.atan(sides.max())) <= lens.MAX_HALF_ANGLE + 1e-9


def test_a_fisheye_is_cut_and_said(tmp_path: Path) -> None:
    """The grey level of the photo is the angle from the axis; the undistorted photo shows that of each of its rays."""
    u, v = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    angle = np.hypot(u - 240.0, v - 180.0) / 191.0
    Image.fromarray((angle * 100.0).round().astype(np.uint8)).save(tmp_path / "a.png")
    view = View("a.png", lens.pinhole(FULL_FRAME, np.eye(4)), tmp_path / "a.png", lens=FULL_FRAME)
    photo = load_view(view, W)
    assert photo.mask is None
    x, y = photo.camera.normalized(u, v)
    assert math.degrees(math.atan(-x[0, 0])) == pytest.approx(50.0, abs=0.1)
    assert np.abs(photo.rgb[:, :, 0] / 100.0 - np.arctan(np.hypot(x, y))).max() < 0.02
    other = Lens("RADIAL_FISHEYE", (190.0, 240.0, 180.0, 0.0, 0.0), W, H)
    (said,) = lens.remarks([FULL_FRAME, FULL_FRAME, None, other])
    assert "The lens of 3 photos (OPENCV_FISHEYE, RADIAL_FISHEYE) sees more" in said
    assert "100 by 84 degrees" in said


def test_a_small_image_circle_is_not_left(tmp_path: Path) -> None:
    """A circle of 180 degrees in a black frame: no pixel of the surround is shown."""
    circle = Lens("OPENCV_FISHEYE", (100.0, 100.0, 240.0, 180.0, 0.0, 0.0, 0.0, 0.0), W, H)
    u, v = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    lit = np.hypot(u - 240.0, v - 180.0) < 100.0 * math.pi / 2.0
    Image.fromarray(np.where(lit, 255, 0).astype(np.uint8)).save(tmp_path / "a.png")
    view = View("a.png", lens.pinhole(circle, np.eye(4)), tmp_path / "a.png", lens=circle)
    photo = load_view(view, W)
    assert photo.mask is None
    assert photo.rgb.min() == 255


@pytest.mark.parametrize(
    ("own", "limit"),
    [
        # The radius r (1 + k r^2) is largest at r = 1 / sqrt(-3 k), and so is the angle of an equidistant lens.
        (Lens("SIMPLE_RADIAL", (150.0, 240.0, 180.0, -0.4), W, H), 1.0 / math.sqrt(1.2)),
        (Lens("OPENCV", (150.0, 150.0, 240.0, 180.0, -0.4, 0.0, 0.0, 0.0), W, H), 1.0 / math.sqrt(1.2)),
        (
            Lens("OPENCV_FISHEYE", (240.0, 240.0, 240.0, 180.0, -0.5, 0.0, 0.0, 0.0), W, H),
            math.tan(1.0 / math.sqrt(1.5)),
        ),
    ],
)
def test_what_lies_beyond_the_fold_of_a_polynomial_is_masked(tmp_path: Path, own: Lens, limit: float) -> None:
    assert math.tan(lens.sight(own)) == pytest.approx(limit, rel=4e-3)
    assert math.tan(lens.sight(own)) <= limit
    Image.new("RGB", (W, H), (200, 200, 200)).save(tmp_path / "a.png")
    view = View("a.png", lens.pinhole(own, np.eye(4)), tmp_path / "a.png", lens=own)
    photo = load_view(view, W)
    u, v = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    length = np.hypot(*photo.camera.normalized(u, v))
    shown = np.ones((H, W), bool) if photo.mask is None else photo.mask
    pixel = math.sqrt(2.0) / photo.camera.fx
    assert not shown[length > limit].any()
    folded = float(length.max()) > limit
    assert (photo.mask is not None) == folded
    assert any("hold up to" in each for each in lens.remarks([own])) == folded
    x, y = photo.camera.normalized(u.ravel(), v.ravel())
    inside = lens.distort(own, np.stack([x, y, np.ones_like(x)], axis=1)).reshape(H, W, 2)
    covered = ((inside > 1.0) & (inside < (W - 1.0, H - 1.0))).all(axis=2)
    assert shown[covered & (length < math.tan(lens.sight(own)) - pixel)].all()


@pytest.mark.parametrize(
    ("own", "degrees"),
    [
        # r (1 + k r^2) is largest at r = 1 / sqrt(-3 k). An action camera: no pinhole of 100 degrees has its fold.
        (
            Lens("SIMPLE_RADIAL", (216.0, 240.0, 180.0, -0.1), W, H),
            math.degrees(math.atan(1.0 / math.sqrt(0.3))),
        ),
        (Lens("OPENCV", (200.0, 200.0, 240.0, 180.0, -0.1, 0.0, 0.0, 0.0), W, H), 61.29),
        (Lens("OPENCV_FISHEYE", (100.0, 100.0, 240.0, 180.0, 0.0, -0.08, 0.0, 0.0), W, H), 72.05),
    ],
)
def test_no_face_shows_what_lies_beyond_a_fold(own: Lens, degrees: float) -> None:
    assert math.degrees(lens.sight(own)) == pytest.approx(degrees, abs=0.2)
    view = View("a.png", lens.pinhole(own, np.eye(4)), Path("a.png"), lens=own)
    for face in faces.faces_of(view):
        if face.face is not None:
            column, row = np.meshgrid(np.arange(face.camera.width) + 0.5, np.arange(face.camera.height) + 0.5)
            rays = (
                np.stack([*face.camera.normalized(column, row), np.ones(row.shape)], axis=-1)
                @ face.face.rotation
            )
            angles = np.degrees(np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2]))
            met = lens.distort(own, rays.reshape(-1, 3))[:, 0].reshape(angles.shape)
            assert (met[angles > degrees] == lens.NOWHERE).all()
    divided = {own} if faces.is_divided(view) else set()
    assert (own.model == "OPENCV_FISHEYE") == bool(divided)
    said = lens.remarks([own], divided)
    assert any("hold up to 72 degrees" in each for each in said) == bool(divided)
    assert any("sees more than a pinhole" in each for each in said) != bool(divided)


BEHIND = [
    Lens("SIMPLE_FISHEYE", (110.0, 243.0, 178.0), W, H),
    Lens("FISHEYE", (110.0, 112.0, 243.0, 178.0), W, H),
    Lens("SIMPLE_RADIAL_FISHEYE", (110.0, 243.0, 178.0, 0.03), W, H),
    *(glass(model, focal, extra) for model, focal, extra, _ in LENSES if model.endswith("_FISHEYE")),
]


@pytest.mark.parametrize("own", BEHIND, ids=lambda own: own.model)
def test_rays_aside_and_behind_meet_an_equidistant_lens_by_the_equations_of_those_ahead(
    own: Lens, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The module's own equations give COLMAP's pixels for rays ahead, and go on from them without a step."""
    assert own.model in lens.EQUIDISTANT_MODELS
    camera = lens.colmap_camera(own)
    turn = np.random.default_rng(0).uniform(0.0, 2.0 * math.pi, 200)

    def rays(angle: float) -> np.ndarray:
        across = math.sin(angle) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        return np.concatenate([across, np.full((200, 1), math.cos(angle))], axis=1) * 3.0

    ahead = {angle: lens.pixels_of(camera, rays(angle)) for angle in (0.01, 0.5, 1.2, 1.55)}
    steps = [lens.pixels_of(camera, rays(angle)) for angle in np.linspace(1.5, 1.7, 201)]
    assert np.abs(np.diff(steps, n=2, axis=0)).max() < 1e-3
    assert np.linalg.norm(np.diff(steps, axis=0), axis=2).min() > 0.0
    monkeypatch.setattr(lens, "ASIDE", math.inf)
    for angle, pixels in ahead.items():
        np.testing.assert_allclose(lens.pixels_of(camera, rays(angle)), pixels, atol=1e-9)


def test_only_equidistant_lenses_see_behind() -> None:
    behind = np.array([[1.0, 0.5, -0.2]])
    for own in (glass("FOV", (200.0, 201.0), (1.2,)), glass("OPENCV", (210.0, 211.0), (0.0, 0.0, 0.0, 0.0))):
        assert (lens.distort(own, behind) == lens.NOWHERE).all()


@pytest.mark.parametrize(
    ("own", "zoom"),
    [
        (Lens("OPENCV", (430.0, 430.0, 240.0, 180.0, -0.12, 0.02, 0.001, -0.002), W, H), 0.9783040717209592),
        (Lens("SIMPLE_RADIAL", (500.0, 240.0, 180.0, 0.04), W, H), 1.0123846770976843),
        (Lens("RADIAL", (400.0, 240.0, 180.0, -0.2, 0.05), W, H), 0.9568657173516651),
        (Lens("OPENCV_FISHEYE", (330.0, 330.0, 240.0, 180.0, 0.01, 0.0, 0.0, 0.0), W, H), 0.900755275882135),
        # A pinhole of 110 degrees with a little distortion is wide by itself, and stays so.
        (Lens("OPENCV", (168.0, 168.0, 240.0, 180.0, 0.002, 0.0, 0.0, 0.0), W, H), 1.0042604030323579),
    ],
)
def test_lenses_that_a_pinhole_holds_keep_their_width(own: Lens, zoom: float) -> None:
    assert lens.pinhole(own, np.eye(4)).fx / own.params[0] == zoom
    assert lens.remarks([own]) == []
