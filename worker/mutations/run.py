"""Apply every mutation of `mutants.py` to a copy of the kernels, build it, and run the proofs against it.

    python worker/mutations/run.py                  # all of them: about 20 minutes on two cores
    python worker/mutations/run.py --only "half the off-diagonal" --only "green twice"
    python worker/mutations/run.py --next           # those that are not caught or not tried
    python worker/mutations/run.py --table-only

The copy lies in worker/build/mutations; the source tree is not touched. One instruction set is built, the best that
runs here, without optimisation beyond -O1: contraction is off, so the results are the same. The proofs that `PROOFS`
names for a file run first, then all others, until one fails; in the end every test that caught a mutant has to pass
without mutations. Rows go to mutations.jsonl, the table to mutations.md.
Ends with 1 where a mutant survives.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from mutants import KERNELS, MUTANTS, NEXT, Mutant  # noqa: E402  (beside this file)

from splatmill_worker.kernels.cpu import isa  # noqa: E402

ROOT = HERE.parents[1]
WORK = ROOT / "worker" / "build" / "mutations"
COPY = WORK / "worker"
MUTATED = WORK / "mutated"
"""There while a file of the copy is mutated."""
ROWS, TABLE = HERE / "mutations.jsonl", HERE / "mutations.md"
ISA = isa.supported()[0]
TESTS = Path("tests/kernels")

PROOFS = {
    "adam.hpp": ["test_adam", "test_cpu_step"],
    "loss.cpp": ["test_loss"],
    "knn.cpp": ["test_knn"],
    "pose.hpp": ["test_cpu_pose"],
    "step.cpp": ["test_proof_step", "test_cpu_step"],
    "bin.cpp": ["test_proof_forward", "test_proof_step"],
    "reach.hpp": ["test_proof_forward", "test_proof_step"],
    "composite_forward.cpp": ["test_proof_forward"],
}
"""The tests most likely to catch a fault in a file, first; for others, those of the gradients."""

ALL = [
    "test_proof_backward", "test_proof_forward", "test_proof_step", "test_cpu_step", "test_cpu_pose", "test_adam",
    "test_loss", "test_knn", "test_proof_poison", "test_cpu_input", "test_reference_order", "test_reference_gsplat",
]  # fmt: skip

Row = dict[str, Any]


def copy_tree() -> None:
    """The kernels' source and the tests, as they are. Files that have not changed keep their time and their objects."""
    if MUTATED.exists():  # an interrupted run: what is built from its file may be the mutant
        shutil.rmtree(WORK / "cmake", ignore_errors=True)
    kernels = [p for p in (ROOT / "worker" / KERNELS).rglob("*") if p.suffix in (".cpp", ".hpp", ".py")]
    shutil.rmtree(WORK / "tests", ignore_errors=True)
    tests = [p for folder in ("kernels", "support") for p in (ROOT / "tests" / folder).rglob("*.py")]
    shared = [*(ROOT / "worker/bench/_stability").glob("*.py"), ROOT / "worker/bench/_rows.py"]
    for path in (*kernels, *tests, *shared, ROOT / "pyproject.toml", ROOT / "tests/conftest.py"):
        copied(path, path.read_text())
    cmake = ROOT / "worker" / "CMakeLists.txt"
    copied(cmake, cmake.read_text().replace("set(flags -O3", "set(flags -O1"))


def copied(path: Path, text: str) -> None:
    target = WORK / path.relative_to(ROOT)
    if not target.exists() or target.read_text() != text:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text)


