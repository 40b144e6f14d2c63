"""Whether the list of mutations fits the kernels as they are, and its rows and table fit the list.

    python worker/mutations/check.py

Prints what does not, and ends with 1. That the proofs catch the mutations is what `run.py` finds out, in hours.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterator

from mutants import KERNELS, MUTANTS, NEXT, WITHOUT
from run import ROOT, ROWS, TABLE, shown

LEAST = 35
"""Mutations that have to be in the rows as caught, so that rows are not lost."""


def faults() -> Iterator[str]:
    """Yield each fault as a sentence."""
    kernels, listed = ROOT / "worker" / KERNELS, [*MUTANTS, *NEXT]
    for mutant in listed:
        count = (kernels / mutant.file).read_text().count(mutant.before)
        if count != 1 or mutant.before == mutant.after:
            yield f"{mutant.file}: {mutant.name}: its source occurs {count} times, or is not changed."
    for (file, name), count in Counter((mutant.file, mutant.name) for mutant in listed).items():
        if count > 1:
            yield f"{file}: {name}: it is listed {count} times."
    rows = [json.loads(line) for line in ROWS.read_text().splitlines()]
    caught = {(row["file"], row["mutant"]): row["caught_by"] for row in rows}
    for mutant in MUTANTS:
        if not caught.get((mutant.file, mutant.name), "not tried yet"):
            yield f"{mutant.file}: {mutant.name}: no proof has caught it."
    if sum(map(bool, caught.values())) < LEAST:
        yield f"Only {sum(map(bool, caught.values()))} rows are of mutations that were caught; {LEAST} are the least."
    table = TABLE.read_text()
    by_place = {(row["file"], row["mutant"]): row for row in rows}
    for mutant in listed:
        line = f"| {mutant.name} | {mutant.file} | {shown(by_place.get((mutant.file, mutant.name)))} |"
        if line not in table:
            yield f"{mutant.file}: {mutant.name}: mutations.md has another row; run.py --table-only writes it."
    mutated = {mutant.file for mutant in MUTANTS}
    sources = {
        str(path.relative_to(kernels))
        for backend in ("cpu", "gpu", "reference")
        for path in (kernels / backend).rglob("*")
        if path.suffix in (".cpp", ".hpp", ".py")
    }
    for file in sorted(sources ^ (mutated | set(WITHOUT))):
        yield f"{file}: it has neither a mutation nor a reason in WITHOUT, or is no file of the kernels."
    for file in sorted(mutated & set(WITHOUT)):
        yield f"{file}: it has both a mutation and a reason in WITHOUT."


if __name__ == "__main__":
    lines = list(faults())
    print(
        "\n".join(lines)
        or f"{len(MUTANTS) + len(NEXT)} mutations fit the kernels, their rows and their table."
    )
    sys.exit(bool(lines))
