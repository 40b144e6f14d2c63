"""Proves what the renderer answers over HTTP on a unix socket: image formats, depth, ETags, refusals and videos.

The model is a ball, red on the side of +x and blue on the other, so that its images are known. That the kernels render
correctly is proved in tests/kernels.
"""

import io
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from splatmill.backplane import rendering
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import (
    DEPTH_SCALE_HEADER,
    CameraSpec,
    ConversionRequest,
    Format,
    OrbitRequest,
    Output,
    RenderRequest,
)
from splatmill_worker.splat.formats import ply
from tests.support.ball import BALL, store_ball
from tests.support.gaussians import some_gaussians
from tests.support.waiting import wait_for

FRONT = CameraSpec.looking_at((4, 0, 0), (0, 0, 0), width=64, height=48)
BACK = CameraSpec.looking_at((-4, 0, 0), (0, 0, 0), width=64, height=48)


@pytest.fixture(scope="module")
def storage(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    folder = tmp_path_factory.mktemp("renderer")
    storage = Storage((folder / "storage").as_uri())
    store_ball(storage, folder)
    return storage


def temporary(storage: Storage) -> Path:
    """The folder in which the renderer writes videos before it sends them."""
    assert storage.root is not None
    folder = storage.root.parent / "tmp"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="module")
def http(storage: Storage) -> Iterator[httpx.Client]:
    assert storage.root is not None
    path = storage.root.parent / "r.sock"
    process = subprocess.Popen(
        [sys.executable, "-m", "splatmill_worker", "renderer", "--uds", str(path)],
        env=dict(os.environ) | {"SPLATMILL_STORAGE": storage.url, "TMPDIR": str(temporary(storage))},
    )

    def listens() -> bool:
        with socket.socket(socket.AF_UNIX) as probe:
            return probe.connect_ex(str(path)) == 0

    wait_for(listens)
    transport = httpx.HTTPTransport(uds=str(path))
    with httpx.Client(transport=transport, base_url="http://renderer", timeout=120) as client:
        assert client.get(rendering.HEALTH).status_code == 200
        yield client
    process.terminate()
    process.wait(20)


def picture(http: httpx.Client, body: RenderRequest, **headers: str) -> httpx.Response:
    return http.post(
        rendering.render_path(BALL), content=body.model_dump_json(exclude_none=True), headers=headers
    )


def pixels(answer: httpx.Response) -> npt.NDArray[Any]:
    assert answer.status_code == 200, answer.text
    if answer.headers["content-type"] == "application/x-npy":
        array: npt.NDArray[Any] = np.load(io.BytesIO(answer.content))
        return array
    return np.asarray(Image.open(io.BytesIO(answer.content)))


@pytest.mark.parametrize("kind", [Format.png, Format.jpeg, Format.webp])
def test_colour_in_every_format(http: httpx.Client, kind: Format) -> None:
    front = picture(http, RenderRequest(camera=FRONT, format=kind, background="white"))
    assert front.headers["content-type"] == f"image/{kind}"
    image = pixels(front).astype(int)
    assert image.shape == (48, 64, 3)
    red, _, blue = image[24, 32]
    assert red > 150 > blue
    assert (image[0, 0] > 245).all()
    red, _, blue = pixels(picture(http, RenderRequest(camera=BACK, format=kind))).astype(int)[24, 32]
    assert blue > 150 > red


def test_transparent_pictures_carry_coverage(http: httpx.Client) -> None:
    image = pixels(picture(http, RenderRequest(camera=FRONT, background="transparent")))
    assert image.shape == (48, 64, 4)
    assert image[0, 0, 3] == 0
    assert image[24, 32, 3] > 200
    coverage = pixels(picture(http, RenderRequest(camera=FRONT, output=Output.alpha)))
    assert np.abs(coverage.astype(int) - image[..., 3]).max() <= 1


