"""The worker's settings from the environment: the address of Redis, where files lie, its queues and limits."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from splatmill.backplane.address import DEFAULT_URL
from splatmill.backplane.log_lines import LogFormat, parse_format
from splatmill.backplane.private_files import PRIVATE, parse_mask
from splatmill.schema.quantities import parse_bytes, parse_duration

DISK_RESERVE = 256 * 2**20
"""Bytes that stay free on the disk of the data folder. On a shared disk, Redis needs them for its log."""

MAX_UNPACKED = 16 * 2**30
"""Bytes that all zips and videos of a capture unpack to, at most."""


def redis_url() -> str:
    """Return REDIS_URL, or the default address on this machine."""
    return os.environ.get("REDIS_URL") or DEFAULT_URL


def data_folder() -> Path:
    """Return SPLATMILL_DATA, or `splatmill-data` in the current folder."""
    return Path(os.environ.get("SPLATMILL_DATA") or "splatmill-data").expanduser().absolute()


def disk_reserve() -> int:
    """Return SPLATMILL_DISK_RESERVE in bytes, or the default. Raises ValueError for a text that is not a size."""
    return int(_read("SPLATMILL_DISK_RESERVE", parse_bytes, DISK_RESERVE))


def storage_url() -> str:
    """Return SPLATMILL_STORAGE, or the URL of the folder `storage` in the data folder."""
    return os.environ.get("SPLATMILL_STORAGE") or (data_folder() / "storage").as_uri()


def queues() -> str | None:
    """Return SPLATMILL_QUEUES, or None: the queues that a worker serves, separated by commas."""
    return os.environ.get("SPLATMILL_QUEUES") or None


def keep_work() -> float | None:
    """Return SPLATMILL_KEEP_WORK in seconds, the age at which folders of ended jobs are removed, or None: never.

    Raises ValueError.
    """
    seconds: float | None = _read("SPLATMILL_KEEP_WORK", parse_duration, None)
    return seconds


def log_format() -> LogFormat:
    """Return SPLATMILL_LOG_FORMAT, or `text`. Raises ValueError for another word than text and json."""
    choice: LogFormat = _read("SPLATMILL_LOG_FORMAT", parse_format, "text")
    return choice


def umask() -> int:
    """Return SPLATMILL_UMASK, the mask of the modes of new files, or 077. Raises ValueError."""
    return int(_read("SPLATMILL_UMASK", parse_mask, PRIVATE))


def pipeline() -> str:
    """Return SPLATMILL_PIPELINE, the module whose `run` does the work of an attempt; tests of the service name one."""
    return os.environ.get("SPLATMILL_PIPELINE") or "splatmill_worker.pipeline"


def work_folder(job_id: str) -> Path:
    """Return the folder that the attempts at a job on this machine share."""
    return data_folder() / "work" / job_id


def max_run_time() -> float | None:
    """Return SPLATMILL_MAX_RUN_TIME in seconds, by default 48 hours; None for 0: no limit. Raises ValueError."""
    return _read("SPLATMILL_MAX_RUN_TIME", parse_duration, 48 * 3600.0) or None


def max_memory() -> int | None:
    """Return SPLATMILL_MAX_MEMORY in bytes (0: no limit), or None if it is not set. Raises ValueError."""
    limit: int | None = _read("SPLATMILL_MAX_MEMORY", parse_bytes, None)
    return limit


def max_unpacked() -> int:
    """Return SPLATMILL_MAX_UNPACKED, the bytes that the zips and videos of a capture unpack to, by default 16 GiB.

    Raises ValueError.
    """
    return int(_read("SPLATMILL_MAX_UNPACKED", parse_bytes, MAX_UNPACKED))


def _read(name: str, parse: Callable[[str], Any], default: Any) -> Any:
    text = os.environ.get(name, "").strip()
    if not text:
        return default
    try:
        return parse(text)
    except ValueError as error:
        raise ValueError(f"{name}: {error}.") from None
