"""Ten thousand requests made up from the OpenAPI document, many of them in sequences that follow from each other.

    splatmill bench openapi                        # one round after the other until there are 10000; ten minutes
    splatmill bench openapi --requests 1000 --seed 7

`splatmill up` with an API key, a worker and a renderer, and what schemathesis knows to try: values at the edges of each
schema, made-up ones that fit it and that do not, and sequences along the links between operations. Half of the ids are
those of records, among them a model with its files, a share and a webhook (`_openapi/hooks.py`). The checks: no answer
is a server error; status, headers, media type and body are those of the document; what is refused without a key; what
was made can be read, and what was deleted cannot. Streams of events, which do not end, are left out.

Ends with status 1 if a check failed, if a request was not
answered, if the service logged an error that it did not expect, or if it is not ready at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
from _page import table
from _rows import Row, footer
from _still_life import posed_capture
from _studies.study import Study
from _up import served

from splatmill_server.base.settings import Settings

HERE = Path(__file__).resolve().parent

KEY = "bench-openapi"
PHASES = ("coverage", "fuzzing", "stateful")

LEFT_OUT = {
    "unsupported_method": "PUT of captures/{id}/imports/{name} is the address of a file whose role is refused",
    "negative_data_rejection": "a number may come as text in a query, where all is text",
    "positive_data_acceptance": "what a schema allows may be refused for what is stored",
}
"""Checks of schemathesis that are not made, and why."""

_UNEXPECTED = ("unexpected error", "Traceback")


def measured(options: argparse.Namespace) -> Iterator[Row | str]:
    row = measure(options.requests, options.seed, options.examples, options.phases)
    yield row
    if not row["ready"] or row["failures"] or row["errors"] or row["unexpected"]:
        yield "Not all held: the row has the failures."


def measure(requests: int, seed: int, examples: int, phases: list[str]) -> Row:
    """Return a row: the requests of all rounds, what became of them, and each failure with its reason."""
    with (
        tempfile.TemporaryDirectory(prefix="splatmill-openapi-") as name,
        served(Path(name), {"SPLATMILL_API_KEY": KEY, "SPLATMILL_OUTGOING_ALLOW": "127.0.0.1:9"}) as (
            url,
            up,
        ),
    ):
        folder = Path(name)
        http = httpx.Client(
            base_url=url, headers={"Authorization": f"Bearer {KEY}"}, timeout=120, trust_env=False
        )
        kept = _records(http)
        api = next(child for child in up.children() if "splatmill_server.up.api" in " ".join(child.cmdline()))
        before, begun = api.memory_info().rss, time.monotonic()
        reports: list[Row] = []
        while sum(report["test_cases"]["generated"] for report in reports) < requests:
            reports.append(_round(url, kept, folder, seed + len(reports), examples, phases))
        seconds = time.monotonic() - begun
        ready = http.get("/readyz").status_code == 200 and psutil.pid_exists(api.pid)
        grown = api.memory_info().rss - before
        http.close()
        log = (folder / "up.log").read_text(errors="replace")
    unexpected = [line[:500] for line in log.splitlines() if any(word in line for word in _UNEXPECTED)]
    return {
        "bench": "openapi",
        "requests": sum(report["test_cases"]["generated"] for report in reports),
        "rounds": len(reports),
        "seed": seed,
        "operations": reports[0]["operations"]["tested"],
        "seconds": round(seconds, 1),
        "outcomes": _outcomes(reports),
        "failures": [failure for report in reports for failure in report["failures"]],
        "errors": [error for report in reports for error in report["errors"]],
        "unexpected": unexpected,
        "ready": ready,
        "grown_bytes": grown,
    }


def _round(url: str, kept: Row, folder: Path, seed: int, examples: int, phases: list[str]) -> Row:
    """Run schemathesis once, and return its report."""
    report = folder / f"report-{seed}.json"
    told = {"url": url, "key": KEY, "kept": kept}
    environment = os.environ | {
        "PYTHONPATH": str(HERE),
        "SCHEMATHESIS_HOOKS": "_openapi.hooks",
        "SPLATMILL_BENCH_OPENAPI": json.dumps(told),
        "NO_PROXY": "*",
    }
    command = [str(Path(sys.executable).parent / "schemathesis"), "run", f"{url}/openapi.json"]
    command += ["--header", f"Authorization: Bearer {KEY}", "--phases", ",".join(phases)]
    command += ["--max-examples", str(examples), "--seed", str(seed), "--generation-database", "none"]
    command += ["--checks", "all", "--exclude-checks", ",".join(LEFT_OUT)]
    command += ["--exclude-path-regex", "/events$", "--continue-on-failure", "--no-shrink", "--no-color"]
    longest = str(Settings.model_fields["orbit_timeout"].default)  # what the API itself waits for a video
    command += ["--request-timeout", longest, "--max-response-time", longest]
    command += ["--report", "json", "--report-json-path", str(report)]
    ran = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    if not report.is_file():
        raise SystemExit(
            f"schemathesis ended with status {ran.returncode}:\n{ran.stdout[-2000:]}{ran.stderr[-2000:]}"
        )
    content: Row = json.loads(report.read_text())
    if content["exit_code"]:
        print(ran.stdout[-60_000:], flush=True)
    return content


def _records(http: httpx.Client) -> dict[str, list[str]]:
    """Make a capture, a model with a share, and a webhook; return their ids by the name of the path parameter."""
    capture = str(http.post("/v1/captures", json={"name": "of the bench"}).raise_for_status().json()["id"])
    for name, content in posed_capture(6, 64, 48).items():
        http.put(f"/v1/captures/{capture}/{name}", content=content).raise_for_status()
    asked = {"capture": capture, "options": {"steps": 20}}
    job = str(http.post("/v1/jobs", json=asked).raise_for_status().json()["id"])
    end = time.monotonic() + 300
    while (state := http.get(f"/v1/jobs/{job}").raise_for_status().json()["state"]) != "succeeded":
        if state in ("failed", "cancelled") or time.monotonic() > end:
            raise SystemExit(f"The model could not be trained: {http.get(f'/v1/jobs/{job}').text}")
        time.sleep(0.2)
    share = http.post(f"/v1/models/{job}/shares", json={}).raise_for_status().json()
    hook = http.post("/v1/webhooks", json={"url": "http://127.0.0.1:9/"}).raise_for_status().json()
    return {
        "capture_id": [capture],
        "job_id": [job],
        "model_id": [job],
        "share_id": [share["id"]],
        "token": [share["token"]],
        "webhook_id": [hook["id"]],
    }


def _outcomes(reports: list[Row]) -> dict[str, int]:
    """Return how many requests were accepted, refused as bad, named nothing, or met another state."""
    sums: dict[str, int] = {}
    for report in reports:
        for phases in report["valid_rates"].values():
            for counts in phases.values():
                for outcome, count in counts.items():
                    sums[outcome] = sums.get(outcome, 0) + count
    return sums


def summary(rows: list[Row]) -> str:
    """What came of the newest run."""
    row = rows[-1]
    return (
        f"{row['requests']} requests to {row['operations']} operations in {row['rounds']} rounds, "
        f"{row['seconds']:.0f} seconds: {sum(f['count'] for f in row['failures'])} failed checks, "
        f"{len(row['errors'])} errors of the tool, {len(row['unexpected'])} unexpected errors in the service's log. "
        f"The API process grew by {row['grown_bytes'] / 1e6:.0f} MB; at the end the service "
        f"{'was' if row['ready'] else 'was not'} ready."
    )


def outcomes(rows: list[Row]) -> str:
    """The outcomes of well-formed requests, and the checks that failed."""
    words = {
        "accepted": "accepted",
        "rejected": "refused for their content",
        "unreachable": "named a record that is not there",
        "conflicts": "met a record in another state",
    }
    cells = [[words.get(outcome, outcome), count] for outcome, count in rows[-1]["outcomes"].items()]
    text = table("of the well-formed requests|number:", cells)
    failures = [[_named(each), each["count"], _where(each)] for each in rows[-1]["failures"]]
    return f"{text}\n\n{table('failed check|times:|operations', failures)}" if failures else text


def _named(failure: dict[str, Any]) -> str:
    return f"{failure['title']} ({failure['code']})"


def _where(failure: dict[str, Any]) -> str:
    return ", ".join(f"`{operation}`" for operation in failure["operations"])


STUDY = Study(
    name="openapi",
    about=__doc__,
    cases={"requests": measured},
    key=("bench",),
    home=HERE,
    parts=("server", "client"),
    blocks={
        "summary": summary,
        "outcomes": outcomes,
        "unchecked": lambda _: "\n".join(f"- `{check}`: {reason}." for check, reason in LEFT_OUT.items()),
        "footer": footer,
    },
    figures={},
    options={
        "requests": {"type": int, "default": 10_000, "help": "at least (default: 10000)"},
        "seed": {"type": int, "default": 0, "help": "of the first round (default: 0)"},
        "examples": {"type": int, "default": 20, "help": "for each operation, in a round (default: 20)"},
        "phases": {"nargs": "+", "default": list(PHASES), "choices": PHASES},
    },
)
main = STUDY.main
