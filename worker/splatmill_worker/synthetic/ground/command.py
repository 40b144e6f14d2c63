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
    given = parser.parse_args(arguments)
    if not FEWEST <= given.photos <= MOST:
        parser.error(f"--photos {given.photos}: a flight has {FEWEST} to {MOST:,} photos.")
    for name in ("width", "height"):
        if not SMALLEST <= getattr(given, name) <= LARGEST:
            parser.error(f"--{name} {getattr(given, name)}: a side has {SMALLEST} to {LARGEST} pixels.")
    if not 1 <= given.samples <= 8:
        parser.error(f"--samples {given.samples}: a pixel has 1 to 8 rays along each axis.")
    if given.seed < 0:
        parser.error(f"--seed {given.seed}: a seed is 0 or larger.")
    if not 0.0 <= given.gps <= 1000.0:
        parser.error(f"--gps {given.gps}: the standard deviation is 0 to 1000 metres.")
    try:
        capture(
            given.directory, given.photos, given.width, given.height, given.seed, given.samples,
            Flight(gps=given.gps), lambda done: _tell(done, given.photos),
        )  # fmt: skip
    except OSError as error:
        print(f"Error: {error.filename or given.directory}: {error.strerror or error}.", file=sys.stderr)
        return 1
    print(
        f"{given.photos} photos of the generated ground are in {given.directory / PHOTOS}, and their true cameras in "
        f"{given.directory / TRUTH}"
    )
    return 0


def _tell(done: int, photos: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{done} of {photos} photos", end="\n" if done == photos else "", file=sys.stderr, flush=True)
