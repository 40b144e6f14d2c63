"""`python -m splatmill_worker.synthetic DIR` writes photos of the still life to a folder; `... ground DIR` a flight."""

import argparse
import sys
from pathlib import Path

from splatmill_worker.synthetic import capture
from splatmill_worker.synthetic.ground import command


def main() -> int:
    """Write the photos and print where they are; returns the exit status."""
    if sys.argv[1:2] == ["ground"]:
        return command.main(sys.argv[2:])
    parser = argparse.ArgumentParser(prog="python -m splatmill_worker.synthetic", description=__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=2, help="rays per pixel along each axis")
    options = parser.parse_args()
    capture(options.directory, options.count, options.width, options.height, options.seed, options.samples)
    print(f"{options.count} photos of the built-in still life are in {options.directory}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
