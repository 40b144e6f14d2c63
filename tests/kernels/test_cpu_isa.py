"""Every build of the engine that this processor can run gives the same answers; a build is chosen, or refused, as said.

Not proven here: that the builds run on processors older than this one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import torch

from splatmill_worker.kernels.cpu import ISA, isa

# One training step and the separate ops on a fixed scene, printed as sums in hexadecimal and as a few values.
PROGRAM = """
import json, torch
from tests.support.kernels.cases import scene
from splatmill_worker.kernels import cpu, ops
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import Rates
case = scene("isa", 333, width=70, height=45)
step = Step(*case.groups())
photo = torch.randint(0, 256, (45, 70, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
color, alpha, depth = (x.clone() for x in step.forward(*case.camera(), 70, 45, degree=3, background=case.background))
gradients = step.gradients(color - 0.5, alpha, depth)
rates = Rates(1e-3, 1e-3, 1e-3, 1e-2, 1e-3, 1e-4)
results = [step.train(*case.camera(), photo, degree=3, rates=rates, step=i) for i in (1, 2)]
projected = ops.project(*case.groups(), *case.camera(), 70, 45, degree=3)
bins = ops.bin(projected, 70, 45)
print(json.dumps({
    "isa": cpu.ISA, "loss": [r.loss for r in results], "pairs": results[0].pairs,
    "ids": bins.ids.tolist(), "color": color.flatten().tolist(),
    "gradients": {k: g.flatten().tolist() for k, g in gradients.items()},
    "knn": ops.knn(case.means).tolist(),
}))
"""


def run(program: str, **environment: str) -> subprocess.CompletedProcess[str]:
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    return subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, **environment},
        cwd=root,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def answers(name: str) -> dict[str, object]:
    done = run(PROGRAM, SPLATMILL_CPU_ISA=name)
    assert done.returncode == 0, done.stderr
    found: dict[str, object] = json.loads(done.stdout)
    return found


def test_builds_agree() -> None:
    names = isa.supported()
    assert names[-1] == "baseline"
    best, *others = (answers(name) for name in names)
    assert best["isa"] == names[0]
    for other, name in zip(others, names[1:], strict=True):
        assert other["isa"] == name
        assert other["pairs"] == best["pairs"]
        assert other["ids"] == best["ids"]
        # One rounding or two in a fused multiply-add, reciprocal estimates of 12 or 14 bits before their Newton step.
        torch.testing.assert_close(other["loss"], best["loss"], rtol=1e-6, atol=0)
        torch.testing.assert_close(other["color"], best["color"], rtol=0, atol=2e-6)
        torch.testing.assert_close(other["knn"], best["knn"], rtol=1e-5, atol=0)
        mine, theirs = best["gradients"], other["gradients"]
        assert isinstance(mine, dict)
        assert isinstance(theirs, dict)
        for key in mine:
            a, b = torch.tensor(mine[key]), torch.tensor(theirs[key])
            assert (a - b).norm() <= 1e-5 * a.norm(), (name, key)


def test_the_best_build_is_chosen_unless_told() -> None:
    assert (os.environ.get(isa.VARIABLE) or isa.supported()[0]) == ISA
    for name in isa.supported():
        assert isa.load(name).supported() == list(isa.supported())


def test_a_build_that_does_not_exist_is_refused() -> None:
    done = run("import splatmill_worker.kernels.cpu", SPLATMILL_CPU_ISA="neon")
    assert done.returncode != 0
    assert (
        "SPLATMILL_CPU_ISA='neon' is not a build of the CPU engine; choose one of avx512, avx2, baseline."
        in done.stderr
    )


def test_a_build_beyond_the_processor_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isa, "supported", lambda: ("baseline",))
    with pytest.raises(RuntimeError, match="this processor runs only baseline"):
        isa.load("avx512")


def test_threads_follow_the_environment_and_the_affinity_mask() -> None:
    program = "from splatmill_worker.kernels.cpu import engine; print(engine.default_threads())"
    assert run(program, OMP_NUM_THREADS="1").stdout.strip() == "1"
    first = sorted(os.sched_getaffinity(0))[0]
    pinned = f"import os; os.sched_setaffinity(0, [{first}]); {program}"
    assert run(pinned, OMP_NUM_THREADS="2").stdout.strip() == "1"


def test_denormals_are_flushed_inside_the_kernels_only() -> None:
    """A kernel must not leave its thread's floating-point state to the rest of the process."""
    from splatmill_worker.kernels import ops
    from tests.support.kernels.cases import scene

    case = scene("state", 40)
    ops.project(*case.groups(), *case.camera(), case.width, case.height, degree=3)
    tiny = torch.tensor([1e-30], dtype=torch.float32)
    assert float(tiny * 1e-10) != 0.0
    for _ in range(8):  # on whichever of torch's threads
        assert torch.count_nonzero(torch.full((100_000,), 1e-30) * 1e-10) == 100_000
