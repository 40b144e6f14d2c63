"""`bench gpu`: the GPU engine on a card, in parts with a time limit each, in ten minutes together.

`python worker/bench/gpu.py [CAPTURE...]` writes results/gpu.jsonl. The parts up to `tiles` need torch, Triton and this
source tree, and nothing installed from it; `equal` and `curves` need the worker with what it imports, and gsplat for
its half. Captures (folders with photos and cameras) are fox and lego of ../shared/data where that lies, unless given.
Each part is a process of its own, whose rows are on disk as soon as they are measured: a part that is cut or fails
leaves what it has, and a row that says why it ended. Without a usable card, one sentence says so and nothing is
measured.

    --only passes tiles      these parts alone
    --dry --out FILE         everything up to `equal` in Triton's interpreter, at tiny sizes, without times
    --table                  the table of the rows that there are

Expected, before anything was measured: the bytes of a step at 1M Gaussians, 1 megapixel and 3M pairs, over the
bandwidth of the card, are a floor that no step goes below; published steps of that size on an RTX 5090 take 3.8 ms
(LiteGS) and 2.1 to 2.4 ms (jax-gs). Adam and the gradient of projection, which only move bytes, should come within a
third of their floors; the compositing passes, which calculate, should take most of the step. Tiles of 8 pixels halve
the pixels that a splat is tried on in vain and double the pairs: slower to list, faster to blend, and which wins is
open. Needles are off by no more than a few units of their conditioning at every ratio.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
for folder in (
    HERE,
    HERE.parent,
    HERE.parents[1],
):  # a bare machine has the source tree, nothing installed from it
    if str(folder) not in sys.path:
        sys.path.append(str(folder))

import torch  # noqa: E402
from _gpu import bandwidth, compared, errors, passes  # noqa: E402
from _gpu.timing import Place  # noqa: E402
from _rows import Row, append, lines, origin, rows_file  # noqa: E402

RESULTS = HERE / "results" / "gpu.jsonl"
CAPTURES = ("fox_540x960", "lego_400")
UNUSABLE = 3
"""Exit code of a part that found no usable card."""

CURVE_SECONDS, CURVE_STEPS, CURVE_SIZE = 20.0, 7000, 960
"""Time budget of this engine, steps of gsplat's run, and longest side of photos in pixels, for each curve."""


@dataclass(frozen=True)
class Part:
    """One part of the benchmark.

    name: as rows have it under `bench`.
    seconds: its time limit.
    rows: what it measures.
    dry: whether it also runs in the interpreter.
    """

    name: str
    seconds: float
    rows: Callable[[Place], Iterator[Row]]
    dry: bool = True


def card(place: Place) -> Iterator[Row]:
    """What the card is. Ends the part with UNUSABLE where there is none."""
    from splatmill_worker.kernels.gpu import device

    if not place.dry:
        if (reason := device.absence()) is not None:
            print(f"Nothing was measured: {reason} This benchmark times kernels on a GPU.", flush=True)
            raise SystemExit(UNUSABLE)
        facts = device.describe()
        assert facts is not None
        yield {
            "card": facts.name, "capability": ".".join(map(str, facts.capability)), "memory": facts.total_bytes,
            "cuda": torch.version.cuda,
        }  # fmt: skip
    else:
        yield {"card": "Triton's interpreter"}


def parts(captures: Sequence[Path]) -> list[Part]:
    """All parts in the order that they run in; their limits make ten minutes."""

    def curves(_: Place) -> Iterator[Row]:
        if not captures:
            raise ValueError("no captures were given, and ../shared/data has none.")
        return compared.curves(captures, CURVE_SIZE, CURVE_SECONDS, CURVE_STEPS, seed=0)

    return [
        Part("card", 30, card),
        Part("bandwidth", 20, bandwidth.measure),
        Part("proofs", 80, errors.prove),
        Part("needles", 90, errors.needles),
        Part("passes", 80, passes.measure),
        Part("tiles", 80, passes.measure_small_tiles),
        Part("equal", 80, compared.equal),
        Part("curves", 140, curves, dry=False),
    ]


def run(part: Part, place: Place, out: Path, common: Row) -> str:
    """Run a part in a process of its own; returns `done`, or why it ended, which is also a row."""
    context = multiprocessing.get_context("fork")  # the parent has imported everything and touched no device
    child = context.Process(target=_measure, args=(part, place, out, common))
    started = time.monotonic()
    child.start()
    child.join(None if place.dry else part.seconds)
    outcome = "done"
    if child.is_alive():
        child.kill()
        child.join()
        outcome = f"cut after {part.seconds:.0f} s"
    elif child.exitcode == UNUSABLE:
        return "unusable"
    elif child.exitcode:
        outcome = "failed"
    spent = {} if place.dry else {"seconds": round(time.monotonic() - started, 1)}
    append(out, {**common, "bench": part.name, "outcome": outcome, **spent})
    return outcome


