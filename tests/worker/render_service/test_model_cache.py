"""Proves that the models in memory keep to a bound in bytes, the one used last staying."""

from pathlib import Path

import pytest

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill_worker.errors import ModelNotFound
from splatmill_worker.render_service.model_cache import ModelCache
from tests.support.ball import store_ball


def test_the_cache_keeps_to_its_bytes(tmp_path: Path) -> None:
    storage = Storage((tmp_path / "storage").as_uri())
    for number in range(3):
        store_ball(storage, tmp_path, f"cached0{number}")
    one = ModelCache(storage, 0).get("cached00").bytes
    stored = storage.head(layout.model_file("cached00", "model.ply"))
    assert stored is not None
    cache = ModelCache(storage, one + stored.size)  # a model in memory, and the file of another
    first = cache.get("cached00")
    cache.get("cached01")
    assert cache.get("cached00") is first
    cache.get("cached02")
    assert cache.bytes == 2 * one
    assert cache.get("cached00") is first, "the one used last must stay"
    # One that is larger than the whole cache is read all the same, in place of the others.
    small = ModelCache(storage, one - 1)
    for number in (0, 1):
        large = small.get(f"cached0{number}")
        assert small.get(f"cached0{number}") is large, "it is not read again for the next picture"
        assert small.bytes == one
    with pytest.raises(ModelNotFound):
        cache.get("../../etc")
