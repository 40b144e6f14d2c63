"""Proves that models that do not fit into the cache, alone or together, are rendered all the same, and one after the
other: of several that are larger than the cache, never two are in memory.

Not proved here: the pictures (test_renderer.py).
"""

import asyncio
import weakref
from pathlib import Path
from typing import Any

import httpx
import pytest

from splatmill.backplane import rendering
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import CameraSpec, OrbitRequest, RenderRequest
from splatmill_worker.render_service.app import RenderApp
from splatmill_worker.render_service.model_cache import LoadedModel, ModelCache
from tests.support.ball import store_ball

FRONT = CameraSpec.looking_at((4, 0, 0), (0, 0, 0), width=64, height=48)


def test_views_and_videos_of_models_larger_than_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = Storage((tmp_path / "storage").as_uri())
    ids = ["large000", "large001", "large002"]
    for model_id in ids:
        store_ball(storage, tmp_path, model_id)
    alive: weakref.WeakSet[LoadedModel] = weakref.WeakSet()
    most, loads = [0], [0]
    load = ModelCache._load

    def counted(self: ModelCache, *args: Any) -> LoadedModel:
        model = load(self, *args)
        alive.add(model)
        most[0], loads[0] = max(most[0], len(alive)), loads[0] + 1
        return model

    monkeypatch.setattr(ModelCache, "_load", counted)
    orbit = OrbitRequest(seconds=1, fps=8, width=32, height=32).model_dump_json()
    view = RenderRequest(camera=FRONT).model_dump_json(exclude_none=True)

    async def all_at_once() -> list[httpx.Response]:
        transport = httpx.ASGITransport(RenderApp(storage, cache_bytes=1).asgi())
        async with httpx.AsyncClient(transport=transport, base_url="http://renderer") as http:
            asked = [
                http.post(path(model_id), content=content, headers={rendering.CLIENT_HEADER: model_id})
                for model_id in ids
                for path, content in ((rendering.orbit_path, orbit), (rendering.render_path, view))
            ]
            return await asyncio.gather(*asked)

    answers = asyncio.run(all_at_once())
    assert [answer.status_code for answer in answers] == [200] * 6
    assert [answer.headers["content-type"] for answer in answers] == ["video/mp4", "image/png"] * 3
    assert most[0] == 1
    assert loads[0] >= len(ids), "each was read"
