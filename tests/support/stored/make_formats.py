"""`python tests/support/stored/make_formats.py FOLDER`: writes a copy of all that the service stores, as fixtures.

It runs the real service (`splatmill_server.up`) on a tiny posed capture and stores in FOLDER:

    redis.json       all keys of Redis, by type, but the record of the worker, which names the machine
    storage/         storage: captures, and the finished model with job.json and report.json
    work/            plan.json, stages.json and the checkpoint of a job that was interrupted by the end of the service
    jobs.json        ids of the jobs by what became of them: succeeded, failed, cancelled, interrupted, queued

It imports nothing of the tests, so that it can run on an earlier commit: with the Python of a checkout of it.
"""

import base64
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
import redis

from splatmill_worker.synthetic import capture as photograph

COUNT, WIDTH, HEIGHT = 8, 64, 48
OPTIONS = {
    "preset": "draft",
    "seed": 1,
    "sh_degree": 0,
    "max_gaussians": 400,
    "gaps": "off",
    "far_shell": "off",
}
LEFT_OUT = {"report.html", "report.png"}
"""Files of a model that are not stored here: large, and read by no program."""


class Service:
    """The service on a data folder."""

    def __init__(self, data: Path) -> None:
        program = [sys.executable, "-m", "splatmill_server.up", "--json-ready", "--port", "0"]
        self.data = data
        self.process = subprocess.Popen(
            [*program, "--data", str(data)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.http = httpx.Client(base_url=json.loads(self.process.stdout.readline())["url"], timeout=60)
        children = psutil.Process(self.process.pid).children()
        self.redis = next(child.exe() for child in children if "redis.sock" in " ".join(child.cmdline()))

    def stop(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(120)

    def post(self, path: str, **sent: Any) -> Any:
        answer = self.http.post(path, **sent)
        assert answer.is_success, answer.text
        return answer.json()

    def capture(self, name: str, files: dict[str, bytes]) -> str:
        made = str(self.post("/v1/captures", json={"name": name})["id"])
        for path, body in files.items():
            answer = self.http.put(f"/v1/captures/{made}/{path}", content=body)
            assert answer.is_success, answer.text
        return made

    def job(self, capture: str, name: str, **options: Any) -> str:
        body = {"capture": capture, "name": name, "options": OPTIONS | options}
        return str(self.post("/v1/jobs", json=body, headers={"Idempotency-Key": name})["id"])

    def until(self, job_id: str, reached: Callable[[Any], bool]) -> None:
        end = time.monotonic() + 240
        while not reached(job := self.http.get(f"/v1/jobs/{job_id}").json()):
            assert time.monotonic() < end, job
            time.sleep(0.1)


def posed_capture(folder: Path) -> dict[str, bytes]:
    """Return the files of a small capture with known cameras, by role and name."""
    cameras = photograph(folder, COUNT, WIDTH, HEIGHT)
    frames, files = [], {}
    for name, camera in cameras.items():
        matrix = np.eye(4)
        matrix[:3, :3] = camera.viewmat[:3, :3].T @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = camera.center
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
        files[f"images/{name}"] = (folder / name).read_bytes()
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    files["poses/transforms.json"] = json.dumps({**lens, "frames": frames}).encode()
    return files


def run_jobs(data: Path, photos: Path) -> tuple[dict[str, str], str]:
    """Run one job of each kind, end the service while one is trained, and return their ids and the service's Redis."""
    service = Service(data)
    try:
        good = service.capture("still life", posed_capture(photos))
        text = b"this is no photo"
        bad = service.capture("no photos", {f"images/{n}.jpg": text + b"%d" % n for n in range(3)})
        jobs = {"succeeded": service.job(good, "succeeded", steps=60), "failed": service.job(bad, "failed")}
        service.until(jobs["succeeded"], lambda job: job["state"] == "succeeded")
        service.until(jobs["failed"], lambda job: job["state"] == "failed")
        jobs["interrupted"] = service.job(good, "interrupted", steps=900_000)
        service.until(jobs["interrupted"], lambda job: ((job["progress"] or {}).get("step") or 0) > 20)
        jobs["cancelled"] = service.job(good, "cancelled", steps=5)
        service.post(f"/v1/jobs/{jobs['cancelled']}/cancel")
        jobs["queued"] = service.job(good, "queued", steps=5, test_views=["still_0001.jpg"])
    finally:
        service.stop()
    return jobs, service.redis


def dump_redis(program: str, data: Path, folder: Path) -> dict[str, Any]:
    """Return all keys of the Redis `program` whose files lie in `data`: type and contents, as base64 where not text."""
    address = folder / "r.sock"
    copy = folder / "redis"
    shutil.copytree(data / "redis", copy)
    command = [program, "--port", "0", "--unixsocket", str(address), "--dir", str(copy)]
    server = subprocess.Popen([*command, "--appendonly", "yes"], stdout=subprocess.DEVNULL)
    try:
        connection = redis.Redis(unix_socket_path=str(address))
        end = time.monotonic() + 20
        while not address.exists() and time.monotonic() < end:
            time.sleep(0.05)
        connection.ping()
        names = sorted(key for key in connection.scan_iter(b"*") if not key.startswith(b"rq:worker:"))
        return {key.decode(): _contents(connection, key) for key in names}
    finally:
        server.terminate()
        server.wait()


def _contents(connection: Any, key: bytes) -> Any:
    kind = connection.type(key).decode()
    match kind:
        case "string":
            return {"string": _text(connection.get(key))}
        case "hash":
            return {"hash": {_text(k): _text(v) for k, v in sorted(connection.hgetall(key).items())}}
        case "list":
            return {"list": [_text(value) for value in connection.lrange(key, 0, -1)]}
        case "set":
            return {"set": sorted(_text(value) for value in connection.smembers(key))}
        case "zset":
            return {
                "zset": [[_text(v), score] for v, score in connection.zrange(key, 0, -1, withscores=True)]
            }
        case "stream":
            entries = connection.xrange(key)
            return {"stream": [[e.decode(), {_text(k): _text(v) for k, v in f.items()}] for e, f in entries]}
    raise ValueError(f"{key!r} is a {kind}")


def _text(value: bytes) -> str:
    try:
        return value.decode()
    except UnicodeDecodeError:
        return "base64:" + base64.b64encode(value).decode()


def main(target: Path) -> None:
    """Write the fixtures."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        jobs, program = run_jobs(folder / "data", folder / "photos")
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        contents = dump_redis(program, folder / "data", folder)
        text = json.dumps(contents, indent=1).replace(f"{socket.gethostname()}-", "host-")
        (target / "redis.json").write_text(text + "\n")
        (target / "jobs.json").write_text(json.dumps(jobs, indent=1) + "\n")
        shutil.copytree(
            folder / "data" / "storage", target / "storage", ignore=lambda _, names: LEFT_OUT & set(names)
        )
        run = folder / "data" / "work" / jobs["interrupted"] / "run"
        for path in run.rglob("*"):
            name = path.relative_to(run)
            if path.is_file() and (
                name.parts[0] == "checkpoints" or str(name) in ("plan.json", "stages.json")
            ):
                (target / "work" / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, target / "work" / name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
