"""Apply every mutation of `mutants.py` to a copy of the kernels, build it, and run the proofs against it.

    python worker/mutations/run.py                  # all of them: hours
    python worker/mutations/run.py --fresh          # those that have no row that says they are caught
    python worker/mutations/run.py --backend gpu    # those of Triton's kernels, in its interpreter
    python worker/mutations/run.py --only "half the off-diagonal" --only "green twice"
    python worker/mutations/run.py --next           # those that are known to survive
    python worker/mutations/run.py --table-only

The copy lies in worker/build/mutations, one for each --backend, so that these can run side by side; the source tree is
not touched. One instruction set is built, the best that runs here, without optimisation beyond -O1: contraction is off,
so the results are the same. The proofs that `PROOFS` names for a file run first, then all others, until one fails; in
the end every test that caught a mutant has to pass without mutations. Rows go to mutations.jsonl, the table to
mutations.md. Ends with 1 where a mutant survives.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from mutants import KERNELS, MUTANTS, NEXT, Mutant  # noqa: E402  (beside this file)

from splatmill_worker.kernels.cpu import isa  # noqa: E402

ROOT = HERE.parents[1]
ROWS, TABLE = HERE / "mutations.jsonl", HERE / "mutations.md"
ISA = isa.supported()[0]
TESTS = Path("tests/kernels")

GRADIENTS = ["test_proof_step.py", "test_proof_backward.py"]
FORWARD = ["test_proof_forward.py", "test_proof_step.py"]
GPU_OPS = "test_gpu_ops.py::test_"
PROJECTION = [
    f"{GPU_OPS}{x}"
    for x in ("project_agrees_with_the_definition", "gradient_of_project_agrees_with_the_definition")
]
PROOFS = {
    "cpu/clusters": ["test_cpu_clusters.py"],
    "cpu/pack": ["test_cpu_step.py", "test_cpu_clusters.py"],
    "cpu/adam": ["test_adam.py", "test_cpu_step.py"],
    "cpu/loss": ["test_loss.py"],
    "cpu/knn": ["test_knn.py"],
    "cpu/correlate": ["test_correlate.py"],
    "cpu/median_depth": ["test_median_depth.py"],
    "cpu/waves": ["test_waves.py"],
    "cpu/pose": ["test_cpu_pose.py"],
    "cpu/step": ["test_cpu_step.py", *GRADIENTS],
    "cpu/threads": ["test_cpu_isa.py", "test_proof_poison.py"],
    "cpu/touches": ["test_cpu_step.py", "test_cpu_input.py", *FORWARD],
    "cpu/bin": FORWARD,
    "cpu/reach": FORWARD,
    "cpu/composite_forward": FORWARD,
    "cpu/composite": ["test_proof_backward.py", "test_cpu_input.py"],
    "cpu/project": ["test_proof_backward.py", "test_proof_poison.py"],
    "reference/adam": ["test_adam.py"],
    "reference/knn": ["test_knn.py"],
    "reference/correlate": ["test_correlate.py"],
    "reference/median_depth": ["test_median_depth.py"],
    "reference/loss": ["test_loss.py"],
    "gpu/adam": [f"{GPU_OPS}adam_agrees_with_the_definition", "test_gpu_step.py"],
    "gpu/bin": [
        f"{GPU_OPS}bin_agrees_with_the_definition_but_for_real_crossings",
        f"{GPU_OPS}a_large_image_has_tiles_to_its_last_corner",
        "test_gpu_settings.py::test_every_mode_of_a_training_step_with_small_constants",
    ],
    "gpu/blend": [f"{GPU_OPS}composite_and_its_gradient_agree_with_the_definition"],
    "gpu/composite": [f"{GPU_OPS}composite_and_its_gradient_agree_with_the_definition"],
    "gpu/composite_backward": [f"{GPU_OPS}composite_and_its_gradient_agree_with_the_definition"],
    "gpu/median_depth": [f"{GPU_OPS}median_depth_agrees_with_the_definition"],
    "gpu/photos": ["test_gpu_waiting.py"],
    "gpu/loss": [f"{GPU_OPS}loss_and_its_gradient_agree_with_the_definition"],
    "gpu/knn": [f"{GPU_OPS}knn_agrees_with_the_definition"],
    "gpu/project": [
        *PROJECTION,
        f"{GPU_OPS}a_bad_number_culls_its_gaussian_and_touches_no_other",
        f"{GPU_OPS}a_gaussian_on_the_near_plane_is_culled",
    ],
    "gpu/project_backward": PROJECTION[::-1],
    "gpu/projection": [*PROJECTION, f"{GPU_OPS}the_length_of_a_quaternion_does_not_matter"],
    "gpu/harmonics": PROJECTION[::-1],
}
"""The tests most likely to catch a fault in a file, by its backend and its name without suffix. Where none are named:
`DEFAULT`."""

DEFAULT = {
    "cpu": GRADIENTS,
    "reference": ["test_reference_order.py", "test_reference_gsplat.py"],
    "gpu": ["test_gpu_step.py"],
}

FUNCTIONS = "test_functions.py"
"""It compiles math.hpp by itself, so that faults there are looked for before the engine is built."""

ALL = [
    "test_proof_backward.py", "test_proof_forward.py", "test_proof_step.py", "test_cpu_step.py", "test_cpu_pose.py",
    "test_cpu_clusters.py", "test_adam.py", "test_loss.py", "test_knn.py", "test_correlate.py", "test_proof_poison.py",
    "test_cpu_input.py", "test_reference_order.py", "test_reference_gsplat.py", "test_cpu_isa.py", "test_waves.py",
    FUNCTIONS,
]  # fmt: skip
ALL_GPU = [
    "test_gpu_step.py", "test_gpu_ops.py", "test_gpu_waiting.py", "test_gpu_records.py", "test_gpu_launches.py",
    "test_gpu_train.py", "test_gpu_settings.py",
]  # fmt: skip

Row = dict[str, Any]


@dataclass(frozen=True)
class Copy:
    """A copy of the kernels and their tests, of its own for each backend whose mutants are tried."""

    work: Path

    @property
    def worker(self) -> Path:
        return self.work / "worker"

    @property
    def mutated(self) -> Path:
        """There while a file of the copy is mutated."""
        return self.work / "mutated"


def copy_tree(copy: Copy) -> None:
    """The kernels' source and the tests, as they are. Files that have not changed keep their time and their objects."""
    if copy.mutated.exists():  # an interrupted run: what is built from its file may be the mutant
        shutil.rmtree(copy.work / "cmake", ignore_errors=True)
    kernels = [p for p in (ROOT / "worker" / KERNELS).rglob("*") if p.suffix in (".cpp", ".hpp", ".py")]
    shutil.rmtree(copy.work / "tests", ignore_errors=True)
    tests = [p for folder in ("kernels", "support") for p in (ROOT / "tests" / folder).rglob("*.py")]
    bench = ROOT / "worker" / "bench"
    studies = [p for p in (bench / "_studies").rglob("*") if p.suffix in (".py", ".cpp", ".hpp", ".cmake")]
    shared = [*studies, bench / "_rows.py", bench / "results" / "functions.jsonl"]
    for path in (*kernels, *tests, *shared, ROOT / "pyproject.toml", ROOT / "tests/conftest.py"):
        copied(copy, path, path.read_text())
    cmake = ROOT / "worker" / "CMakeLists.txt"
    copied(copy, cmake, cmake.read_text().replace("set(flags -O3", "set(flags -O1"))


