"""`python -m splatmill_worker.synthetic ground DIR` writes a flight over the town, and its true cameras."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from splatmill_worker.synthetic.ground.capture import PHOTOS, TRUTH, capture
from splatmill_worker.synthetic.ground.flight import Flight

FEWEST, MOST = 2, 100_000
SMALLEST, LARGEST = 32, 8192
"""Bounds of the number of photos, and of the sides of one in pixels."""


def main(arguments: list[str]) -> int:
    """Write the photos and print where they are; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m splatmill_worker.synthetic ground", description=__doc__)
    parser.add_argument("directory", type=Path, help=f"gets the folders {PHOTOS}, to train from, and {TRUTH}")
    parser.add_argument("--photos", type=int, default=125, help="their number; the area grows with it")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--seed", type=int, default=0, help="of the town, the flight and the noise")
    parser.add_argument("--samples", type=int, default=2, help="rays per pixel along each axis")
    parser.add_argument(
        "--gps", type=float, default=Flight.gps, help="standard deviation of the measured places, in metres"
    )
    options = parser.parse_args(arguments)
    if not FEWEST <= options.photos <= MOST:
        parser.error(f"--photos {options.photos}: a flight has {FEWEST} to {MOST:,} photos.")
    for name in ("width", "height"):
        if not SMALLEST <= getattr(options, name) <= LARGEST:
            parser.error(f"--{name} {getattr(options, name)}: a side has {SMALLEST} to {LARGEST} pixels.")
    if not 1 <= options.samples <= 8:
        parser.error(f"--samples {options.samples}: a pixel has 1 to 8 rays along each axis.")
    if options.seed < 0:
        parser.error(f"--seed {options.seed}: a seed is 0 or larger.")
    if not 0.0 <= options.gps <= 1000.0:
        parser.error(f"--gps {options.gps}: the standard deviation is 0 to 1000 metres.")
    try:
        capture(
            options.directory, options.photos, options.width, options.height, options.seed, options.samples,
            Flight(gps=options.gps), lambda done: _tell(done, options.photos),
        )  # fmt: skip
    except OSError as error:
        print(f"Error: {error.filename or options.directory}: {error.strerror or error}.", file=sys.stderr)
        return 1
    print(
        f"{options.photos} photos of the generated ground are in {options.directory / PHOTOS}, and their true cameras "
        f"in {options.directory / TRUTH}"
    )
    return 0


def _tell(done: int, photos: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{done} of {photos} photos", end="\n" if done == photos else "", file=sys.stderr, flush=True)
