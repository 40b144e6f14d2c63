"""A COLMAP model as text: the program `model-text`."""

import sys
from pathlib import Path

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.posed import model_files


def main(folder: Path) -> int:
    """Replace the binary files of the COLMAP model in `folder` by text, print their paths, and return the status."""
    try:
        model: pycolmap.Reconstruction = model_files.read(folder)
        model.write_text(folder)
    except (OSError, ValueError) as error:
        print(f"Error: {error}", file=sys.stderr)
        return 1
    for path in sorted(folder.iterdir()):
        if path.suffix == ".bin":
            path.unlink()
        elif path.suffix == ".txt":
            print(path)
    return 0
