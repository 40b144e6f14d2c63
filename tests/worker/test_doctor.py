"""Proves that `splatmill doctor` reports this machine, and that it notices a Redis that does not answer.

Does not prove its findings on machines that lack other things.
"""

import json
import os
import subprocess
import sys
from pathlib import Path


def test_doctor_reports_this_machine_and_finds_what_is_wrong(tmp_path: Path) -> None:
    def doctor(**environment: str) -> tuple[int, dict[str, str]]:
        done = subprocess.run(
            [sys.executable, "-m", "splatmill_worker", "doctor", "--json"],
            env=dict(os.environ) | {"SPLATMILL_DATA": str(tmp_path)} | environment,
            capture_output=True,
            text=True,
            timeout=120,
        )
        return done.returncode, {line["topic"]: line["verdict"] for line in json.loads(done.stdout)}

    status, verdicts = doctor()
    assert status == 0
    assert {"python", "kernels", "memory", "disk", "redis", "storage", "gpu"} <= verdicts.keys()
    status, verdicts = doctor(REDIS_URL=f"unix://{tmp_path}/nothing.sock")
    assert status == 1
    assert verdicts["redis"] == "bad"
