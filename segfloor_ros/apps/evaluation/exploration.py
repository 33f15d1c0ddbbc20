"""What an exploration came to: figures, a picture of map and path on the truth, and a film of the
map as it grew.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure
from numpy.typing import NDArray

from segfloor_ros.apps.evaluation.map_score import COLOURS, coloured, compare, score_cells
from segfloor_ros.apps.evaluation.maps import MapTruth, Mask, from_frame, resample
from segfloor_ros.apps.navigation import ARRIVED_M, Goal
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.images import png_bytes
from segfloor_ros.core.geometry import Array, Pose2d
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, OccupancyGrid

FILM_FRAMES = 60
"""At most, ten of them in a second."""

STRIP_IMAGES = 8


@dataclass(frozen=True)
class Moment:
    """A map, its stamp, and what the left camera saw: a small image (H, W) uint8."""

    stamp_ns: int
    grid: OccupancyGrid
    image: NDArray[np.uint8] | None


@dataclass
class Exploration:
    """An exploration as it went. start: where the frame of the map truly lies. Poses by stamp in
    ns: where SLAM had the base in the map at the time, and where it truly was in the scene.
    moments: the newest and of those before enough for a film, evenly. goals: with the
    stamp of the frame in which the robot was told to stop there, or gave up.
    """

    start: Pose2d
    poses: dict[int, Array] = field(default_factory=dict)
    true_poses: dict[int, Array] = field(default_factory=dict)
    moments: list[Moment] = field(default_factory=list)
    bumps_ns: list[int] = field(default_factory=list)
    goals: list[tuple[Goal, int]] = field(default_factory=list)
    wall_s: float = 0.0
    cpu_s: dict[str, float] = field(default_factory=dict)
    _taken: int = field(default=0, init=False)
    _every: int = field(default=1, init=False)

    def take(self, moment: Moment) -> None:
        """Take in a moment."""
        if (self._taken - 1) % self._every:
            del self.moments[-1]
        self._taken += 1
        self.moments.append(moment)
        if len(self.moments) > 2 * FILM_FRAMES:
            del self.moments[1::2]
            self._every *= 2


def reachable_floor(truth: OccupancyGrid, radius_m: float, start: Pose2d) -> Mask:
    """Return the floor (rows, columns) that a robot of some radius can stand on. Raises InputError
    where it cannot turn at the start.
    """
    room_m = truth.away_m(truth.cells == OCCUPIED)
    _, labels = cv2.connectedComponents((room_m > radius_m).astype(np.uint8), connectivity=4)
    at_start = labels[tuple(truth.cells_of(np.array(start[:2])))]
    if not at_start:
        raise InputError(
            f'the robot turns within {radius_m:.2f} m, but something stands nearer to its start at '
            f'x {start[0]:.2f}, y {start[1]:.2f} m; choose a smaller robot or another path'
        )
    away_m = truth.away_m(labels == at_start)
    return np.asarray((away_m <= radius_m) & (truth.cells == FREE))


def mapped_share(grid: OccupancyGrid, truth: OccupancyGrid, floor: Mask, start: Pose2d) -> float:
    """Return how much of the floor is free on a map whose frame lies at `start`."""
    return float((resample(grid, truth, start) == FREE)[floor].mean())


def figures(found: Exploration, truth: OccupancyGrid, radius_m: float) -> dict[str, Any]:
    """Return the figures of an exploration by name."""
    grid = found.moments[-1].grid
    floor = reachable_floor(truth, radius_m, found.start)
    maps = compare(grid, MapTruth(truth, found.start))
    cells = score_cells(maps)
    stamps = sorted(found.poses)
    rmse_m = None  # where it was never found in a saved map
    if stamps:
        estimated = from_frame(np.array([found.poses[t][:2, 3] for t in stamps]), found.start)
        true = np.array([found.true_poses[t][:2, 3] for t in stamps])
        rmse_m = round(float(np.sqrt(np.mean(np.sum((estimated - true) ** 2, 1)))), 4)
    sim_s = (max(found.true_poses) - min(found.true_poses)) * 1e-9
    way = np.array([pose[:2, 3] for _, pose in sorted(found.true_poses.items())])
    return {
        'mapped_share': round(mapped_share(grid, truth, floor, found.start), 4),
        'bumps': len(found.bumps_ns),
        'goals_reached': sum(_is_reached(found, *ended) for ended in found.goals),
        'goals_total': len(found.goals),
        'path_rmse_m': rmse_m,
        'free_precision': round(cells.free_precision, 4),
        'free_recall': round(cells.free_recall, 4),
        'tracked_share': round(len(stamps) / len(found.true_poses), 4),
        'path_m': round(float(np.hypot(*np.diff(way, axis=0).T).sum()), 2),
        'sim_s': round(sim_s, 1),
        'wall_s': round(found.wall_s, 1),
        'real_time_factor': round(sim_s / found.wall_s, 3),
        'cpu_s': {name: round(seconds, 1) for name, seconds in found.cpu_s.items()},
    }


def _is_reached(found: Exploration, goal: Goal, stamp_ns: int) -> bool:
    (true,) = from_frame(goal.point[None], found.start)
    # A command takes effect one frame later; from then on the robot brakes.
    braking_ns = min((t for t in found.true_poses if t > stamp_ns), default=stamp_ns)
    away_m = float(np.hypot(*(true - found.true_poses[braking_ns][:2, 3])))
    # The planner's own reach, and as much again for the map.
    return bool(goal.is_reached) and away_m <= 2 * ARRIVED_M


def picture(found: Exploration, truth: OccupancyGrid) -> bytes:
    """Draw the map on the truth with way, bumps and goals, below it what was seen, as PNG."""
    figure, show = _canvas(found, truth)
    show(len(found.moments) - 1)
    axes = figure.axes[0]
    bumps = np.array([_true_at(found, t) for t in found.bumps_ns]).reshape(-1, 2)
    axes.plot(*bumps.T, 'x', color='red', markersize=9, mew=2.5, label=f'{len(bumps)} bumps')
    for reached, colour in ((True, 'tab:green'), (False, 'tab:red')):
        goals = [e[0].point for e in found.goals if _is_reached(found, *e) == reached]
        if goals:
            points = from_frame(np.array(goals), found.start)
            label = 'goals reached' if reached else 'goals missed'
            axes.plot(*points.T, 'o', mfc='none', color=colour, label=f'{len(goals)} {label}')
    for name, bgr in COLOURS.items():
        axes.plot([], [], 's', color=_rgb(bgr), markeredgecolor='grey', label=name)
    axes.legend(loc='upper left', bbox_to_anchor=(1.01, 1.0), fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=110, bbox_inches='tight')
    drawn = cv2.imdecode(np.frombuffer(buffer.getvalue(), np.uint8), cv2.IMREAD_COLOR)
    return png_bytes(np.vstack([drawn, *_strip(found, drawn.shape[1])]))


def _strip(found: Exploration, width: int) -> list[NDArray[np.uint8]]:
    """Return rows of images seen on the way, evenly over the time, each with its time."""
    beside = STRIP_IMAGES // 2
    seen = [moment for moment in found.moments if moment.image is not None]
    chosen = np.unique(np.linspace(0, len(seen) - 1, min(STRIP_IMAGES, len(seen))).astype(int))
    images = [_with_time(seen[i], width // beside) for i in chosen]
    rows = [np.hstack(images[i : i + beside]) for i in range(0, len(images), beside)]
    white = 3 * [255]
    return [
        cv2.copyMakeBorder(row, 0, 0, 0, width - row.shape[1], cv2.BORDER_CONSTANT, value=white)
        for row in rows
    ]


def _with_time(moment: Moment, width: int) -> NDArray[np.uint8]:
    grey = np.asarray(moment.image)
    size = width, width * grey.shape[0] // grey.shape[1]
    image = cv2.cvtColor(cv2.resize(grey, size), cv2.COLOR_GRAY2BGR)
    text, font = f'{moment.stamp_ns * 1e-9:.0f} s', cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(image, text, (6, size[1] - 8), font, 0.5, (0, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(image, np.uint8)


def write_film(path: Path, found: Exploration, truth: OccupancyGrid) -> None:
    """Write the map as it grew as an animated GIF."""
    figure, show = _canvas(found, truth)
    count = len(found.moments)
    steps = np.linspace(0, count - 1, min(FILM_FRAMES, count)).astype(int)
    FuncAnimation(figure, show, frames=steps.tolist()).save(
        path, writer=PillowWriter(fps=10), dpi=60
    )


def _canvas(found: Exploration, truth: OccupancyGrid) -> tuple[Figure, Any]:
    """Return a figure, and what shows the map of a number with the way so far on it."""
    height, width = truth.cells.shape
    figure = Figure(figsize=(6 * max(width / height, 0.6), 6), layout='tight')
    axes = figure.add_subplot()
    shown = axes.imshow(np.zeros((height, width, 3)), origin='lower', extent=truth.extent_m)
    (way,) = axes.plot([], [], color='tab:blue', linewidth=1.2, label='true way')
    (robot,) = axes.plot([], [], 'o', color='tab:blue', markersize=6)
    stamps = np.array(sorted(found.true_poses))
    path = np.array([found.true_poses[t][:2, 3] for t in stamps.tolist()])

    def show(number: int) -> None:
        moment = found.moments[number]
        picture = coloured(compare(moment.grid, MapTruth(truth, found.start)))
        shown.set_data(picture[..., ::-1])
        count = int(np.searchsorted(stamps, moment.stamp_ns, side='right'))
        count = len(path) if number == len(found.moments) - 1 else count
        way.set_data(*path[:count].T)
        robot.set_data(*path[max(count - 1, 0) : count].T)
        axes.set_title(f'{moment.stamp_ns * 1e-9:.0f} s', fontsize=10)

    return figure, show


def _true_at(found: Exploration, stamp_ns: int) -> NDArray[np.float64]:
    nearest = min(found.true_poses, key=lambda t: abs(t - stamp_ns))
    return np.asarray(found.true_poses[nearest][:2, 3])


def _rgb(bgr: tuple[int, int, int]) -> tuple[float, ...]:
    return tuple(value / 255 for value in bgr[::-1])
