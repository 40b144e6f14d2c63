"""A COLMAP model as text: the program `model-text`."""

import sys
from pathlib import Path

from splatmill_worker.colmap import pycolmap, write_model


def main(folder: Path) -> int:
    """Replace the binary files of the COLMAP model in `folder` by text, print their paths, and return the status."""
    try:
        model = pycolmap.Reconstruction(folder)
        write_model(model, folder, text=True)
    except (OSError, ValueError, RuntimeError, IndexError) as error:
        said = (str(error).strip().splitlines() or [type(error).__name__])[-1][:200]
        print(
            f"Error: The COLMAP model in {folder} could not be read and written as text: {said}",
            file=sys.stderr,
        )
        return 1
    spaced = sum(" " in image.name for image in model.images.values())
    if spaced:
        print(
            f"Warning: The model has names with spaces ({spaced}). Splatmill reads them from text, and COLMAP "
            "and many other programs only up to the first space: use the binary model (--format colmap), or rename "
            "the photos.",
            file=sys.stderr,
        )
    for path in sorted(folder.iterdir()):
        if path.suffix == ".bin":
            path.unlink()
        elif path.suffix == ".txt":
            print(path)
    return 0
