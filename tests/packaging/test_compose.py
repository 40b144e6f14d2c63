"""What docker-compose.yml promises: no rights, no secret where none is needed, and no way in but the API's port; and
what docker-compose.s3.yml adds to it. Not proved here: that Docker reads them."""

from __future__ import annotations

import json
import re
from ipaddress import ip_address, ip_network
from typing import Any

import pytest
import yaml

from splatmill.backplane.storage import layout
from splatmill.schema.quantities import parse_duration
from splatmill_worker.service.rq_worker import STOP_GRACE
from tests.support.wheels import ROOT

COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
BUCKET: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.s3.yml").read_text())


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


def test_the_renderer_reads_models_and_nothing_else_of_the_data() -> None:
    (mount,) = SERVICES["renderer"]["volumes"]
    assert mount["read_only"] is True
    assert (mount["source"], mount["volume"]["subpath"]) == ("data", "storage/models")
    storage = SERVICES["renderer"]["environment"]["SPLATMILL_STORAGE"]
    assert mount["target"] == f"{storage.removeprefix('file://')}/models"
    for path in (layout.webhook_record("a"), layout.key_record("a"), layout.capture_record("a")):
        assert not path.startswith("models/")
    # The server makes the folder before it is healthy, which the renderer waits for.
    assert f"mkdir -p {mount['target']} && exec " in SERVICES["server"]["command"][-1]
    assert SERVICES["renderer"]["depends_on"]["server"]["condition"] == "service_healthy"


def test_the_command_of_the_server_is_that_of_its_image() -> None:
    last = (ROOT / "docker/server.Dockerfile").read_text().splitlines()[-1]
    usual = " ".join(json.loads(last.removeprefix("CMD ")))
    assert SERVICES["server"]["command"][-1].endswith(f"exec {usual}")


def test_only_the_proxy_is_believed_about_a_clients_address() -> None:
    proxied = [name for name, service in SERVICES.items() if "proxied" in service["networks"]]
    assert proxied == ["server", "caddy"]
    shared = set(SERVICES["server"]["networks"]) & set(SERVICES["caddy"]["networks"])
    assert shared == {"proxied"}, "the proxy finds the server by no other address"
    believed = SERVICES["server"]["environment"]["FORWARDED_ALLOW_IPS"]
    assert believed == SERVICES["caddy"]["networks"]["proxied"]["ipv4_address"]
    network = COMPOSE["networks"]["proxied"]
    assert network["internal"] is True  # so no published port is reached through it
    (subnet,) = network["ipam"]["config"]
    address, within = (re.sub(r"\$\{\w+:-([\d.]+)\}", r"\1", text) for text in (believed, subnet["subnet"]))
    first, second, *_ = ip_network(within).hosts()
    assert ip_address(address) == second, f"{first} is the host's, whose users may reach the server, too"


@pytest.mark.parametrize("name", ["worker", "worker-cuda"])
def test_a_worker_has_the_time_that_it_gives_a_job_to_store_its_checkpoint(name: str) -> None:
    granted = parse_duration(SERVICES[name]["stop_grace_period"])
    assert granted >= STOP_GRACE + 10
    said = f"{STOP_GRACE:.0f} seconds"
    assert f"gives its job {said} to store a checkpoint" in (ROOT / "docker-compose.yml").read_text()
    assert f"for which it has {said}" in (ROOT / "docs/serving.md").read_text()


def test_a_bucket_is_known_to_all_who_use_storage_and_reached_by_a_network_of_its_own() -> None:
    using = {
        name for name, service in SERVICES.items() if "SPLATMILL_STORAGE" in service.get("environment", {})
    }
    assert using == {"server", "worker", "worker-cuda", "renderer"}
    assert set(BUCKET["services"]) == using
    for name, added in BUCKET["services"].items():
        environment = added["environment"]
        assert environment["SPLATMILL_STORAGE"].startswith("${SPLATMILL_STORAGE:?")
        # Without a value here, those of .env or the shell are passed on, if there are any.
        assert [environment[key] for key in ("AWS_REGION", "AWS_ENDPOINT_URL", "AWS_SESSION_TOKEN")] == [
            None
        ] * 3
        assert {"AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"} <= set(environment)
        assert "REDIS" not in json.dumps(environment)
        assert added.get("networks", ["bucket"]) == ["bucket"]
        open_already = "public" in SERVICES[name]["networks"]
        assert ("networks" in added) is not open_already
    assert list(BUCKET["networks"]) == ["bucket"]
    assert BUCKET["networks"]["bucket"] is None, "it is not internal"
