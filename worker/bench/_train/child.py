"""Starting a process for one job: every row has its own memory, threads and clock."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from _rows import Row

from _train import configurations, few
from _train.rows import BenchRun
from _train.scenes import Scene, named

LAST_WORDS = 2000
"""Characters of a failed process's standard error that are shown."""


class Fault(Exception):
    """A process ended without a result; the message holds the end of its standard error."""


def prepared(scene: Scene, work: Path) -> Row:
    """The numbers of views and points of the scene with its cameras; `failure` says why there are none."""
    return _ask({"do": "prepare", **located(scene, work), "options": scene.options})


def measured(run: BenchRun, work: Path) -> Row:
    """The row of a run, or of its named failure. Raises Fault."""
    return _ask(
        {
            "do": "measure",
            **located(
                run.scene, work, f"sfm-{run.config}" if configurations.named(run.config).recovers else "sfm"
            ),
            "identity": run.identity(),
            "budget": run.budget.options,
        }
    )


def judged(scene: Scene, name: str, model: Path, seconds: float, work: Path) -> Row:
    """The row of a peer's model; `failure` says why it cannot be judged. Raises Fault."""
    job = {"scene": scene.name, "options": scene.options, "name": name, "model": str(model)}
    return _ask({"do": "judge", **located(scene, work), **job, "seconds": seconds})


def located(scene: Scene, work: Path, cameras: str = "sfm") -> Row:
    """Where a job finds the capture of a scene and keeps its cameras, and so for the scene that it is a part of.

    cameras: the folder of the scene's that they are kept in.
    """
    kept = work / scene.name / cameras
    place: Row = {"capture": str(scene.folder), "made": scene.made, "sfm": str(kept.resolve())}
    if scene.name in few.SCENES:
        whole = named(few.SCENES[scene.name][0], work)
        place["whole"] = {**located(whole, work), "options": whole.options}
    return place


def _ask(job: Row) -> Row:
    with tempfile.TemporaryDirectory(prefix="splatmill-bench-") as folder:
        answer = Path(folder) / "answer.json"
        command = [sys.executable, "-m", "splatmill_worker", "bench", "train", "--job"]
        done = subprocess.run(
            [*command, json.dumps(job | {"answer": str(answer)})],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
        if not answer.is_file():
            raise Fault(
                f"the process ended with status {done.returncode} and left no row:\n{done.stderr[-LAST_WORDS:]}"
            )
        row: Row = json.loads(answer.read_text())
        return row