def copied(copy: Copy, path: Path, text: str) -> None:
    target = copy.work / path.relative_to(ROOT)
    if not target.exists() or target.read_text() != text:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text)


def build(copy: Copy) -> tuple[bool, str]:
    """Build the copy; whether that worked, and what the compiler said."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    cmake = copy.work / "cmake"
    if not (cmake / "CMakeCache.txt").exists():
        subprocess.run(
            ["cmake", "-G", "Ninja", "-S", copy.worker, "-B", cmake, "-DCMAKE_BUILD_TYPE=Release",
             f"-DPython_EXECUTABLE={sys.executable}"], check=True, env=environment, capture_output=True,
        )  # fmt: skip
    done = subprocess.run(
        ["cmake", "--build", cmake, "--target", f"_cpu_{ISA}"],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.returncode == 0, done.stdout[-3000:]


def module_of(copy: Copy, mutant: Mutant | None) -> str:
    """What the plugin replaces: MODULE=PATH, or nothing where there is neither a mutant nor a build of the copy."""
    if mutant is not None and mutant.file.endswith(".py"):
        path = copy.worker / KERNELS / mutant.file
        return (
            ".".join(["splatmill_worker", "kernels", *Path(mutant.file).with_suffix("").parts]) + f"={path}"
        )
    built = next((copy.work / "cmake").glob(f"_cpu_{ISA}.*.so"), None)
    return f"splatmill_worker.kernels.cpu._cpu_{ISA}={built}" if built else ""


def prove(copy: Copy, mutant: Mutant) -> str:
    """The first test that fails, or nothing. The likeliest run alone, then all others."""
    first = PROOFS.get(f"{mutant.backend}/{Path(mutant.file).stem}", DEFAULT[mutant.backend])
    rest = [name for name in (ALL_GPU if mutant.backend == "gpu" else ALL) if name not in first]
    return pytest(copy, mutant, map(place, first)) or pytest(copy, mutant, map(place, rest))


def place(name: str) -> str:
    """The path of a test, by the name of its file, which lies in any folder of the kernels' tests."""
    file, colons, test = name.partition("::")
    (path,) = (ROOT / TESTS).rglob(file)
    return f"{path.relative_to(ROOT).as_posix()}{colons}{test}"


