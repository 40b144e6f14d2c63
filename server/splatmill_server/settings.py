"""What an operator can set, by environment variable or `Settings(...)`."""

import ipaddress
from pathlib import Path
from typing import Self

from pydantic import Field, SecretStr, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from splatmill.backplane import rendering
from splatmill.backplane.connection import DEFAULT_URL
from splatmill.schema import DEFAULT_PORT


class Settings(BaseSettings):
    """The API process. Each name is also an environment variable: `SPLATMILL_` and the name in capitals."""

    model_config = SettingsConfigDict(env_prefix="SPLATMILL_", populate_by_name=True, extra="ignore")

    redis_url: str = Field(
        default=DEFAULT_URL, validation_alias="REDIS_URL", description="redis://host:port/0 or unix:///path."
    )
    data: Path = Field(default=Path("splatmill-data"), description="Folder for what is kept on this machine.")
    storage: str = Field(default="", description="file:///folder or s3://bucket/prefix; else DATA/storage.")
    renderer_url: str | None = Field(default=None, description="http://host:port or unix:/path.")
    api_key: SecretStr | None = Field(default=None, description="Demanded as `Authorization: Bearer KEY`.")

    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    port: int = Field(
        default=DEFAULT_PORT, ge=0, le=65535, description="Port to listen on; 0 takes any free one."
    )
    uds: Path | None = Field(default=None, description="Unix socket to listen on instead of host and port.")

    max_file_bytes: int = Field(default=4 << 30, gt=0, description="Largest uploaded file.")
    max_files_per_capture: int = Field(default=10_000, gt=0, description="Files a capture may hold.")
    max_json_bytes: int = Field(default=1 << 20, gt=0, description="Largest body that is not a file.")
    min_free_bytes: int = Field(default=256 << 20, ge=0, description="Space uploads leave on a local disk.")

    redis_timeout: float = Field(default=5.0, gt=0, description="Seconds to wait for a reply of Redis.")
    render_timeout: float = Field(default=120.0, gt=0, description="Seconds to wait for the renderer.")
    orbit_timeout: float = Field(default=900.0, gt=0, description="Seconds to wait for a whole video.")
    reaper_interval: float = Field(default=10.0, gt=0, description="Seconds between looks for lost attempts.")
    stop_interval: float = Field(default=0.1, gt=0, description="Seconds between repeated stop messages.")
    heartbeat: float = Field(default=15.0, gt=0, description="Seconds between comments on a silent stream.")

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if not self.storage:
            self.storage = (self.data.expanduser().absolute() / "storage").as_uri()
        if self.renderer_url is not None:
            rendering.address(self.renderer_url)
        if self.api_key is not None and not self.api_key.get_secret_value():
            self.api_key = None
        if self.api_key is None and self.uds is None and not is_loopback(self.host):
            raise ValueError(
                f"Listening on {self.host} lets other machines in, which needs an API key: "
                "set SPLATMILL_API_KEY, or listen on 127.0.0.1."
            )
        return self


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
