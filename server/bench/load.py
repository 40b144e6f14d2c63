"""How fast the service answers, against the number of its clients, while a training runs.

    splatmill bench load                            # 10 to 400 clients, twenty seconds each
    splatmill bench load --clients 200 --label "with uvloop"
    splatmill bench load --profile                  # what the API spends its time with, at the last number of clients

One `splatmill up` on this machine, whose cores the clients, the training and the renderer share. The clients are
described in `_load/clients.py`. Each number of clients gets rows with p50 and p99 by kind of request, the CPU seconds a
second and the memory of each process.

Clients arrive independently of each other. When they began together, second by second, half of a job's answer at 50
clients was the wait for those that had come with it; with equal waits, 40 % of 200 clients came within 80 ms of each
second, and a job was answered in 40 ms where it is now in 5.

The figures at 200 clients differ between runs: p99 of a job was 31 and 42 ms where they came after 10, 50 and 100
clients, and 100 and 140 ms where they were asked alone, soon after the training had begun. Asked alone, one run each of
20 seconds, p99 of a job and of a view: 140 and 370 ms; with a niceness of 5 for attempts 88 and 260, of 19 85 and 270,
with SCHED_IDLE 48 and 180; without a training 35 and 160. Attempts run at the priority of their worker all the same:
beside any other program that computes, a training with SCHED_IDLE would stand still.

The CPU time that the API takes for an answer is told too, because other programs on the machine disturb it least.

Expected before the first measurement: one process with one event loop is the knee, and most of a request is spent in
Python around it: thread hops of dependencies that do nothing, and the HTTP parser. At 200 clients, p99 under 50 ms for
a job and under 100 ms for a view of 640x480.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import _plot
import httpx
import psutil
from _page import table
from _rows import Row, distinct, footer, of, worked
from _still_life import posed_capture
from _studies.study import Study
from _up import served
from matplotlib.figure import Figure

HERE = Path(__file__).resolve().parent

COUNTS = (10, 50, 100, 200, 400)
WIDTH, HEIGHT = 640, 480
PHOTOS = 24
BUDGET = "20s"
"""Training of the model that clients look at."""

_COUNTER = "splatmill_http_requests_total{"

_PROCESSES = {
    "api": "splatmill_server.up.api",
    "redis": "redis.sock",
    "renderer": "splatmill_worker renderer",
    "worker": "splatmill_worker train",
}


def _measure(asked: argparse.Namespace) -> Iterator[Row]:
    with tempfile.TemporaryDirectory(prefix="splatmill-load-") as folder, served(Path(folder)) as (url, up):
        http = httpx.Client(base_url=url, timeout=60, trust_env=False)
        capture = _upload(http)
        model = _job(http, capture, {"time_budget": BUDGET})
        _wait(lambda: http.get(f"/v1/jobs/{model}").json()["state"] == "succeeded", 300)
        camera = http.get(f"/v1/models/{model}/cameras").json()["cameras"][0]["camera"]
        camera = {**camera, "width": WIDTH, "height": HEIGHT}
        for name in ("fx", "fy", "cx", "cy"):
            camera.pop(name, None)
        camera |= {"fov_y_deg": 50}
        job = _job(http, capture, {"steps": 200_000})
        _wait(lambda: http.get(f"/v1/jobs/{job}").json()["state"] == "training", 120)
        if asked.idle:
            http.post(f"/v1/jobs/{job}/cancel")
        for count in asked.clients:
            outcome = _with_clients(url, up, count, asked, job, model, camera)
            for row in outcome["requests"]:
                yield {
                    "bench": "load", "label": asked.label, "clients": count, "seconds": asked.seconds,
                    "training": not asked.idle, **row, "processes": outcome["processes"],
                }  # fmt: skip
            print(outcome["processes"], outcome["errors"][:5], flush=True)
        http.post(f"/v1/jobs/{job}/cancel")
        http.close()


def _with_clients(
    url: str, up: psutil.Process, count: int, asked: argparse.Namespace, job: str, model: str, camera: Row
) -> Row:
    """Return what the clients met, and what the processes took meanwhile."""
    arguments = {
        "url": url,
        "clients": count,
        "seconds": asked.seconds,
        "job": job,
        "model": model,
        "camera": camera,
    }
    environment = os.environ | {"PYTHONPATH": str(HERE)}
    clients = subprocess.Popen(
        [sys.executable, "-m", "_load.clients", json.dumps(arguments)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    api = _child(up, _PROCESSES["api"])
    before, cpu, all_before, begun = _answered(url), _cpu(api), worked(), time.monotonic()
    with _watched(up, clients.pid) as taken:
        if asked.profile and count == asked.clients[-1]:
            _profile(up, asked.seconds)
        said, complaints = clients.communicate(timeout=asked.seconds + 120)
    if clients.returncode:
        raise SystemExit(f"The {count} clients ended with status {clients.returncode}:\n{complaints[-2000:]}")
    taken["machine"] = {"cores": round((worked() - all_before) / (time.monotonic() - begun), 2)}
    taken["api"]["ms_per_answer"] = round(1000 * (_cpu(api) - cpu) / max(1, _answered(url) - before), 2)
    outcome: Row = json.loads(said.splitlines()[-1])
    return outcome | {"processes": taken}


def _answered(url: str) -> float:
    """Return how many requests the API has answered."""
    text = httpx.get(f"{url}/metrics", timeout=60, trust_env=False).text
    return sum(float(line.rpartition(" ")[2]) for line in text.splitlines() if line.startswith(_COUNTER))


@contextmanager
def _watched(up: psutil.Process, clients: int) -> Iterator[dict[str, Any]]:
    """Fill in the CPU seconds a second and the largest memory of each process, and the share of the clients."""
    processes = {name: _child(up, words) for name, words in _PROCESSES.items()}
    trainers = processes["worker"].children()
    if trainers:
        processes["training"] = trainers[0]
    processes["clients"] = psutil.Process(clients)
    memory = dict.fromkeys(processes, 0)
    begun, before = time.monotonic(), {name: _cpu(process) for name, process in processes.items()}
    last = dict(before)
    stop = threading.Event()

    def look() -> None:
        while not stop.wait(0.5):
            for name, process in processes.items():
                with suppress(psutil.Error):
                    memory[name] = max(memory[name], process.memory_info().rss)
                    last[name] = _cpu(process) or last[name]  # the clients have ended when all is over

    thread = threading.Thread(target=look)
    taken: dict[str, Any] = {}
    thread.start()
    try:
        yield taken
    finally:
        seconds = time.monotonic() - begun
        stop.set()
        thread.join()
        for name in processes:
            cores = round((last[name] - before[name]) / seconds, 2)
            taken[name] = {"cores": cores, "bytes": memory[name]}


def _cpu(process: psutil.Process) -> float:
    try:
        times = process.cpu_times()
    except psutil.Error:
        return 0.0
    return float(times.user + times.system)


def _profile(up: psutil.Process, seconds: float) -> None:
    """Print the samples of py-spy, which is no dependency: `pip install py-spy`."""
    target = HERE / "results" / "load.profile"
    api = _child(up, _PROCESSES["api"])
    time.sleep(8)  # until the clients have come
    command = [
        "py-spy",
        "record",
        "-p",
        str(api.pid),
        "-d",
        str(int(seconds) - 2),
        "-f",
        "raw",
        "-o",
        str(target),
    ]
    subprocess.run(command, check=True)
    print(f"Stacks of the API, one line each with its samples: {target}")


def _upload(http: httpx.Client) -> str:
    capture = str(http.post("/v1/captures", json={}).json()["id"])
    for name, content in posed_capture(PHOTOS, 320, 240).items():
        http.put(f"/v1/captures/{capture}/{name}", content=content).raise_for_status()
    return capture


def _job(http: httpx.Client, capture: str, options: Row) -> str:
    answer = http.post("/v1/jobs", json={"capture": capture, "options": options})
    return str(answer.raise_for_status().json()["id"])


def _wait(condition: Any, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f"The service was not where it should be after {seconds:g} s.")
        time.sleep(0.2)


def _child(up: psutil.Process, words: str) -> psutil.Process:
    children: list[psutil.Process] = up.children()
    return next(child for child in children if words in " ".join(child.cmdline()))


def tables(rows: list[Row]) -> str:
    """A table for each label."""
    text = []
    for label in distinct(rows, "label"):
        of_label = of(rows, label=label)
        text += [f"## {label}"] if label else []
        whats = distinct((row for row in of_label if row["requests"]), "what")
        head = [
            "clients", *(f"{what}, p50 / p99 ms" for what in whats), "requests a second", "errors",
            "API, CPU ms an answer",
            "cores: API, Redis, renderer, training, clients, whole machine", "memory: API, Redis, renderer MB",
        ]  # fmt: skip
        counts = sorted({row["clients"] for row in of_label})
        lines = [_line(of(of_label, clients=count), whats, count) for count in counts]
        text.append(table("|".join(head), lines))
    return "\n\n".join(text)


def _line(rows: list[Row], whats: list[str], count: int) -> list[object]:
    newest = {row["what"]: row for row in rows}
    cells = []
    for what in whats:
        row = newest.get(what)
        cells.append(f"{row['p50_ms']:.0f} / {row['p99_ms']:.0f}" if row and row["requests"] else "-")
    served = sum(row["requests"] / row["seconds"] for row in newest.values() if row["what"] != "events")
    errors = sum(row["errors"] for row in newest.values())
    taken = rows[-1]["processes"]
    cores = ", ".join(
        f"{taken[n]['cores']:.2f}"
        for n in ("api", "redis", "renderer", "training", "clients", "machine")
        if n in taken
    )
    memory = ", ".join(f"{taken[n]['bytes'] / 1e6:.0f}" for n in ("api", "redis", "renderer"))
    cost = f"{taken['api']['ms_per_answer']:.1f}"
    return [count, *cells, f"{served:.0f}", errors, cost, cores, memory]


def _draw(rows: list[Row]) -> Figure:
    figure, panels = _plot.axes(2)
    for panel, what in zip(panels, ("job", "view"), strict=True):
        for label in distinct(rows, "label"):
            by_count = {row["clients"]: row for row in of(rows, what=what, label=label)}
            counts = sorted(by_count)
            for key, style in (("p50_ms", "--"), ("p99_ms", "-")):
                name = f"{key[:3]} {label}".strip()
                panel.plot(counts, [by_count[count][key] for count in counts], style, marker="o", label=name)
        panel.axhline(50 if what == "job" else 100, color="#999999", linewidth=0.8)
        panel.set(xlabel="clients", ylabel="milliseconds", xscale="log", yscale="log", title=what)
        panel.legend(fontsize=8)
    return figure


STUDY = Study(
    name="load",
    about=__doc__,
    cases={"clients": _measure},
    key=("label", "clients", "what", "training"),
    home=HERE,
    parts=("server", "client"),
    blocks={"tables": tables, "footer": footer},
    figures={"load": _draw},
    options={
        "clients": {"type": int, "nargs": "+", "default": list(COUNTS)},
        "seconds": {"type": float, "default": 20.0, "help": "seconds of each number (default: 20)"},
        "label": {"default": "", "help": "what is compared: a name of this state of the code"},
        "idle": {"action": "store_true", "help": "no training runs meanwhile"},
        "profile": {"action": "store_true", "help": "print where the API process spends its time"},
    },
)
main = STUDY.main
