"""The first Gaussians: from points, in gaps between points, on a far shell, at random places, or from a given model."""
