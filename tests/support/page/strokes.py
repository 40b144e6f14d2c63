"""Random strokes on views of random Gaussians, by which the page and the renderer are compared."""

import numpy as np
import numpy.typing as npt

from splatmill.schema import CameraSpec, Stroke

FRONT = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
"""The pose of a view from the origin along z."""


def random_strokes(
    seed: int, *, gaussians: int, strokes: int
) -> tuple[npt.NDArray[np.float32], list[Stroke]]:
    """Return centres in a cube about the origin, and brushes and closed lines on views from around it."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-1, 1, (gaussians, 3)).astype(np.float32)
    made = []
    for number in range(strokes):
        eye = rng.normal(size=3)
        eye *= rng.uniform(0.5, 3) / np.linalg.norm(eye)
        view = CameraSpec.looking_at(eye.tolist(), rng.uniform(-0.3, 0.3, 3).tolist(), width=64, height=64)
        line = np.cumsum(rng.normal(scale=0.08, size=(int(rng.integers(3, 40)), 2)), axis=0).round(6)
        fields = {
            "camera_to_world": view.opencv_to_world(),
            "points": line.tolist(),
            "radius": None if number % 2 else float(rng.uniform(0.01, 0.2)),
            "far": float(rng.uniform(1, 3)) if number % 3 == 0 else None,
            "subtract": number % 4 == 3,
        }
        made.append(Stroke.model_validate(fields))
    return means, made