def _measure(part: Part, place: Place, out: Path, common: Row) -> None:
    try:
        for row in part.rows(place):
            append(out, {**common, "bench": part.name, **row})
    except Exception as error:
        traceback.print_exc()
        append(out, {**common, "bench": part.name, "error": f"{type(error).__name__}: {error}"})
        raise SystemExit(1) from None


def _number(value: Any, unit: float = 1.0) -> str:
    return "-" if value is None else f"{value / unit:.3g}"


def table(rows: Sequence[Row]) -> list[str]:
    """The rows of the latest run as tables in Markdown, and a verdict for each capture."""
    rows = rows[
        max((i for i, row in enumerate(rows) if row["bench"] == "card" and "card" in row), default=0) :
    ]
    by = {name: [row for row in rows if row["bench"] == name] for name in {row["bench"] for row in rows}}
    said = [f"On {row['card']}." for row in by.get("card", []) if "card" in row]
    rates = [row["bytes_per_second"] for row in by.get("bandwidth", []) if row.get("bytes_per_second")]
    rate = max(rates, default=None)
    if rate is not None:
        said.append(f"Memory moves {rate / 1e9:.0f} GB/s.")
    for name in ("passes", "tiles"):
        timed = [row for row in by.get(name, []) if "pass" in row]
        if not timed:
            continue
        size = timed[0]
        said += [
            "",
            f"{size['gaussians']} Gaussians, {size['pixels']} pixels, {size['pairs']} pairs, tiles of {size['tile']}",
            "",
            "| pass | MB | floor ms | ms |",
            "| --- | --- | --- | --- |",
        ]
        for row in timed:
            floor = None if rate is None else 1e3 * row["bytes"] / rate
            said.append(
                f"| {row['pass']} | {row['bytes'] / 1e6:.3g} | {_number(floor)} | {_number(row['ms'])} |"
            )
    if worst := [row for row in by.get("needles", []) if "largest" in row]:
        said += ["", "| needles | ratio | value | largest | median |", "| --- | --- | --- | --- | --- |"]
        said += [
            f"| {row['where']} | {row['ratio']:.0e} | {row['value']} | {row['largest']:.3g} | {row['median']:.3g} |"
            for row in worst
        ]
    for row in by.get("proofs", []):
        if "passed" in row:
            share = max(row["share_of_allowed"].values())
            said.append(f"Degree {row['degree']}: {share:.2g} of the error allowed, passed: {row['passed']}.")
    for row in by.get("equal", []):
        if "engine" in row:
            times = f"{_number(row['ms'])} ms/step, {_number(row['render_ms'])} ms/view"
            said.append(f"{row['engine']}, {row['gaussians']} Gaussians: {times}")
    said += compared.verdict(by.get("curves", []))
    said += [f"{row['bench']}: {row['outcome']}" for row in rows if row.get("outcome", "done") != "done"]
    said += [f"{row['bench']}: {row['error']}" for row in rows if "error" in row]
    return said


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="bench gpu", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("captures", nargs="*", type=Path, help="folders with photos and cameras")
    parser.add_argument("--only", nargs="+", metavar="PART", help="these parts alone")
    parser.add_argument("--dry", action="store_true", help="tiny sizes in Triton's interpreter, no times")
    parser.add_argument("--out", type=rows_file, default=RESULTS, help="file that rows are added to")
    parser.add_argument("--table", action="store_true", help="print the table of the rows that there are")
    wish = parser.parse_args(argv)
    if wish.table:
        print("\n".join(table(lines(wish.out))))
        return 0
    if wish.dry:
        if wish.out == RESULTS:
            parser.error("--dry needs --out FILE, since its rows are no results")
        os.environ["TRITON_INTERPRET"] = "1"
        from tests.support.kernels.interpreter import ask_for_it

        ask_for_it()  # with what makes the interpreter twice as fast
    place = Place("cpu" if wish.dry else "cuda", wish.dry)
    shared = HERE.parents[2] / "shared" / "data"
    captures = wish.captures or [shared / name for name in CAPTURES if (shared / name).is_dir()]
    selection = [
        part
        for part in parts(captures)
        if (part.dry or not wish.dry) and (wish.only is None or part.name in ("card", *wish.only))
    ]
    import triton

    common = {**origin(), "triton": triton.__version__, "dry": wish.dry}
    ended = []
    for part in selection:
        ended.append(run(part, place, wish.out, common))
        if ended[-1] == "unusable":
            return 0
    print("\n".join(table(lines(wish.out))))
    return 0 if set(ended) <= {"done"} else 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