def build() -> tuple[bool, str]:
    """Build the copy; whether that worked, and what the compiler said."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    if not (WORK / "cmake" / "CMakeCache.txt").exists():
        subprocess.run(
            ["cmake", "-G", "Ninja", "-S", COPY, "-B", WORK / "cmake", "-DCMAKE_BUILD_TYPE=Release",
             f"-DPython_EXECUTABLE={sys.executable}"], check=True, env=environment, capture_output=True,
        )  # fmt: skip
    done = subprocess.run(
        ["cmake", "--build", WORK / "cmake", "--target", f"_cpu_{ISA}"],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.returncode == 0, done.stdout[-3000:]


def module_of(mutant: Mutant | None) -> str:
    """What the plugin replaces: MODULE=PATH."""
    if mutant is not None and mutant.file.endswith(".py"):
        path = COPY / KERNELS / mutant.file
        return (
            ".".join(["splatmill_worker", "kernels", *Path(mutant.file).with_suffix("").parts]) + f"={path}"
        )
    (built,) = (WORK / "cmake").glob(f"_cpu_{ISA}.*.so")
    return f"splatmill_worker.kernels.cpu._cpu_{ISA}={built}"


def prove(mutant: Mutant) -> str:
    """The first test that fails, or nothing. The likeliest files run alone, then all others."""
    first = PROOFS.get(Path(mutant.file).name, ["test_proof_step", "test_proof_backward"])
    if mutant.file.endswith(".py"):
        first = ["test_reference_order", "test_reference_gsplat", *first]
    rest = [name for name in ALL if name not in first]
    return pytest(mutant, [f"{TESTS}/{name}.py" for name in first]) or pytest(
        mutant, [f"{TESTS}/{name}.py" for name in rest]
    )


def pytest(mutant: Mutant | None, tests: Sequence[str]) -> str:
    """The first of the tests that fails on the mutant, or on the copy as it is; nothing where all pass."""
    others = " or ".join(name for name in isa.ISAS if name != ISA)
    chosen_tests = f"{ISA} or not ({others} or gpu)"
    # Other plugins are not loaded: importing them takes as long as the tests.
    plugins = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTHONPATH": str(HERE)}
    kernels = {"SPLATMILL_MUTANT": module_of(mutant), "SPLATMILL_CPU_ISA": ISA}
    arguments = [
        "-q",
        "-x",
        "-p",
        "mutant",
        "-p",
        "pytest_timeout",
        "-p",
        "no:cacheprovider",
        "--timeout",
        "300",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *arguments, "-k", chosen_tests, *tests],
        cwd=WORK, capture_output=True, text=True, check=False, env={**os.environ, **plugins, **kernels},
    )  # fmt: skip
    if done.returncode == 0:
        return ""
    for line in done.stdout.splitlines():
        if line.startswith(("FAILED ", "ERROR ")):
            return line.split(" ", 1)[1].split(" - ")[0].removeprefix(f"{TESTS}/")
    raise SystemExit(f"pytest ended with {done.returncode}:\n{done.stdout[-3000:]}{done.stderr[-1000:]}")


def tried(mutant: Mutant) -> Row:
    """The row of one mutant. The copy is as it was afterwards."""
    path = COPY / KERNELS / mutant.file
    source = path.read_text()
    if source.count(mutant.before) != 1:
        raise SystemExit(
            f"{mutant.name}: {mutant.before!r} occurs {source.count(mutant.before)} times in {mutant.file}."
        )
    start = time.monotonic()
    MUTATED.touch()
    path.write_text(source.replace(mutant.before, mutant.after))
    try:
        if mutant.file.endswith(".py"):
            caught = prove(mutant)
        else:
            works, said = build()
            if not works:
                raise SystemExit(f"{mutant.name} does not build:\n{said}")
            caught = prove(mutant)
    finally:
        path.write_text(source)
    MUTATED.unlink()
    seconds = round(time.monotonic() - start)
    return {"mutant": mutant.name, "file": mutant.file, "caught_by": caught, "build": ISA, "seconds": seconds}


def read() -> dict[str, Row]:
    rows: list[Row] = [json.loads(line) for line in ROWS.read_text().splitlines()] if ROWS.exists() else []
    return {row["mutant"]: row for row in rows}


def write(rows: dict[str, Row]) -> None:
    """Rows and table, in the order of the list."""
    known = [rows[m.name] for m in (*MUTANTS, *NEXT) if m.name in rows]
    ROWS.write_text("".join(json.dumps(row) + "\n" for row in known))
    caught = sum(bool(row["caught_by"]) for row in known)
    lines = [
        "# Mutations of the kernels", "",
        f"{caught} of {len(known)} are caught. Generated by `python worker/mutations/run.py`, on the build {ISA}.", "",
        "| fault | file | caught by |", "|---|---|---|",
        *(f"| {r['mutant']} | {r['file']} | {shown(r['caught_by'])} |" for r in known),
        "",
    ]  # fmt: skip
    TABLE.write_text("\n".join(lines))


def shown(test: str) -> str:
    return f"`{test}`" if test else "**nothing**"


def chosen(only: Sequence[str] | None, later: bool) -> list[Mutant]:
    if only:
        return [m for m in (*MUTANTS, *NEXT) if m.name in only]
    return NEXT if later else MUTANTS


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", help="the name of a mutant")
    parser.add_argument(
        "--next", action="store_true", help="those of NEXT, which are not caught or not tried"
    )
    parser.add_argument("--table-only", action="store_true")
    options = parser.parse_args()
    rows = read()
    if not options.table_only:
        copy_tree()
        for mutant in chosen(options.only, options.next):
            rows[mutant.name] = row = tried(mutant)
            print(f"{row['seconds']:4} s  {mutant.name}: {row['caught_by'] or 'SURVIVES'}", flush=True)
            write(rows)
        works, said = build()
        if not works:
            raise SystemExit(f"The kernels do not build:\n{said}")
        failing = pytest(
            None, sorted({f"{TESTS}/{row['caught_by']}" for row in rows.values() if row["caught_by"]})
        )
        if failing:
            raise SystemExit(f"This caught a mutant, and fails without any mutation too: {failing}")
        print("Every test that caught a mutant passes without mutations.")
    write(rows)
    return 0 if all(rows.get(m.name, {}).get("caught_by") for m in MUTANTS) else 1


if __name__ == "__main__":
    sys.exit(main())
