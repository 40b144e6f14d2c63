"""What docker/kubernetes promises: objects that Kubernetes knows, no rights, no secret where none is needed, times and
paths that the programs have, and an autoscaler that counts by metrics which there are.

Not proven here: that a cluster runs them, and the schema of KEDA's object.
"""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from docs.generate.metrics import names
from fastapi.routing import APIRoute

from splatmill_server.routes import status
from splatmill_worker.service.rq_worker import STOP_GRACE
from tests.support.paths import ROOT
from tests.support.programs import program

FOLDER = ROOT / "docker" / "kubernetes"
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
ITEMS: list[dict[str, Any]] = yaml.safe_load((FOLDER / "splatmill.yml").read_text())["items"]
KEDA: dict[str, Any] = yaml.safe_load((FOLDER / "keda.yml").read_text())
PODS = {
    item["metadata"]["name"]: item["spec"]["template"]["spec"] for item in ITEMS if "template" in item["spec"]
}
VERSION = "1.30"
"""Of Kubernetes, the oldest of which the objects are proven."""


@pytest.mark.parametrize("version", [VERSION, kubernetes_validate.latest_version()])
@pytest.mark.parametrize("item", ITEMS, ids=lambda item: f"{item['kind']} {item['metadata']['name']}")
def test_kubernetes_knows_the_object(item: dict[str, Any], version: str) -> None:
    kubernetes_validate.validate(item, version, strict=True)


def test_a_misspelt_field_is_no_field_of_kubernetes() -> None:
    (server,) = (
        item for item in ITEMS if (item["kind"], item["metadata"]["name"]) == ("Deployment", "server")
    )
    with pytest.raises(kubernetes_validate.ValidationError, match="replica"):
        kubernetes_validate.validate(server | {"spec": server["spec"] | {"replica": 2}}, VERSION, strict=True)


@pytest.mark.parametrize("name", PODS)
def test_a_pod_is_confined(name: str) -> None:
    pod = PODS[name]
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["automountServiceAccountToken"] is False
    (container,) = pod["containers"]
    assert container["resources"]["limits"]["memory"]
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }


def test_only_the_server_knows_the_api_key_and_the_renderer_not_the_password_of_redis() -> None:
    stated = {name: json.dumps(pod["containers"]) for name, pod in PODS.items()}
    assert [name for name, text in stated.items() if "splatmill-key" in text] == ["server"]
    assert [name for name, text in stated.items() if "splatmill-redis" not in text] == ["renderer"]


def test_programs_and_images_are_those_of_compose() -> None:
    services = COMPOSE["services"]
    assert PODS["redis"]["containers"][0]["image"] == services["redis"]["image"]
    for name in ("worker", "renderer"):
        assert PODS[name]["containers"][0]["command"] == services[name]["command"]
    script = PODS["redis"]["containers"][0]["command"][-1]
    assert script == services["redis"]["command"][-1].replace("$$", "$")


def test_services_and_policies_are_of_pods_that_there_are() -> None:
    labels = {
        name: item["spec"]["template"]["metadata"]["labels"]
        for item in ITEMS
        for name in [item["metadata"]["name"]]
        if "template" in item["spec"]
    }
    chosen = re.findall(r"(?:selector|matchLabels): (\{app: \w+\})", (FOLDER / "splatmill.yml").read_text())
    assert {yaml.safe_load(each)["app"] for each in chosen} == set(PODS)
    assert labels == {name: {"app": name} for name in PODS}
    ports = {item["metadata"]["name"]: item["spec"]["ports"] for item in ITEMS if item["kind"] == "Service"}
    assert ports == {"redis": [{"port": 6379}], "server": [{"port": 8080}], "renderer": [{"port": 8090}]}


@pytest.mark.parametrize("name", PODS)
def test_a_pod_has_the_volumes_and_ports_that_it_names(name: str) -> None:
    (container,) = PODS[name]["containers"]
    claims = {"data"} if name == "redis" else set()
    volumes = {volume["name"] for volume in PODS[name].get("volumes", [])} | claims
    assert {mount["name"] for mount in container["volumeMounts"]} == volumes
    for probe in (
        container[key] for key in container if key.endswith("Probe") and "httpGet" in container[key]
    ):
        assert str(probe["httpGet"]["port"]) in container["command"]
    stated = [variable["name"] for variable in container.get("env", [])]
    if "REDIS_URL" in stated:  # Kubernetes puts only earlier variables into a value
        assert stated.index("REDIS_PASSWORD") < stated.index("REDIS_URL")


def test_a_worker_has_time_to_store_a_checkpoint() -> None:
    assert PODS["worker"]["terminationGracePeriodSeconds"] > STOP_GRACE


def test_probes_ask_for_what_the_programs_answer() -> None:
    paths = {route.path for route in status.router.routes if isinstance(route, APIRoute)}
    (server,) = PODS["server"]["containers"]
    assert {server[f"{kind}Probe"]["httpGet"]["path"] for kind in ("readiness", "liveness")} <= paths


def test_the_secrets_are_those_that_the_head_says_how_to_write() -> None:
    text = (FOLDER / "splatmill.yml").read_text()
    used = {
        one or other
        for one, other in re.findall(r"secretRef: \{name: ([\w-]+)|secretKeyRef: \{name: ([\w-]+)", text)
    }
    assert used == set(re.findall(r"create secret generic ([\w-]+)", text))


def test_the_autoscaler_counts_by_metrics_that_there_are(tmp_path: Path) -> None:
    (trigger,) = KEDA["spec"]["triggers"]
    query = trigger["metadata"]["query"]
    counted = re.findall(r"splatmill_\w+", query)
    assert counted == ["splatmill_queue_length", "splatmill_workers"]
    assert set(counted) <= set(names())
    assert KEDA["spec"]["scaleTargetRef"]["name"] in PODS
    rules = {"groups": [{"name": "keda", "rules": [{"record": "wanted:workers", "expr": query}]}]}
    series = [
        {"series": f'splatmill_queue_length{{queue="{queue}",instance="{api}"}}', "values": str(count)}
        for queue, count in (("cpu", 2), ("any", 3), ("gpu", 5))
        for api in "ab"
    ]
    series += [
        {"series": f'splatmill_workers{{state="{state}",instance="{api}"}}', "values": str(count)}
        for state, count in (("busy", 4), ("idle", 7))
        for api in "ab"
    ]
    expected = [
        {
            "expr": "wanted:workers",
            "eval_time": "0m",
            "exp_samples": [{"labels": "wanted:workers", "value": 9}],
        }
    ]
    (tmp_path / "rules.yml").write_text(yaml.safe_dump(rules))
    (tmp_path / "test.yml").write_text(
        yaml.safe_dump(
            {
                "rule_files": ["rules.yml"],
                "tests": [{"interval": "1m", "input_series": series, "promql_expr_test": expected}],
            }
        )
    )
    asked = subprocess.run(
        [program("promtool"), "test", "rules", "test.yml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert asked.returncode == 0, asked.stdout + asked.stderr
