"""What docker-compose.yml promises: no rights, no secret where none is needed, and no way in but the API's port."""

from __future__ import annotations

import json
from typing import Any

import pytest
import yaml

from tests.support.wheels import ROOT

COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_is_confined(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert service["mem_limit"]
    assert service["pids_limit"] > 0
    assert "privileged" not in service
    assert set(service.get("cap_add", [])) <= ({"NET_BIND_SERVICE"} if name == "caddy" else set())


def test_only_the_server_knows_the_api_key_and_the_renderer_knows_no_secret() -> None:
    stated = {name: json.dumps(service.get("environment", {})) for name, service in SERVICES.items()}
    assert [name for name, text in stated.items() if "SPLATMILL_API_KEY" in text] == ["server"]
    without_password = {name for name, text in stated.items() if "REDIS_PASSWORD" not in text}
    assert without_password == {"renderer", "caddy"}


def test_redis_asks_for_a_password_that_is_no_argument_of_its_process() -> None:
    command = SERVICES["redis"]["command"][-1]
    assert "requirepass" in command
    assert "exec redis-server -" in command
    assert "$$REDIS_PASSWORD" in command  # the shell in the container puts it in, not Compose


def test_only_the_api_and_the_proxy_publish_ports_and_the_api_on_this_host_alone() -> None:
    assert {name for name, service in SERVICES.items() if "ports" in service} == {"server", "caddy"}
    assert SERVICES["server"]["ports"] == ["${SPLATMILL_BIND:-127.0.0.1}:${SPLATMILL_PORT:-8080}:8080"]


def test_what_reads_strangers_files_has_no_way_out() -> None:
    networks = COMPOSE["networks"]
    closed = {name for name, network in networks.items() if (network or {}).get("internal")}
    for name in ("worker", "worker-cuda", "renderer", "redis"):
        assert set(SERVICES[name]["networks"]) <= closed
    assert SERVICES["renderer"]["networks"] == ["renders"]
    assert "renders" not in SERVICES["redis"]["networks"]


def test_the_renderer_cannot_write_to_the_data() -> None:
    assert SERVICES["renderer"]["volumes"] == ["data:/data:ro"]
