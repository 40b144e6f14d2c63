"""Why the cameras could not be recovered, with the figures and what to do about it."""

from __future__ import annotations

from typing import Any


class SfmFailed(Exception):
    """Structure from motion ended without a usable scene.

    `code` is stable (no_images, too_few_images, sfm_no_features, sfm_too_few_registered, sfm_no_parallax,
    sfm_failed), `facts` are what was measured, `advice` says what a person can do.
    """

    def __init__(self, code: str, message: str, facts: dict[str, Any], advice: str) -> None:
        super().__init__(f"{message} {advice}")
        self.code = code
        self.message = message
        self.facts = facts
        self.advice = advice


class Cancelled(Exception):
    """The caller asked to stop."""
