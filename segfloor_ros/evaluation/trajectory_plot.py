"""A picture of an estimated path beside the true one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from segfloor_ros.evaluation.trajectory import MatchedTrajectories
from segfloor_ros.geometry import Array

FIRST_STRETCH_M = 1.0


def save_trajectory_plot(matched: MatchedTrajectories, path: Path) -> None:
    """Write a plot of both paths from above and of the error over time.

    Paths are drawn on the plane in which the true path extends most, its first stretch to the
    right.
    """
    truth, aligned = matched.truth[:, :3, 3], matched.aligned[:, :3, 3]
    axes = plane_axes(truth)
    true_xy, xy = (truth - truth[0]) @ axes.T, (aligned - truth[0]) @ axes.T
    figure = Figure(figsize=(11, 5), layout='constrained')
    FigureCanvasAgg(figure)
    above, error = figure.subplots(1, 2)
    above.plot(*true_xy.T, 'k--', label='truth')
    above.plot(*xy.T, color='tab:blue', label='estimate, aligned')
    above.plot(0, 0, 'ko', label='start')
    above.set(xlabel='ahead of the start [m]', ylabel='to its left [m]')
    above.set_aspect('equal', adjustable='datalim')
    above.legend()
    above.grid(alpha=0.3)
    distances_cm = 100 * np.linalg.norm(aligned - truth, axis=1)
    error.plot(matched.times_s - matched.times_s[0], distances_cm, color='tab:red')
    error.set(xlabel='time [s]', ylabel='position error [cm]', ylim=(0, None))
    error.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def plane_axes(path: Array) -> Array:
    """Return the axes ahead and to the left (2, 3) of the start of a path (N, 3), in the plane in
    which it extends most. Up is +z or, in optical frames, -y.
    """
    up = np.linalg.svd(path - path.mean(axis=0), full_matrices=True)[2][2]
    largest = int(np.argmax(np.abs(up)))
    up = up * np.sign(up[largest]) * (-1 if largest == 1 else 1)
    moved = np.linalg.norm(path - path[0], axis=1)
    ahead = path[int(np.argmax(moved >= min(FIRST_STRETCH_M, moved.max() / 2)))] - path[0]
    ahead = ahead - (ahead @ up) * up
    length = float(np.linalg.norm(ahead))
    if length == 0:
        return np.eye(3)[:2]
    return np.array([ahead / length, np.cross(up, ahead / length)])