def named(line: str) -> str:
    """The test at the beginning of `line`, by the name of its file."""
    return re.sub(rf"^{TESTS}/(?:[a-z]+/)*", "", line)


def pytest(copy: Copy, mutant: Mutant | None, tests: Iterable[str]) -> str:
    """The first of the tests that fails on the mutant, or on the copy as it is; nothing where all pass."""
    others = " or ".join(name for name in isa.ISAS if name != ISA)
    # The interpreter's tests run for its own mutants alone; two builds that disagree do not say which is wrong.
    chosen_tests = f"({ISA} or not ({others} or gpu)) and not test_builds_agree"
    # Other plugins are not loaded: importing them takes as long as the tests.
    plugins = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTHONPATH": str(HERE), "PYTHONUNBUFFERED": "1"}
    kernels = {"SPLATMILL_MUTANT": module_of(copy, mutant), "SPLATMILL_CPU_ISA": ISA}
    arguments = [
        "-v",
        "-x",
        "-p",
        "mutant",
        "-p",
        "pytest_timeout",
        "-p",
        "pytest_cov.plugin",  # for its marker
        "-p",
        "no:cacheprovider",
        "--timeout",
        "300",
    ]
    if mutant is None or mutant.backend != "gpu":
        arguments += ["-k", chosen_tests]
    if mutant is None:  # each of these passes or fails as it was named
        arguments = arguments[:-2]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *arguments, *tests],
        cwd=copy.work, capture_output=True, text=True, check=False, env={**os.environ, **plugins, **kernels},
    )  # fmt: skip
    if done.returncode == 0:
        return ""
    for line in done.stdout.splitlines():
        if line.startswith(("FAILED ", "ERROR ")):
            return named(line.split(" ", 1)[1].split(" - ")[0])
    started = [line for line in done.stdout.splitlines() if line.startswith(f"{TESTS}/")]
    if done.returncode < 0 and started:  # killed by a signal: the test that was running has caught it
        return named(started[-1].split(" ", 1)[0])
    raise SystemExit(f"pytest ended with {done.returncode}:\n{done.stdout[-3000:]}{done.stderr[-1000:]}")


