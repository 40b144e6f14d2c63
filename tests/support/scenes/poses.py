"""Errors of cameras against the truth."""

import math

import numpy as np

from splatmill_worker.scene import Camera, Scene


def pose_errors(scene: Scene, truth: dict[str, Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation errors in degrees and position errors over the cameras' spread, after the best similarity (Umeyama)."""
    ours = np.array([view.camera.center for view in scene.views])
    theirs = np.array([truth[view.name].center for view in scene.views])
    a, b = ours - ours.mean(0), theirs - theirs.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ sign @ vt
    scale = np.trace(np.diag(s) @ sign) / (a**2).sum()
    moved = scale * a @ turn.T
    rotations = []
    for view in scene.views:
        delta = view.camera.viewmat[:3, :3] @ turn.T @ truth[view.name].viewmat[:3, :3].T
        rotations.append(math.degrees(math.acos(np.clip((np.trace(delta) - 1.0) / 2.0, -1.0, 1.0))))
    return np.array(rotations), np.linalg.norm(moved - b, axis=1) / np.linalg.norm(b, axis=1).max()
