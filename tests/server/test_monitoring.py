"""The dashboard and the alerts: of metrics that exist, put together as they must be, and valid by their own tools.

promtool checks the rules and plays series to them, Grafana's types build the dashboard. Not proved here: what Grafana
draws of it.
"""

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from docs.generate import metrics
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.dashboard import Dashboard
from prometheus_client.parser import text_string_to_metric_families

from splatmill.schema import PROBLEMS
from splatmill_server.base.scrape import SERVICE_FAULTS
from tests.support.paths import ROOT
from tests.support.programs import program
from tests.support.served_app import ServedApp

MONITORING = ROOT / "server" / "monitoring"
DASHBOARD: dict[str, Any] = json.loads((MONITORING / "dashboard.json").read_text())
RULES: list[dict[str, Any]] = [
    rule
    for group in yaml.safe_load((MONITORING / "alerts.yml").read_text())["groups"]
    for rule in group["rules"]
]
TARGETS = [target["expr"] for panel in DASHBOARD["panels"] for target in panel.get("targets", [])]
QUERIES = [*TARGETS, *(rule["expr"] for rule in RULES)]
PLAYED = Path(__file__).with_name("alerts_test.yml")


def promtool(*arguments: str) -> None:
    """Run promtool, which must find nothing wrong."""
    done = subprocess.run([program("promtool"), *arguments], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def family(named: str) -> str:
    """The name of the metric that a series in a query belongs to."""
    stem = re.sub(r"_(bucket|count|sum)$", "", named)
    return stem if stem in metrics.names() else named


def named_in(query: str) -> set[str]:
    return {family(name) for name in re.findall(r"\bsplatmill_\w+", query)}


def test_every_metric_that_is_asked_for_exists_and_every_one_is_shown() -> None:
    asked = set().union(*map(named_in, QUERIES))
    assert asked <= set(metrics.names())
    shown = set().union(*map(named_in, TARGETS))
    assert shown == set(metrics.names()), "a metric that no panel shows is not needed"


@pytest.mark.parametrize("query", QUERIES)
def test_processes_are_put_together_as_their_metric_is_counted(query: str) -> None:
    """The innermost aggregation around each metric; `sum` of what all tell alike would count it several times."""
    inner = re.findall(
        r"\b(sum|max|min)\s*(?:by \([^)]*\)\s*)?\((?:\s*(?:rate|increase)\()?\s*(splatmill_\w+)", query
    )
    assert {family(name) for _, name in inner} == named_in(query)
    for aggregation, name in inner:
        assert aggregation == metrics.names()[family(name)], name


def test_what_a_running_server_tells_is_documented(app: ServedApp) -> None:
    app.job()
    told = {metric.name for metric in text_string_to_metric_families(app.http.get("/metrics").text)}
    documented = {name.removesuffix("_total") for name in metrics.names()}
    # prometheus_client adds to each counter and histogram when it began.
    assert {name.removesuffix("_created") for name in told} <= documented | {"splatmill_jobs"}
    page = metrics.page()
    assert all(f"`{name}`" in page for name in metrics.names())


def test_every_alert_has_a_section_that_says_what_to_do() -> None:
    sections = re.findall(r"^### (\w+)$", (ROOT / "docs" / "operating.md").read_text(), re.M)
    assert sections == [rule["alert"] for rule in RULES]


def test_failures_of_the_service_are_those_that_are_told_of_from_zero() -> None:
    [rule] = [rule["expr"] for rule in RULES if rule["alert"] == "SplatmillJobsFail"]
    [codes] = re.findall(r'code=~"([^"]+)"', rule)
    assert tuple(codes.split("|")) == SERVICE_FAULTS
    assert set(SERVICE_FAULTS) <= set(PROBLEMS)


def test_the_dashboard_is_what_grafanas_types_make_of_it() -> None:
    read = Dashboard.from_json(DASHBOARD)
    assert json.loads(JSONEncoder().encode(read)) == DASHBOARD, (
        "a field that Grafana does not know would be lost"
    )
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])
    program: dict[str, Any] = {"__file__": str(MONITORING / "dashboard.py"), "__name__": "dashboard"}
    exec(compile((MONITORING / "dashboard.py").read_text(), "dashboard.py", "exec"), program)
    assert program["text"]() == (MONITORING / "dashboard.json").read_text(), "run: make generated"


def test_every_alert_is_played_until_it_fires() -> None:
    tested = yaml.safe_load(PLAYED.read_text())["tests"]
    fired = {
        case["alertname"] for test in tested for case in test["alert_rule_test"] if case.get("exp_alerts")
    }
    assert fired == {rule["alert"] for rule in RULES}


def test_the_alerts_and_the_example_are_valid_and_fire_when_they_must() -> None:
    promtool("check", "rules", str(MONITORING / "alerts.yml"))
    promtool("check", "config", "--syntax-only", str(MONITORING / "prometheus.yml"))
    promtool("test", "rules", str(PLAYED))


def test_the_queries_of_the_dashboard_are_valid(tmp_path: Path) -> None:
    rules = [
        {"record": f"query:{number}", "expr": query.replace("$__rate_interval", "1m")}
        for number, query in enumerate(TARGETS)
    ]
    path = tmp_path / "queries.yml"
    path.write_text(json.dumps({"groups": [{"name": "dashboard", "rules": rules}]}))
    promtool("check", "rules", "--lint=none", str(path))
