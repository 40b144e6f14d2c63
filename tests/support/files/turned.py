"""Where programs show a point of a glTF file: turned by the rotation of its node."""

from typing import Any

import numpy as np
import numpy.typing as npt


def shown(document: dict[str, Any], point: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The place in the scene of a point [3] of the one node. Its rotation is a quaternion x, y, z, w."""
    (node,) = document["nodes"]
    axis, w = np.array(node.get("rotation", [0, 0, 0, 1])[:3]), node.get("rotation", [0, 0, 0, 1])[3]
    p = np.asarray(point, np.float64)
    across = np.cross(axis, p)
    place: npt.NDArray[np.float64] = p + 2.0 * (w * across + np.cross(axis, across))
    return place
