"""A robot that explores: to the nearest frontier of the map until none is left that it can reach,
then to goals. It knows what Nav2 would know, and drives by its own pose alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from segfloor_ros.floor.observation import FloorScan
from segfloor_ros.geometry import Array, invert, transform_points
from segfloor_ros.grid.map_file import OccupancyGrid
from segfloor_ros.navigation.costmap import Costmap, Ways

REPLAN_S = 1.0

MARGIN_M = 0.05
"""Kept from obstacles: a cell of the map."""

LOOKAHEAD_S = 1.5
"""The way ahead that pure pursuit aims at, in time; less where it would cut a corner."""

TURN_ON_SPOT_RAD = np.radians(50)
"""The robot turns on the spot towards a way that is further off its heading."""

ARRIVED_M = 0.15

LOOK_S = 2.0
"""What stays unknown after the robot has faced it for so long cannot be seen."""

FACED_RAD = np.radians(10)

PATIENCE_S = 8.0
MOST_TRIES = 3
"""Without getting on for so long the robot turns, to see more; after so many tries it gives up."""

OBSTACLE_REACH_M = 3.0
"""As `raytrace_max_range` of params/nav2.yaml."""

REVERSE_S = 3.0
"""Lost for so long, the robot turns back to where it came from, where the map is."""


@dataclass(frozen=True)
class Body:
    """What the planner knows of the robot. radius_m: it turns within. blind_m: nearer than this its
    camera does not see the floor. speed_m_s, turn_rad_s: at most.
    """

    radius_m: float
    blind_m: float
    speed_m_s: float
    turn_rad_s: float


@dataclass
class Goal:
    """A place (2,) in the map to drive to. is_reached: None while it lies ahead."""

    point: Array
    name: str = ''
    is_reached: bool | None = None


STOP = (0.0, 0.0)


@dataclass
class Explorer:
    """Decides how to drive, from what has been told of map, obstacles and free floor. goals: how
    many to draw at random once everything is explored, or which.
    """

    body: Body
    goals: int | Sequence[Goal]
    seed: int = 0
    grid: OccupancyGrid | None = None
    phase: str = 'exploring'
    ended: list[Goal] = field(default_factory=list)
    """Goals that were reached, or given up."""
    path: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Points (N, 2) of the way ahead in the map, and of `obstacles` on it."""
    obstacles: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._ahead: list[Goal] = [] if isinstance(self.goals, int) else list(self.goals)
        self._driven: list[Array] = []
        self._given_up: list[Array] = []
        self._target: Array | None = None
        self._facing: Array = np.zeros(2)
        self._planned_s = -np.inf
        self._faced_s: float | None = None
        self._progress_s = 0.0
        self._progress_at: Array = np.zeros(2)
        self._turn_until_s = -np.inf
        self._tries = 0
        self._lost_since_s: float | None = None
        self._turned, self._turn_back = 1.0, 1.0

    @property
    def is_done(self) -> bool:
        """Whether there is nothing more to do."""
        return self.phase == 'done'

    @property
    def goal(self) -> Goal | None:
        """The goal that is driven to."""
        return self._ahead[0] if self.phase == 'driving' and self._ahead else None

    def take_obstacles(self, points: Array, scan: FloorScan | None, T_map_base: Array) -> None:
        """Take in points (N, 3) of obstacles in the map and, as Nav2's local costmap does, drop
        those on floor that a scan from a pose has seen to be free since.
        """
        base = transform_points(invert(T_map_base), points)
        away_m = np.hypot(base[:, 0], base[:, 1])
        kept = away_m < OBSTACLE_REACH_M
        if scan is not None and len(scan.ranges_m):
            bearing = np.arctan2(base[:, 1], base[:, 0])
            ray = np.round((bearing - scan.angle_min_rad) / scan.angle_increment_rad).astype(int)
            seen = (ray >= 0) & (ray < len(scan.ranges_m))
            free_m = np.nan_to_num(scan.ranges_m[np.clip(ray, 0, len(scan.ranges_m) - 1)])
            kept &= ~(seen & (away_m < free_m))
        self.obstacles = points[kept, :2]

    def step(self, time_s: float, T_map_base: Array | None) -> tuple[float, float]:
        """Return how to drive from now on, m/s and rad/s, by the pose (4, 4) of the base, None
        while it is not known.
        """
        if T_map_base is None or self.grid is None:
            return self._look_for_place(time_s)
        self._lost_since_s = None
        pose = np.array([*T_map_base[:2, 3], np.arctan2(T_map_base[1, 0], T_map_base[0, 0])])
        if not self._driven or np.hypot(*(self._driven[-1] - pose[:2])) > self.body.radius_m / 2:
            self._driven.append(pose[:2])
        if time_s >= self._planned_s + REPLAN_S:
            self._planned_s = time_s
            self._plan(time_s, pose)
        forward, turn = self._drive(time_s, pose)
        self._turned = float(np.sign(turn)) or self._turned
        return forward, turn

    def _look_for_place(self, time_s: float) -> tuple[float, float]:
        """Stand still, then turn back: SLAM knows what it has seen before."""
        if self._lost_since_s is None:
            self._lost_since_s, self._turn_back = time_s, -self._turned
        if self.grid is None or time_s < self._lost_since_s + REVERSE_S:
            return STOP
        return 0.0, self._turn_back * self.body.turn_rad_s / 2

    def _plan(self, time_s: float, pose: Array) -> None:
        """Choose what to drive to, and the way there."""
        assert self.grid is not None
        body, driven = self.body, np.array([*self._driven, pose[:2]])
        radius_m = body.radius_m + MARGIN_M
        self._costmap = costmap = Costmap(
            self.grid, radius_m, 2 * radius_m, self.obstacles, driven, body.blind_m + radius_m
        )
        ways = costmap.ways_from(pose[:2], 2 * radius_m)
        if ways is not None and self.phase == 'exploring':
            self._aim_at(time_s, self._frontier(costmap, ways))
            if self._target is None and self._tries >= MOST_TRIES:
                self._begin_goals(costmap, ways)
        if self.phase == 'driving':
            self._aim_at(time_s, self._ahead[0].point if self._ahead else None)
            self.phase = 'driving' if self._ahead else 'done'
        self.path = np.zeros((0, 2))
        if ways is None or self._target is None:
            return
        number, away_m = costmap.nearest_place(self._target)
        if np.isfinite(ways.cost[number]) and away_m < radius_m:
            way = costmap.points_of(ways.cells[ways.to(number)])
            self.path = np.vstack([way, self._target])

    def _frontier(self, costmap: Costmap, ways: Ways) -> Array | None:
        """Return the frontier to drive to: the nearest, or the present one while it is one."""
        least = self.body.radius_m
        best, best_cost = None, np.inf
        for cells in costmap.frontiers():
            points = costmap.points_of(cells)
            cost = ways.cost[costmap.numbers_of(cells)]
            for given_up in self._given_up:
                cost = np.where(np.hypot(*(points - given_up).T) < 2 * least, np.inf, cost)
            if self._target is not None:
                is_same = np.hypot(*(points - self._target).T) < 2 * least
                cost = np.where(is_same, cost - 1.0, cost)
            nearest = int(np.argmin(cost))
            if cost[nearest] < best_cost:
                best, best_cost = points[nearest], cost[nearest]
        if best is not None:
            dark = costmap.points_of(np.argwhere(costmap.dark))
            near = dark[np.hypot(*(dark - best).T) < 4 * least]
            self._facing = near.mean(axis=0) if len(near) else best
        return best

    def _begin_goals(self, costmap: Costmap, ways: Ways) -> None:
        """Everything is explored: draw the goals."""
        self.phase, self._tries = 'driving', 0
        if isinstance(self.goals, int):
            places = ways.cells[np.isfinite(ways.cost)]
            drawn = self._rng.choice(len(places), min(self.goals, len(places)), replace=False)
            points = costmap.points_of(places[drawn])
            self._ahead = [Goal(point, f'goal_{i + 1}') for i, point in enumerate(points)]

    def _aim_at(self, time_s: float, target: Array | None) -> None:
        is_same = (
            target is not None
            and self._target is not None
            and np.hypot(*(target - self._target)) < ARRIVED_M
        )
        if not is_same:
            self._target, self._faced_s, self._progress_s = target, None, time_s

    def _drive(self, time_s: float, pose: Array) -> tuple[float, float]:
        """Return how to drive along the way, or how to get on where there is none."""
        if time_s < self._turn_until_s:
            return 0.0, self._turned * self.body.turn_rad_s
        if self._target is not None and np.hypot(*(self._target - pose[:2])) < ARRIVED_M:
            return self._arrive(time_s, pose)
        if np.hypot(*(self._progress_at - pose[:2])) > ARRIVED_M:
            self._progress_s, self._progress_at, self._tries = time_s, pose[:2], 0
        if self.is_done:
            return STOP
        if self._target is None or time_s > self._progress_s + PATIENCE_S:
            return self._recover(time_s)
        return self._pursue(pose) if len(self.path) else STOP

    def _arrive(self, time_s: float, pose: Array) -> tuple[float, float]:
        """Tick off a goal; look at what is unknown behind a frontier, and give up what stays so."""
        self._progress_s = time_s
        if self.phase == 'driving':
            self._end_goal(True)
            return STOP
        off = _bearing(self._facing, pose)
        if abs(off) < FACED_RAD:
            self._faced_s = time_s if self._faced_s is None else self._faced_s
            if time_s >= self._faced_s + LOOK_S:
                self._give_up()
            return STOP
        return 0.0, float(np.clip(2 * off, -1, 1)) * self.body.turn_rad_s

    def _recover(self, time_s: float) -> tuple[float, float]:
        """Turn to see more; what cannot be reached after some tries is given up."""
        self._tries += 1
        self._progress_s = time_s
        self._turn_until_s = time_s + np.pi / 2 / self.body.turn_rad_s
        if self._tries >= MOST_TRIES and self._target is not None:
            self._tries = 0
            if self.phase == 'driving':
                self._end_goal(False)
            else:
                self._give_up()
        return STOP

    def _give_up(self) -> None:
        assert self._target is not None
        self._given_up.append(self._target)
        self._target, self._planned_s = None, -np.inf

    def _end_goal(self, is_reached: bool) -> None:
        goal = self._ahead.pop(0)
        goal.is_reached = is_reached
        self.ended.append(goal)
        self._target, self._tries, self._planned_s = None, 0, -np.inf

    def _pursue(self, pose: Array) -> tuple[float, float]:
        """Return the arc to a point ahead on the way: w = 2 v sin(a) / d (Coulter, 1992)."""
        body = self.body
        away_m = np.hypot(*(self.path - pose[:2]).T)
        nearest = int(np.argmin(away_m))
        ahead = nearest
        while (
            ahead + 1 < len(self.path)
            and away_m[ahead] < LOOKAHEAD_S * body.speed_m_s
            and self._costmap.least_room_m(pose[:2], self.path[ahead + 1])
            > body.radius_m + MARGIN_M / 2
        ):
            ahead += 1
        off = _bearing(self.path[ahead], pose)
        if abs(off) > TURN_ON_SPOT_RAD:
            return 0.0, float(np.sign(off)) * body.turn_rad_s
        turn = 2 * body.speed_m_s * np.sin(off) / max(away_m[ahead], ARRIVED_M)
        slower = min(1.0, body.turn_rad_s / max(abs(turn), 1e-9))
        return body.speed_m_s * slower, float(turn) * slower


def _bearing(point: Array, pose: Array) -> float:
    """Return where a point (2,) lies from a pose x, y, yaw: radians to the left of ahead."""
    angle = np.arctan2(point[1] - pose[1], point[0] - pose[0]) - pose[2]
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
