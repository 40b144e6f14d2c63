"""Fixtures of the tests of storage space: callers of several owners, a clock, and a storage that is no folder."""

import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import httpx
import pytest
from obstore.store import MemoryStore
from starlette.datastructures import Headers

from splatmill.backplane.storage.storage import Storage
from splatmill.schema import KeyLimits, Scope
from splatmill_server.access import caller
from tests.support.served_app import Serve, ServedApp
from tests.support.servers.bucket import bucket


class Clock:
    """A clock that stands until it is moved, in seconds since 1970."""

    def __init__(self, now: float) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now


@dataclass
class Person:
    """Requests of one owner, with a limit of bytes or none. `chief` is an admin."""

    http: httpx.Client
    owner: str
    limit: int | None = None

    def __call__(self, method: str, path: str, **more: object) -> httpx.Response:
        headers = {"X-Owner": self.owner} | ({"X-Limit": str(self.limit)} if self.limit is not None else {})
        return self.http.request(method, path, headers=headers, **more)  # type: ignore[arg-type]  # a test's own

    def capture(self, *sizes: int) -> str:
        """A capture with images of these sizes, in bytes."""
        made = self("POST", "/v1/captures", json={}).json()["id"]
        for index, size in enumerate(sizes):
            answer = self.put(made, f"{index}.jpg", bytes([index]) * size)
            assert answer.status_code == 201, answer.text
        return str(made)

    def put(self, capture: str, name: str, body: object) -> httpx.Response:
        return self("PUT", f"/v1/captures/{capture}/images/{name}", content=body)

    def use(self, query: str = "") -> dict[str, dict[str, int]]:
        """Total and kinds by owner, as GET /v1/storage has them."""
        answer = self("GET", f"/v1/storage{query}").json()
        return {use["owner"]: {"bytes": use["bytes"], **use["by_kind"]} for use in answer["owners"]}


async def _caller(scope: object, headers: Headers) -> caller.Caller:
    owner, limit = headers.get("x-owner", "default"), headers.get("x-limit")
    scopes = frozenset(Scope) if owner in ("default", "chief") else frozenset({Scope.read, Scope.train})
    limits = KeyLimits(bytes_stored=int(limit) if limit is not None else None)
    return caller.Caller(owner, scopes=scopes, limits=limits)


ServePeople = Callable[..., ServedApp]


@pytest.fixture
def serve_people(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> ServePeople:
    """Start an app whose callers say who they are in the headers X-Owner and X-Limit."""

    def start(**settings: object) -> ServedApp:
        served = serve(**settings)
        monkeypatch.setattr(served.service.authentication, "caller", _caller)
        return served

    return start


@pytest.fixture(params=["folder", "objects", "bucket"])
def people(request: pytest.FixtureRequest, serve_people: ServePeople) -> Iterator[ServedApp]:
    """The app with its default settings: on a folder, on an object store in memory, and on a bucket played by moto."""
    if request.param == "bucket":
        with bucket() as url:
            yield serve_people(
                storage=f"{url}/{secrets.token_hex(8)}"
            )  # moto keeps its objects between tests
        return
    served = serve_people()
    if request.param == "objects":
        as_object_store(served.service.storage)
    yield served


def as_object_store(storage: Storage) -> None:
    """Let a storage lie in an object store in memory, which has no folders and no local paths, as a bucket."""
    storage.store = storage.bulk = MemoryStore()
    storage.root = None
