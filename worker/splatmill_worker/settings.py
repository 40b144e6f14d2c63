"""Where this machine keeps its part of the service, by environment variable as everywhere in Splatmill."""

import os
from pathlib import Path

from splatmill.backplane.connection import DEFAULT_URL


def redis_url() -> str:
    """REDIS_URL, or the local default."""
    return os.environ.get("REDIS_URL") or DEFAULT_URL


def data_folder() -> Path:
    """SPLATMILL_DATA, or `splatmill-data` below the current folder."""
    return Path(os.environ.get("SPLATMILL_DATA") or "splatmill-data").expanduser().absolute()


def storage_url() -> str:
    """SPLATMILL_STORAGE, or the folder `storage` in the data folder."""
    return os.environ.get("SPLATMILL_STORAGE") or (data_folder() / "storage").as_uri()


def work_folder(job_id: str) -> Path:
    """What the attempts at a job leave for each other on this machine."""
    return data_folder() / "work" / job_id
