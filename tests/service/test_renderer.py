"""The renderer process over real HTTP on a unix socket: formats, depth, ETag, refusals, its bounds, the orbit's path.

The model is a ball, red on the side of +x and blue on the other, whose picture is known. That the kernels render
right is proven in tests/kernels.
"""

import asyncio
import io
import math
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

from splatmill.backplane import layout, rendering
from splatmill.backplane.storage import Storage
from splatmill.schema import DEPTH_SCALE_HEADER, CameraSpec, OrbitRequest, RenderRequest
from splatmill_worker.render_service import orbit
from splatmill_worker.render_service.model_cache import ModelCache, NoModelError
from splatmill_worker.render_service.renderer import Busy, Turns

from . import standin
from .conftest import wait_for

BALL = "ball0000"
FRONT = CameraSpec.looking_at((4, 0, 0), (0, 0, 0), width=64, height=48)
BACK = CameraSpec.looking_at((-4, 0, 0), (0, 0, 0), width=64, height=48)


def store_ball(storage: Storage, folder: Path, model_id: str = BALL, count: int = 400) -> None:
    standin.write_ply(folder / "model.ply", count)
    storage.put(layout.model_file(model_id, "model.ply"), folder / "model.ply")
    storage.put(layout.job_record(model_id), b"{}")


