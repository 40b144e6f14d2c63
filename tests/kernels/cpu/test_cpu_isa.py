"""All builds of the engine that this processor can run agree; the environment chooses a build, or is refused by name.

Not proven here: that the builds run on processors older than this one.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from typing import Any

import pytest
import torch

from splatmill_worker.kernels import cpu, ops
from splatmill_worker.kernels.cpu import isa
from splatmill_worker.kernels.cpu.step import Step
from splatmill_worker.kernels.records import Rates
from tests.support.kernels.cases import scene
from tests.support.kernels.proof import use
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

RATES = Rates(1e-3, 1e-3, 1e-3, 1e-2, 1e-3, 1e-4)


def run(program: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, **environment},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def answers(name: str) -> dict[str, Any]:
    """Two training steps and the separate ops on a fixed scene, by one build."""
    case = scene("isa", 333, width=70, height=45)
    g = torch.Generator().manual_seed(0)
    photo = torch.randint(0, 256, (45, 70, 3), generator=g, dtype=torch.uint8)
    with use(f"cpu:{name}"):
        step = Step(*case.groups())
        color, alpha, depth = (
            x.clone() for x in step.forward(*case.camera(), 70, 45, degree=3, background=case.background)
        )
        gradients = step.gradients(color - 0.5, alpha, depth)
        results = [step.train(*case.camera(), photo, degree=3, rates=RATES, step=i) for i in (1, 2)]
        bins = ops.bin(case.project(case.groups(), case.viewmat, "cpu"), 70, 45)
        nearest = ops.knn(case.means)
    return {
        "loss": torch.tensor([r.loss for r in results]),
        "pairs": results[0].pairs,
        "ids": bins.ids,
        "color": color,
        "gradients": gradients,
        "knn": nearest,
    }


def test_builds_agree() -> None:
    names = isa.supported()
    assert names[-1] == "baseline"
    best, *others = (answers(name) for name in names)
    for other, name in zip(others, names[1:], strict=True):
        assert other["pairs"] == best["pairs"]
        assert torch.equal(other["ids"], best["ids"])
        # One rounding or two in a fused multiply-add, reciprocal estimates of 12 or 14 bits before their Newton step.
        torch.testing.assert_close(other["loss"], best["loss"], rtol=1e-6, atol=0)
        torch.testing.assert_close(other["color"], best["color"], rtol=0, atol=2e-6)
        torch.testing.assert_close(other["knn"], best["knn"], rtol=1e-5, atol=0)
        for key, a in best["gradients"].items():
            assert (a - other["gradients"][key]).norm() <= 1e-5 * a.norm(), (name, key)


def test_the_best_build_is_chosen_unless_told() -> None:
    assert (os.environ.get(isa.VARIABLE) or isa.supported()[0]) == cpu.ISA
    for name in isa.supported():
        engine = isa.load(name)
        assert engine.__name__.endswith(f"_cpu_{name}")
        assert engine.supported() == list(isa.supported())


def test_a_build_that_does_not_exist_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(isa.VARIABLE, "neon")
    said = "SPLATMILL_CPU_ISA='neon' is not a build of the CPU engine; choose one of avx512, avx2, baseline."
    with pytest.raises(RuntimeError, match=re.escape(said)):
        isa.load(isa.chosen())


def test_a_build_beyond_the_processor_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isa, "supported", lambda: ("baseline",))
    with pytest.raises(RuntimeError, match="this processor runs only baseline"):
        isa.load("avx512")


def test_build_and_threads_follow_the_environment_and_the_affinity_mask() -> None:
    program = (
        "from splatmill_worker.kernels import cpu; print(cpu.engine.__name__, cpu.engine.default_threads())"
    )
    asked = run(program, OMP_NUM_THREADS="1", SPLATMILL_CPU_ISA="baseline")
    assert asked.stdout.split() == ["splatmill_worker.kernels.cpu._cpu_baseline", "1"], asked.stderr
    first = sorted(os.sched_getaffinity(0))[0]
    pinned = f"import os; os.sched_setaffinity(0, [{first}]); {program}"
    assert run(pinned, OMP_NUM_THREADS="2").stdout.split()[1] == "1"


def test_denormals_are_flushed_inside_the_kernels_only() -> None:
    """A kernel must not leave its thread's floating-point state to the rest of the process."""
    from splatmill_worker.kernels import ops
    from splatmill_worker.kernels.cpu.step import Step
    from splatmill_worker.kernels.records import Rates
    from tests.support.kernels.cases import scene

    case = scene("state", 40)
    step = Step(*case.groups())
    step.replace(step.parameters(), torch.full((40, 59), 1e-39), torch.full((40, 59), 1e-39))
    image, _, _ = step.forward(*case.camera(), case.width, case.height, degree=3)
    step.backward_update(torch.zeros_like(image), rates=Rates(0.1, 0.1, 0.1, 0.1, 0.1, 0.1), step=1)
    assert not any(moment.any() for moment in step.moments())  # 0.9 * 1e-39 is a denormal number as well
    ops.project(*case.groups(), *case.camera(), case.width, case.height, degree=3)
    tiny = torch.tensor([1e-30], dtype=torch.float32)
    assert float(tiny * 1e-10) != 0.0
    for _ in range(8):  # on whichever of torch's threads
        assert torch.count_nonzero(torch.full((100_000,), 1e-30) * 1e-10) == 100_000
