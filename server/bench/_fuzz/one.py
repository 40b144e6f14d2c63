"""One parser in a process of its own, so that a crash, a hang or the growth of its memory is that of the parser.

    python -m _fuzz.one NAME SECONDS SEED

The last line of the output is JSON: the inputs, their outcomes, the slowest, and the bytes by which the process grew.
"""

from __future__ import annotations

import faulthandler
import json
import resource
import sys
import time
from collections import Counter

from tests.support.hostile.bench import bench
from tests.support.hostile.parsers import PARSERS

HANG = 60
"""Seconds that one input may take, after which the process shows where it is and ends."""

_TOGETHER = 200  # inputs of one run of hypothesis
_MOST_OUTCOMES = 12


def main(name: str, seconds: float, first: int) -> None:
    """Give a parser inputs until the seconds are over, and print what became of them."""
    parser, outcomes, times = PARSERS[name], Counter[str](), [0.0]
    with bench() as parts:
        parser.give(parts, parser.valid())  # what is loaded once is not growth
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

        def check(data: bytes) -> None:
            faulthandler.dump_traceback_later(HANG, exit=True)
            began = time.perf_counter()
            outcomes[parser.give(parts, data)] += 1
            times[0] = max(times[0], time.perf_counter() - began)
            faulthandler.cancel_dump_traceback_later()

        end, number = time.monotonic() + seconds, first
        while time.monotonic() < end:
            parser.try_changed(check, _TOGETHER, number)
            number += 1
        grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    said = {
        "inputs": outcomes.total(),
        "outcomes": dict(outcomes.most_common(_MOST_OUTCOMES)),
        "slowest_seconds": round(times[0], 3),
        "grown_bytes": grown,
    }
    print(json.dumps(said), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]))
