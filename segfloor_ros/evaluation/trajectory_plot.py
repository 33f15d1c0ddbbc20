"""A picture of an estimated path beside the true one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from segfloor_ros.evaluation.trajectory import MatchedTrajectories


def save_trajectory_plot(matched: MatchedTrajectories, path: Path) -> None:
    """Write a plot of both paths from above and of the error over time.

    Paths are drawn on the plane in which the true path extends most.
    """
    truth, aligned = matched.truth[:, :3, 3], matched.aligned[:, :3, 3]
    axes = np.linalg.svd(truth - truth[0], full_matrices=False)[2][:2]
    axes *= np.sign((truth[-1] - truth[0]) @ axes[0] or 1.0)
    true_xy, xy = (truth - truth[0]) @ axes.T, (aligned - truth[0]) @ axes.T
    figure = Figure(figsize=(11, 5), layout='constrained')
    FigureCanvasAgg(figure)
    above, error = figure.subplots(1, 2)
    above.plot(*true_xy.T, 'k--', label='truth')
    above.plot(*xy.T, color='tab:blue', label='estimate, aligned')
    above.plot(0, 0, 'ko', label='start')
    above.set(xlabel="along the path's longest extent [m]", ylabel='across [m]')
    above.set_aspect('equal', adjustable='datalim')
    above.legend()
    above.grid(alpha=0.3)
    distances_cm = 100 * np.linalg.norm(aligned - truth, axis=1)
    error.plot(matched.times_s - matched.times_s[0], distances_cm, color='tab:red')
    error.set(xlabel='time [s]', ylabel='position error [cm]', ylim=(0, None))
    error.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
