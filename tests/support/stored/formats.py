"""The stored fixtures of each format version (`make_formats.py` makes them) and how to restore them."""

import base64
import json
import shutil
from pathlib import Path
from typing import Any

import redis

from tests.support.paths import ROOT

V1 = ROOT / "tests" / "fixtures" / "formats" / "v1"
"""What version 1 of all formats looks like, as the service stored it."""


def job_ids(folder: Path = V1) -> dict[str, str]:
    """The ids of the stored jobs by what became of them."""
    ids: dict[str, str] = json.loads((folder / "jobs.json").read_text())
    return ids


def restore_redis(connection: redis.Redis, folder: Path = V1) -> None:
    """Put all stored keys into Redis."""
    client: Any = connection
    for key, typed in json.loads((folder / "redis.json").read_text()).items():
        ((kind, value),) = typed.items()
        match kind:
            case "string":
                client.set(key, _bytes(value))
            case "hash":
                client.hset(key, mapping={name: _bytes(text) for name, text in value.items()})
            case "list":
                client.rpush(key, *map(_bytes, value))
            case "set":
                client.sadd(key, *map(_bytes, value))
            case "zset":
                client.zadd(key, {_bytes(member): score for member, score in value})
            case "stream":
                for entry_id, fields in value:
                    client.xadd(key, {name: _bytes(text) for name, text in fields.items()}, id=entry_id)


def restore_storage(target: Path, folder: Path = V1) -> None:
    """Copy the stored storage to `target`, which must not exist."""
    shutil.copytree(folder / "storage", target)


def _bytes(text: str) -> bytes:
    return base64.b64decode(text[7:]) if text.startswith("base64:") else text.encode()
