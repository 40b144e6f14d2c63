"""Proves that `splatmill doctor` finds this machine in order, and that it names what is wrong and says what to do.

Does not prove its findings on machines without a compiler, without memory or with a GPU.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow


def doctor(data: Path, **environment: str) -> tuple[int, dict[str, dict[str, Any]]]:
    """Exit status and the findings by topic; where a topic has several, the last."""
    done = subprocess.run(
        [sys.executable, "-m", "splatmill_worker", "doctor", "--json"],
        env=dict(os.environ) | {"SPLATMILL_DATA": str(data)} | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    return done.returncode, {finding["topic"]: finding for finding in json.loads(done.stdout)}


def test_this_machine_is_in_order(tmp_path: Path) -> None:
    status, findings = doctor(tmp_path)
    assert status == 0
    topics = {"python", "parts", "colmap", "kernels", "threads", "memory", "disk", "redis", "storage"}
    assert findings.keys() == topics | {"decoders", "gpu"}
    assert not [topic for topic, finding in findings.items() if finding["verdict"] == "bad"]


def test_what_is_wrong_is_found_and_advised_on(tmp_path: Path) -> None:
    status, findings = doctor(
        tmp_path,
        REDIS_URL=f"unix://{tmp_path}/nothing.sock",
        SPLATMILL_STORAGE="ftp://nowhere",
        SPLATMILL_CPU_ISA="baseline",
    )
    assert status == 1
    wrong = {"redis": "bad", "storage": "bad", "kernels": "warning"}
    assert {topic: findings[topic]["verdict"] for topic in wrong} == wrong
    assert all(findings[topic]["advice"] for topic in wrong)
    assert "nothing.sock" in findings["redis"]["result"]
    assert "ftp://nowhere" in findings["storage"]["result"]


def test_a_redis_with_faults_in_lua_is_warned_of(tmp_path: Path) -> None:
    old = tmp_path / "redis-server"
    old.write_text("#!/bin/sh\necho 'Redis server v=7.2.10 sha=00000000:0'\n")
    old.chmod(0o755)
    status, findings = doctor(tmp_path, SPLATMILL_REDIS_SERVER=str(old))
    assert status == 0
    assert findings["redis"]["verdict"] == "warning"
    assert "Redis 7.2.10" in findings["redis"]["result"]
    assert "CVE-2025-49844" in findings["redis"]["result"]
    assert "only the service" in findings["redis"]["advice"]
