"""The alarm over the memory of Redis, from a real Redis with a limit: in /readyz, in the metrics, in `doctor`.

Not proved here: what becomes of requests and attempts when Redis is full (tests/worker/service/test_refusing_redis).
"""

from collections.abc import Iterator

import pytest

from splatmill.backplane import memory
from splatmill_worker import doctor
from tests.support.served_app import ServedApp

BALLAST = 32 << 20
"""Bytes of data beside which the buffers of connections that come and go, up to a megabyte, change no share."""


@pytest.fixture(autouse=True)
def _loaded_and_unlimited(app: ServedApp) -> Iterator[None]:
    for number in range(256):  # in small pieces, so that no connection needs a large buffer for one
        app.redis.set(f"ballast:{number}", bytes(BALLAST // 256))
    yield
    app.redis.config_set("maxmemory", 0)
    app.redis.config_set("maxmemory-policy", "noeviction")


def limit(app: ServedApp, share: float) -> None:
    """Set the limit so that this share of it is used, about."""
    app.redis.config_set("maxmemory", int(memory.read(app.redis).used / share))


def ready(app: ServedApp) -> tuple[bool, str]:
    answer = app.http.get("/readyz").json()
    return answer["ready"], answer["checks"]["redis_memory"]


def test_without_a_limit_and_far_from_it_all_is_well(app: ServedApp) -> None:
    assert ready(app) == (True, "ok")
    assert "splatmill_redis_memory_limit_bytes 0.0" in app.http.get("/metrics").text
    limit(app, 0.5)
    assert ready(app) == (True, "ok")
    used, most = (
        float(line.split()[1])
        for line in app.http.get("/metrics").text.splitlines()
        if line.startswith(("splatmill_redis_memory_bytes", "splatmill_redis_memory_limit_bytes"))
    )
    assert 0.3 < used / most < 0.7


def test_a_redis_that_is_nearly_full_is_told_of_before_it_refuses(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit(app, 0.95)
    served, said = ready(app)
    assert served
    assert "(maxmemory)" in said
    assert "raise maxmemory" in said
    monkeypatch.setenv("REDIS_URL", app.settings.redis_url)
    # A Redis of the machine may also have a version with known faults, which is another warning.
    warned = [
        finding
        for finding in doctor._redis()
        if finding.verdict == "warning" and "maxmemory" in finding.result
    ]
    assert len(warned) == 1
    assert "(maxmemory)" in warned[0].result
    limit(app, 1.2)
    served, said = ready(app)
    assert not served
    assert "takes no jobs" in said


def test_a_redis_that_would_delete_jobs_is_told_of(app: ServedApp) -> None:
    app.redis.config_set("maxmemory-policy", "allkeys-lru")
    served, said = ready(app)
    assert served
    assert "allkeys-lru" in said
    assert said.endswith("Set maxmemory-policy to noeviction.")
