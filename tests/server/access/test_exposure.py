"""The warning of a server that listens for other machines and takes every client for a proxy, at its start.

Not proved here: that a server without keys refuses to listen there (test_keys), and what the headers of a trusted proxy
change (tests/server/base/test_root_path).
"""

from pathlib import Path

import pytest
from pydantic import SecretStr
from structlog.testing import capture_logs

from splatmill_server.app import create_app
from splatmill_server.base.settings import Settings


def warnings(folder: Path, host: str, trusted: str, uds: Path | None = None) -> list[str]:
    """What a start with these settings warns of."""
    settings = Settings(
        data=folder, host=host, uds=uds, forwarded_allow_ips=trusted, api_key=SecretStr("s3cret")
    )
    with capture_logs() as lines:
        create_app(settings)
    return [line["event"] for line in lines if line["log_level"] == "warning"]


@pytest.mark.parametrize("trusted", ["*", "10.0.0.7, *", "0.0.0.0/0", "::/0"])
@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.7"])
def test_trust_in_every_client_of_a_public_server_is_warned_of(
    tmp_path: Path, host: str, trusted: str
) -> None:
    [warning] = warnings(tmp_path, host, trusted)
    assert f"FORWARDED_ALLOW_IPS={trusted} trusts every client" in warning
    assert f"listens on {host}," in warning
    assert "Set FORWARDED_ALLOW_IPS to the address of the proxy" in warning


@pytest.mark.parametrize(
    ("host", "trusted"),
    [
        ("127.0.0.1", "*"),
        ("::1", "*"),
        ("0.0.0.0", "127.0.0.1"),
        ("0.0.0.0", "10.0.0.0/8,proxy"),
        ("0.0.0.0", ""),
    ],
)
def test_nothing_is_warned_of_where_only_proxies_are_believed(
    tmp_path: Path, host: str, trusted: str
) -> None:
    assert warnings(tmp_path, host, trusted) == []


def test_a_unix_socket_may_trust_all_who_open_it(tmp_path: Path) -> None:
    assert warnings(tmp_path, "0.0.0.0", "*", tmp_path / "s.sock") == []
