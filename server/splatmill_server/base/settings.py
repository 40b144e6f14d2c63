"""The settings of the API process, from environment variables or `Settings(...)`."""

import ipaddress
from pathlib import Path
from typing import Self

import httpx
from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from splatmill.backplane import rendering
from splatmill.backplane.address import DEFAULT_URL
from splatmill.backplane.log_lines import LogFormat
from splatmill.backplane.private_files import parse_mask
from splatmill.schema import DEFAULT_PORT, ByteSize, Duration
from splatmill_server.base import outgoing, root_path


class Settings(BaseSettings):
    """The settings. Each is also an environment variable: `SPLATMILL_` and the name in capitals."""

    model_config = SettingsConfigDict(
        env_prefix="SPLATMILL_",
        env_ignore_empty=True,  # Compose passes on a variable that is not set as an empty one
        populate_by_name=True,
        extra="ignore",
        hide_input_in_errors=True,
    )

    redis_url: str = Field(
        default=DEFAULT_URL,
        validation_alias="REDIS_URL",
        repr=False,  # it may contain a password
        description="Address of Redis: redis://host:port/0 or unix:///path.",
    )
    data: Path = Field(default=Path("splatmill-data"), description="Folder for data on this machine.")
    umask: str = Field(
        default="077",
        description="Mask of the modes of new files and folders, in octal digits, which workers and the renderer read "
        "too. 077 keeps all other users of the machine out, 027 lets the group read.",
    )
    storage: str = Field(
        default="",
        description="file:///folder or s3://bucket/prefix. Left out, the folder storage in `data`.",
    )
    renderer_url: str | None = Field(
        default=None,
        description="Address of the renderer: http://host:port or unix:/path. Left out, no images are "
        "rendered.",
    )
    api_key: SecretStr | None = Field(
        default=None, description="Key that requests must send as `Authorization: Bearer KEY`."
    )

    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    port: int = Field(
        default=DEFAULT_PORT, ge=0, le=65535, description="Port to listen on; 0 takes any free port."
    )
    uds: Path | None = Field(
        default=None, description="Path of a unix socket to listen on, in place of host and port."
    )

    tls_certificate: Path | None = Field(
        default=None, description="Certificate in PEM. Where it is set, the server answers over HTTPS alone."
    )
    tls_key: Path | None = Field(
        default=None, description="Private key of the certificate in PEM; left out, it is in the same file."
    )
    lan_url: str | None = Field(
        default=None,
        description="Address under which devices of the local network reach the server, for the pages that name it.",
    )

    allowed_hosts: str = Field(
        default="",
        description="Names of proxies before the server, separated by commas; `*.example.org` stands for all names "
        "that end so. Browsers' pages under these names may use the server. A server without keys is otherwise "
        "addressed by names of its machine only.",
    )
    root_path: str = Field(
        default="",
        description="Path below which a proxy publishes the server, such as /splats, whether or not it strips it from "
        "what it passes on. Left out, it is what trusted proxies say in `X-Forwarded-Prefix`.",
    )
    forwarded_allow_ips: str = Field(
        default="127.0.0.1",
        validation_alias="FORWARDED_ALLOW_IPS",
        description="Trusted proxies: addresses or networks, separated by commas, or `*` for all. They are believed "
        "about a client's address (`X-Forwarded-For`), its scheme (`X-Forwarded-Proto`) and the root path. With `*`, "
        "every client is, unless only the proxy can connect to the server.",
    )
    cors_origins: str = Field(
        default="",
        description="Origins whose web pages may use the API with a key, such as https://app.example.org, separated "
        "by commas. Left out, no page of another origin may.",
    )
    session_seconds: int = Field(
        default=12 * 3600, gt=0, description="Seconds after which the session of a browser ends."
    )
    access_log: bool = Field(
        default=True, description="Whether each request is logged: who, what, status, seconds and bytes."
    )

    log_format: LogFormat | None = Field(
        default=None,
        description="`text` for people or `json`, one object a line. Left out, the server writes text to a terminal "
        "and JSON elsewhere, and workers and the renderer, which read it too, write text.",
    )

    max_file_bytes: int = Field(
        default=4 << 30, gt=0, description="Largest size of an uploaded file, in bytes."
    )
    max_files_per_capture: int = Field(
        default=10_000, gt=0, description="Largest number of files in a capture."
    )
    max_json_bytes: int = Field(
        default=1 << 20, gt=0, description="Largest size of a request body that is not a file, in bytes."
    )
    min_free_bytes: int = Field(
        default=256 << 20, ge=0, description="Bytes that uploads leave free on a local disk."
    )

    outgoing_allow: str = Field(
        default="",
        description="Private hosts that imports and webhooks may reach: name or name:port, separated by commas.",
    )
    import_seconds: float = Field(
        default=6 * 3600, gt=0, description="Seconds that the import of a file may take."
    )
    min_import_rate: ByteSize = Field(
        default=10_000,
        ge=0,
        description="Least bytes per second of an import, over each minute of waiting for the other server. A slower "
        "one fails. 0 admits any rate.",
    )

    quota: ByteSize | None = Field(
        default=None,
        gt=0,
        description="Bytes that the records of one owner may occupy in storage, such as 50GB, unless a key has a "
        "limit of its own. Left out, there is no limit.",
    )

    keep_captures: Duration | None = Field(
        default=None,
        gt=0,
        description="Age at which captures are deleted, such as 30d, since a file was stored or a job on it ended.",
    )
    keep_failed_jobs: Duration | None = Field(
        default=None, gt=0, description="Age at which jobs without a model are deleted, since their end."
    )
    keep_work: Duration | None = Field(
        default=None,
        gt=0,
        description="Age at which the files from which a job resumes are deleted, since its end. Workers read it too.",
    )
    keep_models: Duration | None = Field(
        default=None,
        gt=0,
        description="Age at which models and their jobs are deleted, since the end of the job.",
    )
    keep_orphans: Duration = Field(
        default=86400.0,
        gt=0,
        description="Age at which files are deleted whose record is missing, since their last write.",
    )
    sweep_interval: Duration = Field(
        default=600.0, gt=0, description="Seconds between two searches for what has reached its age."
    )

    redis_timeout: float = Field(default=5.0, gt=0, description="Seconds to wait for a reply of Redis.")
    render_timeout: float = Field(
        default=120.0, gt=0, description="Seconds to wait for an image of the renderer."
    )
    orbit_timeout: float = Field(
        default=900.0, gt=0, description="Seconds to wait for a video of the renderer."
    )
    reaper_interval: float = Field(
        default=10.0, gt=0, description="Seconds between checks for lost attempts."
    )
    stop_interval: float = Field(
        default=0.1,
        gt=0,
        description="Seconds between repeated requests to stop a job that is being cancelled.",
    )
    heartbeat: float = Field(
        default=15.0, gt=0, description="Seconds of silence in an event stream after which a comment is sent."
    )

    max_event_streams: int = Field(
        default=2000,
        gt=0,
        description="Largest number of clients that follow events on one API process; one owner gets three quarters of "
        "the places. Each holds a connection.",
    )

    # Validators of one field, because their messages name the variable.

    @field_validator("umask")
    @classmethod
    def _mask(cls, text: str) -> str:
        parse_mask(text)
        return text

    @field_validator("root_path")
    @classmethod
    def _path(cls, text: str) -> str:
        return root_path.checked(text)

    @field_validator("cors_origins")
    @classmethod
    def _origins(cls, text: str) -> str:
        for origin in split(text):
            if not _is_origin(origin):
                raise ValueError(
                    f"{origin[:80]!r} is not an origin as browsers write it, such as https://app.example.org or "
                    "http://localhost:5173: no path, no capitals, and no port 80 of http or 443 of https"
                )
        return text

    @field_validator("outgoing_allow")
    @classmethod
    def _hosts(cls, text: str) -> str:
        outgoing.allowed_hosts(text)
        return text

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if not self.storage:
            self.storage = (self.data.expanduser().absolute() / "storage").as_uri()
        if self.renderer_url is not None:
            rendering.address(self.renderer_url)
        if self.api_key is not None and not self.api_key.get_secret_value():
            self.api_key = None
        return self

    @property
    def file_mask(self) -> int:
        """The mask of the modes of new files."""
        return parse_mask(self.umask)

    @property
    def own_names(self) -> list[str]:
        """The names of `allowed_hosts`, in lower case."""
        return [name.lower() for name in split(self.allowed_hosts)]

    @property
    def cors(self) -> list[str]:
        """The origins of `cors_origins`."""
        return split(self.cors_origins)

    @property
    def local(self) -> bool:
        """Whether the server listens where only this machine reaches it, and so may do without keys."""
        return self.uds is not None or is_loopback(self.host)


def split(text: str) -> list[str]:
    """Return the parts of a list with commas that are not empty."""
    return [part.strip() for part in text.split(",") if part.strip()]


def _is_origin(text: str) -> bool:
    """Return whether a text is the origin of a page as browsers write it."""
    try:
        url = httpx.URL(text)
        plain = bool(url.host) and "*" not in url.host and (url.port or 1) <= 65535
    except (httpx.InvalidURL, ValueError):
        return False
    return plain and url.scheme in ("http", "https") and f"{url.scheme}://{url.netloc.decode()}" == text


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
