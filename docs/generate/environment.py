"""The environment variables of the server, from `splatmill_server.settings.Settings`."""

from pathlib import Path
from typing import Any

from docs.generate.markdown import code, table

from splatmill_server.settings import Settings

INTRODUCTION = """# The server's settings

Environment variables of the API process, generated from the program. `splatmill up` sets `REDIS_URL`,
`SPLATMILL_STORAGE` and `SPLATMILL_RENDERER_URL` for its own processes unless they are set, and takes `--host`, `--port`
and `--data` in place of the variables.
"""

WORKER = """
Workers and the renderer read `REDIS_URL`, `SPLATMILL_DATA` and `SPLATMILL_STORAGE` as above. A storage of the form
`s3://bucket/prefix` takes its credentials, region and endpoint from the usual `AWS_*` variables.
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
    if isinstance(value, int) and not isinstance(value, bool):
        return code(f"{value:,}") if value > 10**5 else code(value)
    return code(value) if isinstance(value, float | str | Path) else ""
