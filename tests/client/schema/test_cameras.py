"""Cameras on the wire: what cannot be rendered from is refused by name, conventions agree, a query is the same request.

Does not prove that a picture is right; the renderer's tests compare pictures with photos.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from splatmill.schema import MAX_RENDER_PIXELS, CameraSpec, Format, OrbitRequest, Output, RenderRequest

IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
PINHOLE = {"width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 31.5, "cy": 24.5}

COORDINATES = st.floats(-1000, 1000, allow_subnormal=False)
POINTS = st.tuples(COORDINATES, COORDINATES, COORDINATES)


def camera_of(matrix: Any = IDENTITY, **lens: Any) -> CameraSpec:
    """A camera as it comes off the wire; without `lens`, with the pinhole of all these tests."""
    return CameraSpec.model_validate({"camera_to_world": matrix} | (lens or PINHOLE))


def changed(**cells: float) -> list[list[float]]:
    matrix = [list(map(float, row)) for row in IDENTITY]
    for cell, value in cells.items():
        matrix[int(cell[1])][int(cell[2])] = value
    return matrix


@st.composite
def rigid(draw: st.DrawFn) -> npt.NDArray[np.float64]:
    quat = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 4)))
    length = np.linalg.norm(quat)
    w, x, y, z = quat / length if length > 1e-3 else (1.0, 0.0, 0.0, 0.0)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = draw(POINTS)
    return matrix


@given(rigid())
def test_viewmat_is_the_inverse(matrix: npt.NDArray[np.float64]):
    camera = camera_of(matrix.tolist())
    # Rounding: entries up to 1e3 with relative error 2e-16 each, a few sums of three products.
    np.testing.assert_allclose(np.array(camera.viewmat()) @ matrix, np.eye(4), atol=1e-11)


@given(rigid())
def test_opengl_axes_are_opencv_axes_with_y_and_z_turned(matrix: npt.NDArray[np.float64]):
    opengl = matrix @ np.diag([1.0, -1.0, -1.0, 1.0])
    one = camera_of(matrix.tolist())
    other = camera_of(opengl.tolist(), convention="opengl", **PINHOLE)
    np.testing.assert_allclose(one.viewmat(), other.viewmat(), atol=1e-12)


@given(rigid(), st.sampled_from(["png", "webp"]), st.booleans())
def test_a_query_is_the_same_request(matrix: npt.NDArray[np.float64], kind: str, by_angle: bool):
    lens = {"fov_y_deg": 40.0, "width": 64, "height": 48} if by_angle else PINHOLE
    camera = camera_of(matrix.tolist(), **lens)
    request = RenderRequest(camera=camera, format=Format(kind), output=Output.alpha, quality=70)
    assert RenderRequest.from_query(request.to_query()) == request


@pytest.mark.parametrize(
    "mangle",
    [{"camera_to_world": "1,2,3"}, {"camera_to_world": "a," * 16}, {"surprise": "1"}, {"width": "x"}],
)
def test_a_query_that_does_not_fit_is_refused(mangle: dict[str, str]):
    query = RenderRequest(camera=camera_of()).to_query()
    with pytest.raises(ValidationError):
        RenderRequest.from_query(query | mangle)
    with pytest.raises(ValidationError):
        RenderRequest.from_query({})


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (changed(m00=0.0), "singular"),
        (changed(m00=0.0, m01=1.0), "singular"),
        (changed(m00=2.0, m11=2.0, m22=2.0), "not rigid"),
        (changed(m00=-1.0), "reflection"),
        (changed(m01=0.1), "not rigid"),
        (changed(m30=1.0), "last row"),
        (changed(m33=2.0), "last row"),
        (changed(m03=math.nan), "finite"),
        (changed(m00=math.inf), "finite"),
        (changed(m03=1e12), "1e9"),
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], "Field required|at least 4"),
    ],
)
def test_matrices_that_are_no_camera(matrix: list[list[float]], reason: str):
    with pytest.raises(ValidationError, match=reason):
        camera_of(matrix)


def test_matrices_with_four_written_digits_pass():
    angle = 0.7
    c, s = round(math.cos(angle), 4), round(math.sin(angle), 4)
    camera_of(changed(m00=c, m01=-s, m10=s, m11=c))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"width": 0}, "greater than or equal to 1"),
        ({"width": 100_000}, "less than or equal to 8192"),
        ({"width": 8192, "height": 8192}, str(MAX_RENDER_PIXELS)),
        ({"fx": 0}, "greater than 0"),
        ({"fx": None}, "intrinsics are missing"),
        ({"fov_y_deg": 50}, "given twice"),
        ({"fov_y_deg": 180}, "less than 180"),
        ({"cx": math.nan}, "finite"),
        ({"zoom": 2}, "not permitted"),
    ],
)
def test_lenses_and_sizes_that_are_refused(change: dict[str, float], reason: str):
    with pytest.raises(ValidationError, match=reason):
        camera_of(**PINHOLE | change)


def test_an_angle_is_the_pinhole_it_means():
    camera = camera_of(width=200, height=100, fov_y_deg=90)
    assert camera.pinhole() == pytest.approx((50, 50, 100, 50))


@given(POINTS, POINTS)
def test_looking_at_puts_the_target_in_the_middle(eye: tuple[float, ...], target: tuple[float, ...]):
    direction = np.subtract(target, eye)
    distance = float(np.linalg.norm(direction))
    if distance < 1e-2 or abs(direction[2]) > 0.999 * distance:
        return
    camera = CameraSpec.looking_at(eye, target, width=64, height=48)
    point = np.array(camera.viewmat()) @ [*target, 1.0]
    np.testing.assert_allclose(point[:2], 0, atol=1e-9 * max(1, distance))
    assert point[2] == pytest.approx(distance)
    # The world's up points up in the picture, whose y axis points down.
    assert np.array(camera.viewmat())[1, 2] < 0


def test_looking_at_nothing_is_refused():
    with pytest.raises(ValueError, match="coincide"):
        CameraSpec.looking_at((1, 2, 3), (1, 2, 3), width=8, height=8)
    with pytest.raises(ValueError, match="parallel to `up`"):
        CameraSpec.looking_at((0, 0, 0), (0, 0, 5), width=8, height=8)


def test_another_width_is_the_same_view():
    camera = camera_of().scaled_to(32)
    assert (camera.width, camera.height) == (32, 24)
    assert camera.pinhole() == pytest.approx((25, 25.5, 15.75, 12.25))


def test_pictures_that_cannot_be():
    camera = camera_of()
    with pytest.raises(ValidationError, match="Depth cannot be a jpeg"):
        RenderRequest(camera=camera, output=Output.depth, format=Format.jpeg)
    with pytest.raises(ValidationError, match="Depth cannot be a webp"):
        RenderRequest(camera=camera, output=Output.median_depth, format=Format.webp)
    with pytest.raises(ValidationError, match="cannot be transparent"):
        RenderRequest(camera=camera, format=Format.jpeg, background="transparent")
    with pytest.raises(ValidationError, match="multiple of 2"):
        OrbitRequest(width=641)


def test_canonical_bytes_know_the_picture_not_its_spelling():
    one = camera_of(width=64, height=48, fov_y_deg=60)
    fx, fy, cx, cy = one.pinhole()
    same = camera_of(width=64, height=48, fx=fx, fy=fy, cx=cx, cy=cy)
    assert RenderRequest(camera=one).canonical() == RenderRequest(camera=same).canonical()
    assert RenderRequest(camera=one).canonical() != RenderRequest(camera=one, quality=50).canonical()
    assert RenderRequest(camera=one).canonical() != RenderRequest(camera=one.scaled_to(32)).canonical()


def test_between_two_cameras_stands_in_the_middle_and_is_rigid():
    a = CameraSpec.looking_at((3, 0, 1), (0, 0, 0), width=64, height=48)
    b = CameraSpec.looking_at((2, 2, 1), (0, 0, 0), width=64, height=48)
    middle = CameraSpec.between(a, b)
    assert [row[3] for row in middle.camera_to_world[:3]] == [2.5, 1.0, 1.0]
    forward = [row[2] for row in middle.camera_to_world[:3]]
    toward_a, toward_b = ([row[2] for row in c.camera_to_world[:3]] for c in (a, b))
    cosines = [sum(x * y for x, y in zip(forward, other, strict=True)) for other in (toward_a, toward_b)]
    assert cosines[0] == pytest.approx(cosines[1], abs=1e-6)
    assert middle.pinhole() == pytest.approx(a.pinhole())


def test_between_cameras_that_look_away_from_each_other_is_refused():
    a = CameraSpec.looking_at((3, 0, 0), (0, 0, 0), width=64, height=48)
    b = CameraSpec.looking_at((-3, 0, 0), (0, 0, 0), width=64, height=48)
    with pytest.raises(ValueError, match="too far apart"):
        CameraSpec.between(a, b)
