"""Every Triton kernel compiles for sm_80 and sm_90 on a machine without a GPU, and spills no register.

All settings that the autotuner may choose are compiled for sm_90; for sm_80 the one used where nothing was
measured. Says nothing about speed, and nothing about whether the compiled code is right: the interpreter and
the device tests do that.
"""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to compile the kernels here"
)

SPILLS: dict[str, int] = {}
"""Bytes of stack per thread that a kernel may use, by name; none may. A spill that pays is written down
here, with the reason.
"""

KERNELS = {
    "project_kernel", "color_backward_kernel", "shape_backward_kernel", "pairs_kernel", "composite_kernel",
    "composite_backward_kernel", "across_kernel", "value_kernel", "down_kernel", "gradient_kernel", "row_stats_kernel",
    "stats_kernel", "scores_kernel",
    "planes_kernel", "drift_kernel", "knn_kernel", "compact_kernel", "over_kernel", "total_kernel",
    "median_depth_kernel",
}  # fmt: skip


def start(*arguments: str) -> subprocess.Popen[str]:
    # Another process, because here the interpreter has taken the compiler's place.
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    command = [sys.executable, "-m", "splatmill_worker.kernels.gpu.compiled", *arguments]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.fixture(scope="module")
def compiled() -> list[dict[str, object]]:
    running = [start("90"), start("--first", "80")]
    rows = []
    for process in running:
        said, complained = process.communicate(timeout=600)
        assert process.returncode == 0, complained
        rows += [json.loads(line) for line in said.splitlines()]
    return rows


def test_every_kernel_compiles_for_both(compiled: list[dict[str, object]]) -> None:
    for architecture in (80, 90):
        assert {row["kernel"] for row in compiled if row["architecture"] == architecture} == KERNELS


def test_no_kernel_spills_more_than_is_written_down(compiled: list[dict[str, object]]) -> None:
    over = [row for row in compiled if int(str(row["spilled"])) > SPILLS.get(str(row["kernel"]), 0)]
    assert not over, "\n".join(json.dumps(row) for row in over)


def test_no_kernel_asks_for_more_shared_memory_than_every_such_card_has(
    compiled: list[dict[str, object]],
) -> None:
    # 99 KiB per program on sm_86 and sm_89, the smallest of the generation.
    assert all(int(str(row["shared"])) <= 99 * 1024 for row in compiled)


def test_every_kernel_of_the_package_is_in_the_list() -> None:
    """A kernel that is launched somewhere and compiled nowhere would escape the check."""
    spec = importlib.util.find_spec("splatmill_worker.kernels.gpu")
    assert spec is not None
    assert spec.origin is not None
    folder = Path(spec.origin).parent
    written = {
        node.name
        for file in folder.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.FunctionDef) and node.name.endswith("_kernel")
    }
    assert written == KERNELS