def test_depth_as_floats_and_as_sixteen_bits(http: httpx.Client) -> None:
    floats = pixels(picture(http, RenderRequest(camera=FRONT, output=Output.depth, format=Format.npy)))
    assert floats.dtype == np.float32
    # A unit ball seen from 4 lies between 3 and 5; its near side hides most of the far one.
    assert 2.9 < floats[24, 32] < 4.0
    assert floats[0, 0] == 0
    answer = picture(http, RenderRequest(camera=FRONT, output=Output.depth))
    whole = pixels(answer)
    scale = float(answer.headers[DEPTH_SCALE_HEADER])
    assert np.abs(whole * scale - floats).max() <= scale
    assert ((whole == 0) == (floats == 0)).all()


def test_the_first_surface_and_its_normal(http: httpx.Client) -> None:
    body = RenderRequest(camera=FRONT, output=Output.median_depth, format=Format.npy)
    floats = pixels(picture(http, body))
    assert 2.9 < floats[24, 32] < 3.6
    assert floats[0, 0] == 0
    answer = picture(http, RenderRequest(camera=FRONT, output=Output.median_depth))
    assert np.abs(pixels(answer) * float(answer.headers[DEPTH_SCALE_HEADER]) - floats).max() < 1e-3
    normals = pixels(picture(http, RenderRequest(camera=FRONT, output=Output.normal, format=Format.npy)))
    towards = np.array(FRONT.opencv_to_world())[:3, 2]
    assert normals.shape == (48, 64, 3)
    assert normals[24, 32] @ towards < -0.8
    assert (normals[0, 0] == 0).all()
    image = pixels(picture(http, RenderRequest(camera=FRONT, output=Output.normal)))
    assert np.abs(image[24, 32] / 255.0 - (0.5 + 0.5 * normals[24, 32])).max() < 0.01
    assert (image[0, 0] == 0).all()


def test_the_same_picture_is_not_sent_twice(http: httpx.Client) -> None:
    body = RenderRequest(camera=FRONT)
    first = picture(http, body)
    again = picture(http, body, **{"If-None-Match": first.headers["etag"]})
    assert again.status_code == 304
    assert again.content == b""
    assert again.headers["etag"] == first.headers["etag"]
    opengl = FRONT.model_dump() | {"convention": "opengl", "camera_to_world": _flipped(FRONT)}
    same = picture(http, RenderRequest(camera=CameraSpec.model_validate(opengl)))
    assert same.headers["etag"] == first.headers["etag"]
    assert same.content == first.content
    assert picture(http, RenderRequest(camera=BACK)).headers["etag"] != first.headers["etag"]


def test_a_replaced_model_is_read_anew(http: httpx.Client, storage: Storage, tmp_path: Path) -> None:
    body = RenderRequest(camera=FRONT, output=Output.alpha)
    before = picture(http, body)
    store_ball(storage, tmp_path, count=30)
    after = picture(http, body)
    store_ball(storage, tmp_path)
    assert after.headers["etag"] != before.headers["etag"]
    assert int(pixels(after).sum()) < int(pixels(before).sum())


def test_refusals_have_their_codes(http: httpx.Client, storage: Storage) -> None:
    bent = RenderRequest(camera=FRONT).model_dump(mode="json", exclude_none=True)
    bent["camera"]["camera_to_world"][0][0] += 1
    answer = http.post(rendering.render_path(BALL), json=bent)
    assert (answer.status_code, answer.json()["code"]) == (422, "camera_invalid")
    bent = RenderRequest(camera=FRONT).model_dump(mode="json", exclude_none=True)
    bent["camera"]["width"] = 100_000
    assert http.post(rendering.render_path(BALL), json=bent).json()["code"] == "size_out_of_range"
    good = RenderRequest(camera=FRONT).model_dump(mode="json", exclude_none=True)
    assert http.post(rendering.render_path("nothere0"), json=good).json()["code"] == "model_not_found"
    storage.put(layout.model_file("broken00", "model.ply"), b"no ply at all")
    storage.put(layout.job_record("broken00"), b"{}")
    answer = http.post(rendering.render_path("broken00"), json=good)
    assert (answer.status_code, answer.json()["code"]) == (500, "model_corrupt")
    assert picture(http, RenderRequest(camera=FRONT)).status_code == 200