def tried(copy: Copy, mutant: Mutant) -> Row:
    """The row of one mutant. The copy is as it was afterwards."""
    path = copy.worker / KERNELS / mutant.file
    source = path.read_text()
    if source.count(mutant.before) != 1:
        raise SystemExit(
            f"{mutant.name}: {mutant.before!r} occurs {source.count(mutant.before)} times in {mutant.file}."
        )
    start = time.monotonic()
    copy.mutated.touch()
    path.write_text(source.replace(mutant.before, mutant.after))
    try:
        caught = pytest(copy, mutant, [f"{TESTS}/{FUNCTIONS}"]) if mutant.file == "cpu/simd/math.hpp" else ""
        if not caught:
            works, said = (True, "") if mutant.file.endswith(".py") else build(copy)
            if not works:
                raise SystemExit(f"{mutant.name} does not build:\n{said}")
            caught = prove(copy, mutant)
    finally:
        path.write_text(source)
    copy.mutated.unlink()
    seconds = round(time.monotonic() - start)
    return {"mutant": mutant.name, "file": mutant.file, "caught_by": caught, "build": ISA, "seconds": seconds}


def read() -> dict[tuple[str, str], Row]:
    rows: list[Row] = [json.loads(line) for line in ROWS.read_text().splitlines()] if ROWS.exists() else []
    return {(row["file"], row["mutant"]): row for row in rows}


def write(results: dict[tuple[str, str], Row]) -> None:
    """Rows and table, in the order of the list, with those that another process has written meanwhile."""
    with (HERE / "mutants.py").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        rows = read() | results
        known = [rows[m.file, m.name] for m in (*MUTANTS, *NEXT) if (m.file, m.name) in rows]
        ROWS.write_text("".join(json.dumps(row) + "\n" for row in known))
    caught = sum(bool(row["caught_by"]) for row in known)
    listed = [*MUTANTS, *NEXT]
    builds = " and ".join(sorted({row["build"] for row in known}))
    lines = [
        "# Mutations of the kernels", "",
        f"{caught} of the {len(known)} tried are caught; {len(listed) - len(known)} were not tried. Generated "
        f"by `python worker/mutations/run.py`, on {builds}; Triton's kernels run in its interpreter.", "",
        "| fault | file | caught by |", "|---|---|---|",
        *(f"| {m.name} | {m.file} | {shown(rows.get((m.file, m.name)))} |" for m in listed),
        "",
    ]  # fmt: skip
    TABLE.write_text("\n".join(lines))


def shown(row: Row | None) -> str:
    if row is None:
        return "not tried"
    return f"`{row['caught_by']}`" if row["caught_by"] else "**nothing**"


def chosen(only: Sequence[str] | None, later: bool, backend: str | None) -> list[Mutant]:
    listed = [*MUTANTS, *NEXT] if only else NEXT if later else MUTANTS
    return [m for m in listed if (not only or m.name in only) and backend in (None, m.backend)]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", help="the name of a mutant")
    parser.add_argument("--backend", choices=["cpu", "gpu", "reference"], help="only the mutants of this one")
    parser.add_argument(
        "--fresh", action="store_true", help="only those without a row that says they are caught"
    )
    parser.add_argument("--next", action="store_true", help="those of NEXT, which are known to survive")
    parser.add_argument("--table-only", action="store_true")
    options = parser.parse_args()
    results: dict[tuple[str, str], Row] = {}
    if not options.table_only:
        copy = Copy(ROOT / "worker" / "build" / "mutations" / (options.backend or "all"))
        copy_tree(copy)
        before = read()
        for mutant in chosen(options.only, options.next, options.backend):
            if options.fresh and before.get((mutant.file, mutant.name), {}).get("caught_by"):
                continue
            results[mutant.file, mutant.name] = row = tried(copy, mutant)
            print(
                f"{row['seconds']:4} s  {mutant.file}: {mutant.name}: {row['caught_by'] or 'SURVIVES'}",
                flush=True,
            )
            write(results)
        works, said = build(copy) if (copy.work / "cmake").exists() else (True, "")
        if not works:
            raise SystemExit(f"The kernels do not build:\n{said}")
        catchers = sorted({f"{TESTS}/{row['caught_by']}" for row in results.values() if row["caught_by"]})
        if failing := pytest(copy, None, catchers) if catchers else "":
            raise SystemExit(f"This caught a mutant, and fails without any mutation too: {failing}")
        print("Every test that caught a mutant passes without mutations.")
    write(results)
    rows = read()
    return 0 if all(rows[m.file, m.name]["caught_by"] for m in MUTANTS if (m.file, m.name) in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
