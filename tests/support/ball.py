"""A model whose picture is known: Gaussians on a unit ball, red on the side of +x and blue on the other."""

from pathlib import Path

import numpy as np

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage

BALL = "ball0000"

PROPERTIES = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


def ball(count: int = 400) -> np.ndarray:
    """Gaussians on a unit ball, red where x is positive, in the standard property order [count, 17]."""
    rng = np.random.default_rng(0)
    means = rng.normal(size=(count, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    rows = np.zeros((count, len(PROPERTIES)), dtype="<f4")
    rows[:, :3] = means
    rows[:, 6:9] = np.where(means[:, :1] > 0, [[1.7, -1.7, -1.7]], [[-1.7, -1.7, 1.7]])
    rows[:, 9] = 4.0
    rows[:, 10:13] = -2.2
    rows[:, 13] = 1.0
    return rows


def write_ply(path: Path, count: int = 400) -> None:
    """The ball as a binary `.ply`."""
    rows = ball(count)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in PROPERTIES] + ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())


def store_ball(storage: Storage, folder: Path, model_id: str = BALL, count: int = 400) -> None:
    write_ply(folder / "model.ply", count)
    storage.put(layout.model_file(model_id, "model.ply"), folder / "model.ply")
    storage.put(layout.job_record(model_id), b"{}")
