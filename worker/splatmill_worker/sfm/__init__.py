"""From photos to cameras: structure from motion, or the cameras a capture brings along."""
