"""The worker's settings from the environment: the address of Redis, and where files lie."""

import os
from pathlib import Path

from splatmill.backplane.connection import DEFAULT_URL


def redis_url() -> str:
    """Return REDIS_URL, or the default address on this machine."""
    return os.environ.get("REDIS_URL") or DEFAULT_URL


def data_folder() -> Path:
    """Return SPLATMILL_DATA, or `splatmill-data` in the current folder."""
    return Path(os.environ.get("SPLATMILL_DATA") or "splatmill-data").expanduser().absolute()


def storage_url() -> str:
    """Return SPLATMILL_STORAGE, or the URL of the folder `storage` in the data folder."""
    return os.environ.get("SPLATMILL_STORAGE") or (data_folder() / "storage").as_uri()


def queues() -> str | None:
    """Return SPLATMILL_QUEUES, or None: the queues that a worker serves, separated by commas."""
    return os.environ.get("SPLATMILL_QUEUES") or None


def work_folder(job_id: str) -> Path:
    """Return the folder that the attempts at a job on this machine share."""
    return data_folder() / "work" / job_id
