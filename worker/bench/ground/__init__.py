"""The growth of a whole command over a generated ground: what is measured of it, and the study."""