def test_an_orbit_is_a_video_that_shows_both_sides(http: httpx.Client) -> None:
    import av

    body = OrbitRequest(seconds=1, fps=8, width=64, height=48)
    answer = http.post(rendering.orbit_path(BALL), content=body.model_dump_json(exclude_none=True))
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "video/mp4"
    with av.open(io.BytesIO(answer.content), "r") as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == body.frames
    leanings = [int(frame[..., 0].sum()) - int(frame[..., 2].sum()) for frame in frames]
    assert max(leanings) > 0 > min(leanings)
    etag = {"If-None-Match": answer.headers["etag"]}
    again = http.post(
        rendering.orbit_path(BALL), content=body.model_dump_json(exclude_none=True), headers=etag
    )
    assert again.status_code == 304


def test_an_orbit_that_nobody_waits_for_is_not_rendered_on(http: httpx.Client, storage: Storage) -> None:
    body = OrbitRequest(seconds=60, fps=60, width=1280, height=720).model_dump_json(exclude_none=True)
    with pytest.raises(httpx.ReadTimeout):
        http.post(rendering.orbit_path(BALL), content=body, timeout=1.0)
    # 3600 frames take minutes
    wait_for(lambda: not list(temporary(storage).glob("splatmill-render-*")), 20)
    assert picture(http, RenderRequest(camera=FRONT)).status_code == 200


def test_pictures_are_rendered_while_a_model_is_converted(
    http: httpx.Client, storage: Storage, tmp_path: Path
) -> None:
    large = "large0000001"  # its harmonics take seconds, as those of a million Gaussians take a minute
    ply.write(tmp_path / "model.ply", some_gaussians(60_000, 3))
    storage.put(layout.model_file(large, "model.ply"), tmp_path / "model.ply")
    storage.put(layout.job_record(large), b"{}")
    assert picture(http, RenderRequest(camera=FRONT)).status_code == 200
    with ThreadPoolExecutor(1) as pool:
        body = ConversionRequest(format="sog").model_dump_json()
        conversion = pool.submit(http.post, rendering.convert_path(large), content=body)
        wait_for(lambda: http.get(rendering.HEALTH).json()["admitted"] == 1)
        for width in range(50, 60):
            camera = FRONT.model_copy(update={"width": width})
            assert pixels(picture(http, RenderRequest(camera=camera))).shape == (48, width, 3)
        assert not conversion.done()
        assert conversion.result().status_code == 200
    storage.delete_prefix(layout.model(large))


def _flipped(camera: CameraSpec) -> list[list[float]]:
    """The matrix of the same view with OpenGL axes."""
    return [[row[0], -row[1], -row[2], row[3]] for row in camera.camera_to_world[:3]] + [[0.0, 0.0, 0.0, 1.0]]


def test_only_its_user_can_connect_to_the_renderer(http: httpx.Client, storage: Storage) -> None:
    assert storage.root is not None
    assert oct((storage.root.parent / "r.sock").stat().st_mode)[-3:] == "600"


def test_nothing_temporary_is_left_of_any_request(http: httpx.Client, storage: Storage) -> None:
    edits, convert = f"/v1/models/{BALL}/edits", f"/v1/models/{BALL}/convert"
    box = {"box": {"min": [0, -2, -2], "max": [2, 2, 2]}}
    for path, body, status in (
        (edits, box, 200),
        (edits, box | {"preview": True}, 200),
        (edits, {"max_size": 1e-6}, 422),
        (convert, {"format": "spz"}, 200),
        (convert, {"format": "made up"}, 404),
        (f"/v1/models/{BALL}/orbit", {"seconds": 0.5, "fps": 1}, 200),
    ):
        assert http.post(path, json=body).status_code == status, (path, body)
    with http.stream("POST", edits, json=box) as cut_off:
        assert cut_off.status_code == 200
    wait_for(lambda: not list(temporary(storage).iterdir()), 20)
