"""The smallest model that the service takes for one, for jobs that train nothing."""

import struct

_PROPERTIES = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)
_GAUSSIAN = (0.0, 0.0, 0.0, 1.7, -1.7, -1.7, 4.0, -2.2, -2.2, -2.2, 1.0, 0.0, 0.0, 0.0)


def ply() -> bytes:
    """Return a `.ply` file with one Gaussian."""
    header = ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    header += [f"property float {name}" for name in _PROPERTIES] + ["end_header", ""]
    return "\n".join(header).encode() + struct.pack(f"<{len(_GAUSSIAN)}f", *_GAUSSIAN)