@pytest.fixture(scope="module")
def storage(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    folder = tmp_path_factory.mktemp("renderer")
    storage = Storage((folder / "storage").as_uri())
    store_ball(storage, folder)
    return storage


@pytest.fixture(scope="module")
def http(storage: Storage) -> Iterator[httpx.Client]:
    assert storage.root is not None
    path = storage.root.parent / "r.sock"
    process = subprocess.Popen(
        [sys.executable, "-m", "splatmill_worker", "renderer", "--uds", str(path)],
        env=dict(os.environ) | {"SPLATMILL_STORAGE": storage.url},
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


def picture(http: httpx.Client, wish: RenderRequest, **headers: str) -> httpx.Response:
    return http.post(
        rendering.render_path(BALL), content=wish.model_dump_json(exclude_none=True), headers=headers
    )


def pixels(answer: httpx.Response) -> np.ndarray:
    assert answer.status_code == 200, answer.text
    if answer.headers["content-type"] == "application/x-npy":
        return np.load(io.BytesIO(answer.content))
    return np.asarray(Image.open(io.BytesIO(answer.content)))


@pytest.mark.parametrize("kind", ["png", "jpeg", "webp"])
def test_colour_in_every_format(http: httpx.Client, kind: str) -> None:
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
    coverage = pixels(picture(http, RenderRequest(camera=FRONT, output="alpha")))
    assert np.abs(coverage.astype(int) - image[..., 3]).max() <= 1


def test_depth_as_floats_and_as_sixteen_bits(http: httpx.Client) -> None:
    floats = pixels(picture(http, RenderRequest(camera=FRONT, output="depth", format="npy")))
    assert floats.dtype == np.float32
    # A unit ball seen from 4 lies between 3 and 5; its near side hides most of the far one.
    assert 2.9 < floats[24, 32] < 4.0
    assert floats[0, 0] == 0
    answer = picture(http, RenderRequest(camera=FRONT, output="depth"))
    whole = pixels(answer)
    scale = float(answer.headers[DEPTH_SCALE_HEADER])
    assert np.abs(whole * scale - floats).max() <= scale
    assert ((whole == 0) == (floats == 0)).all()


def test_the_same_picture_is_not_sent_twice(http: httpx.Client) -> None:
    wish = RenderRequest(camera=FRONT)
    first = picture(http, wish)
    again = picture(http, wish, **{"If-None-Match": first.headers["etag"]})
    assert again.status_code == 304
    assert again.content == b""
    assert again.headers["etag"] == first.headers["etag"]
    opengl = FRONT.model_dump() | {"convention": "opengl", "camera_to_world": _flipped(FRONT)}
    same = picture(http, RenderRequest(camera=CameraSpec.model_validate(opengl)))
    assert same.headers["etag"] == first.headers["etag"]
    assert same.content == first.content
    assert picture(http, RenderRequest(camera=BACK)).headers["etag"] != first.headers["etag"]


def test_a_replaced_model_is_read_anew(http: httpx.Client, storage: Storage, tmp_path: Path) -> None:
    wish = RenderRequest(camera=FRONT, output="alpha")
    before = picture(http, wish)
    store_ball(storage, tmp_path, count=30)
    after = picture(http, wish)
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

    wish = OrbitRequest(seconds=1, fps=8, width=64, height=48)
    answer = http.post(rendering.orbit_path(BALL), content=wish.model_dump_json(exclude_none=True))
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "video/mp4"
    with av.open(io.BytesIO(answer.content)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == wish.frames
    leanings = [int(frame[..., 0].sum()) - int(frame[..., 2].sum()) for frame in frames]
    assert max(leanings) > 0 > min(leanings)
    etag = {"If-None-Match": answer.headers["etag"]}
    again = http.post(
        rendering.orbit_path(BALL), content=wish.model_dump_json(exclude_none=True), headers=etag
    )
    assert again.status_code == 304


def test_the_cache_keeps_to_its_bytes(storage: Storage, tmp_path: Path) -> None:
    for number in range(3):
        store_ball(storage, tmp_path, f"cached0{number}")
    one = ModelCache(storage, 0).get("cached00").bytes
    cache = ModelCache(storage, 2 * one)
    first = cache.get("cached00")
    cache.get("cached01")
    assert cache.get("cached00") is first
    cache.get("cached02")
    assert cache.bytes == 2 * one
    assert cache.get("cached00") is first, "the one used last must stay"
    with pytest.raises(NoModelError):
        cache.get("../../etc")


def test_more_requests_than_may_wait_are_sent_away() -> None:
    async def crowd() -> tuple[int, int, int]:
        turns, release, inside, most = Turns(waiting=2), threading.Event(), 0, 0

        def work() -> None:
            nonlocal inside, most
            inside += 1
            most = max(most, inside)
            release.wait(10)
            inside -= 1

        async def visit() -> bool:
            try:
                async with turns.admitted():
                    await turns.run(work)
            except Busy:
                return False
            return True

        visits = [asyncio.create_task(visit()) for _ in range(5)]
        done, _ = await asyncio.wait(visits, return_when=asyncio.FIRST_COMPLETED)
        release.set()
        served = await asyncio.gather(*visits)
        return len(done), sum(served), most

    assert asyncio.run(crowd()) == (2, 3, 1)


def ring(first: float, last: float, count: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cameras on an arc (degrees) of radius 3 at height 1 around (5, 0, 0), looking at it."""
    turns = np.radians(np.linspace(first, last, count))
    target = np.array([5.0, 0.0, 0.0])
    centers = target + np.stack([3 * np.cos(turns), 3 * np.sin(turns), np.ones(count)], axis=1)
    forwards = (target - centers) / np.linalg.norm(target - centers, axis=1, keepdims=True)
    rights = np.cross(forwards, [0.0, 0.0, 1.0])
    ups = np.cross(rights / np.linalg.norm(rights, axis=1, keepdims=True), forwards)
    return centers, forwards, ups


def test_the_orbit_circles_where_photos_were_taken_all_around() -> None:
    path = orbit.path_through(*ring(0, 330))
    assert path.target == pytest.approx([5.0, 0.0, 0.0], abs=1e-6)
    assert path.radius == pytest.approx(3.0)
    assert path.height == pytest.approx(1.0)
    eyes = np.array([path.eye(share) for share in np.linspace(0, 1, 37)])
    assert eyes[0] == pytest.approx(eyes[-1])
    turned = np.unwrap(np.arctan2(eyes[:, 1], eyes[:, 0] - 5.0))
    assert abs(turned[-1] - turned[0]) == pytest.approx(2 * math.pi)


def test_the_orbit_stays_on_the_side_that_was_seen() -> None:
    path = orbit.path_through(*ring(-40, 40))
    eyes = np.array([path.eye(share) for share in np.linspace(0, 1, 37)])
    azimuths = np.degrees(np.arctan2(eyes[:, 1], eyes[:, 0] - 5.0))
    assert azimuths.min() == pytest.approx(-40, abs=1)
    assert azimuths.max() == pytest.approx(40, abs=1)


def test_orbit_cameras_look_at_the_target() -> None:
    wish = OrbitRequest(seconds=0.5, fps=12, width=64, height=48)
    path = orbit.path_through(*ring(0, 330))
    for camera in orbit.cameras_along(path, wish, 50.0):
        rotation = camera.viewmat[:3, :3]
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-9)
        seen = camera.project(path.target[None])
        assert (*seen.columns, *seen.rows) == pytest.approx((32.0, 24.0), abs=1e-6)
        assert rotation[1] @ np.array([0.0, 0.0, 1.0]) < 0, "the picture's down must not be the world's up"


def _flipped(camera: CameraSpec) -> list[list[float]]:
    """The matrix of the same view with OpenGL axes."""
    return [[row[0], -row[1], -row[2], row[3]] for row in camera.camera_to_world[:3]] + [[0.0, 0.0, 0.0, 1.0]]
