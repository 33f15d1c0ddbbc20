"""Where to drive on a map that grows: map, points of obstacles and the free scan in, speeds out.

A small stand-in for Nav2 that needs no ROS: a costmap with inflated obstacles, the shortest paths
on it (Dijkstra), frontiers (Yamauchi, 1997) and pure pursuit (Coulter, 1992). The robot drives to
the nearest frontier of the map until none is left that it can reach, then to goals, by its own
pose alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from segfloor_ros.core.contracts import CELL_M, FloorScan
from segfloor_ros.core.geometry import Array, invert, planar, transform_points
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, Cells, OccupancyGrid

Mask = NDArray[np.bool_]

REPLAN_S = 1.0

LOOKAHEAD_S = 1.5
"""The way ahead that pure pursuit aims at, in time; less where it would cut a corner."""

TURN_ON_SPOT_RAD = np.radians(50)
"""The robot turns on the spot towards a way that is further off its heading, or to which no arc is
free."""

ARRIVED_M = 0.15

FAR_M = 1e6
"""What nothing leads to is further than anything else."""

LOOK_S = 3.0
"""So long the robot stands and looks where it does not know where it is; then it turns back to
where it came from, where the map is."""

FACED_RAD = np.radians(10)

BRAKING_S = 0.2
"""Half the time in which a base stops from full speed, at 1 m/s²."""

PATIENCE_S, MOST_TRIES = 8.0, 3
"""Without getting on for so long the robot turns, to see more; after so many tries it gives up."""

GOAL_TRIES = 6
"""A goal may lie where people come and go."""

NOWHERE: Array = np.zeros((0, 3))

OBSTACLE_REACH_M = 3.0
"""As `raytrace_max_range` of params/nav2.yaml."""


def graph_of(places: Mask, cell_m: float, weight: Array) -> csr_array:
    """Return the symmetric graph of steps between the eight neighbours of places, in the order of
    `np.argwhere(places)`: the length of a step times the weight of the place where it begins.
    """
    index = np.full(np.array(places.shape) + 2, -1, np.int32)
    index[1:-1, 1:-1][places] = np.arange(places.sum())
    here = index[1:-1, 1:-1][places]
    rows, columns, costs = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        shifted = index[1 + dy : index.shape[0] - 1 + dy, 1 + dx : index.shape[1] - 1 + dx][places]
        linked = shifted >= 0
        rows += [here[linked], shifted[linked]]
        columns += [shifted[linked], here[linked]]
        costs += [np.hypot(dy, dx) * cell_m * weight[linked]] * 2
    size = int(places.sum())
    entries = (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns)))
    return coo_array(entries, shape=(size, size)).tocsr()


@dataclass(frozen=True)
class Ways:
    """The shortest ways from one place. cells (N, 2): rows and columns of all places. cost (N,):
    of the way to each, inf where there is none. before (N,): the place before it, -1 at the start.
    """

    cells: Cells
    cost: Array
    before: NDArray[np.int32]

    @classmethod
    def from_place(cls, graph: csr_array, cells: Cells, start: int) -> Ways:
        """Find the shortest way to every place (Dijkstra)."""
        cost, before = dijkstra(graph, indices=[start], return_predecessors=True)
        return cls(cells, cost[0], before[0])

    def to(self, goal: int) -> list[int]:
        """Return the places after the start up to the goal."""
        way: list[int] = []
        while self.before[goal] >= 0:
            way.append(goal)
            goal = int(self.before[goal])
        return way[::-1]


class Costmap:
    """A map as a robot of some radius may drive on it.

    obstacles: points (N, 2) in the map that are in the way, too. driven: points (M, 2) where the
    robot has been, the last one now: floor unless the map says otherwise. blind_m: around the
    first of them it cannot see the floor until it has been further away. comfort_m: nearer to an
    obstacle than this a way counts more, up to three times.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        radius_m: float,
        comfort_m: float,
        obstacles: Array,
        driven: Array,
        blind_m: float,
    ) -> None:
        self.grid = grid
        at_start = np.zeros(grid.cells.shape, bool)
        if np.hypot(*(driven - driven[:1]).T).max(initial=0) <= blind_m:
            at_start = self._discs(driven[:1], blind_m)
        trodden = at_start | self._discs(driven, radius_m)
        marked = np.zeros(trodden.shape, bool)
        marked[tuple(self._on_map(obstacles).T)] = True
        standing = (grid.cells >= OCCUPIED) | marked
        standing &= ~self._discs(driven[-1:], radius_m / 2)
        # No ray passes between two cells that touch at a corner.
        self._walls = cv2.dilate(standing.astype(np.uint8), np.ones((2, 2), np.uint8)) > 0
        self.free = ((grid.cells == FREE) | trodden) & ~standing
        dark, unseen = (_without_slits((grid.cells == UNKNOWN) & ~m) for m in (trodden, at_start))
        self._unseen = unseen[1:-1, 1:-1]
        beside = cv2.dilate(unseen.astype(np.uint8), np.ones((3, 3), np.uint8))[1:-1, 1:-1] > 0
        self._edge_m = grid.away_m(beside & self.free)
        standing_m = self._standing_m = grid.away_m(standing)
        self.room_m = np.minimum(standing_m, grid.away_m(dark)[1:-1, 1:-1])
        self._radius_m = radius_m
        self.places = self.free & (self.room_m > radius_m)
        self.stops = self.places & (self.room_m > radius_m + CELL_M)
        """Where the robot can turn though its pose is off by as much as the map."""
        self._cells = np.argwhere(self.places)
        self._index = np.full(self.places.shape, -1, np.int64)
        self._index[self.places] = np.arange(len(self._cells))
        tightness = np.clip((comfort_m - standing_m) / (comfort_m - radius_m), 0, 1)
        self._graph = graph_of(self.places, grid.resolution_m, 1 + 2 * tightness[self.places])

    @classmethod
    def around(cls, body: Body, grid: OccupancyGrid, obstacles: Array, driven: Array) -> Costmap:
        """Return a map for a robot that keeps as far from things as they are known."""
        radius_m = body.radius_m + CELL_M
        return cls(grid, radius_m, 2 * radius_m, obstacles, driven, body.blind_m + radius_m)

    def ways_from(self, point: Array, reach_m: float) -> Ways | None:
        """Return the ways from the place nearest to a point (2,); None where none is in reach."""
        if not len(self._cells):
            return None
        start, away_m = self.nearest_place(point)
        return Ways.from_place(self._graph, self._cells, start) if away_m <= reach_m else None

    def nearest_place(self, point: Array) -> tuple[int, float]:
        """Return the number of the place nearest to a point (2,), and how far it is in metres."""
        away_m = np.hypot(*(self.grid.centres_of(self._cells) - point).T)
        nearest = int(np.argmin(away_m))
        return nearest, float(away_m[nearest])

    def cost_to(self, ways: Ways, point: Array) -> float:
        """Return the cost of the way to a point (2,), inf where none leads as near as counts."""
        number, away_m = self.nearest_place(point)
        return float(ways.cost[number]) if away_m < ARRIVED_M else np.inf

    def nearest_in_reach(self, ways: Ways, point: Array) -> tuple[int, bool]:
        """Return the number of the place in reach that is nearest to a point (2,), and whether it
        is the place of that point.
        """
        if np.isfinite(self.cost_to(ways, point)):
            return self.nearest_place(point)[0], True
        in_reach = np.flatnonzero(np.isfinite(ways.cost))
        away_m = np.hypot(*(self.grid.centres_of(self._cells[in_reach]) - point).T)
        return int(in_reach[np.argmin(away_m)]), False

    def least_room_m(self, pose: Array, point: Array) -> float:
        """Return how near what may be in the way comes to the arc that leads from a pose x, y, yaw
        to a point (2,).
        """
        off, away_m = float(_bearings(point, pose)), float(np.hypot(*(point - pose[:2])))
        count = 2 + int(2 * away_m / self.grid.resolution_m)
        # The chord to a point of the arc turns by as much as the arc that is left.
        turned = off * np.linspace(0, 1, count)
        chord_m = away_m * (np.sin(turned) / np.sin(off) if off else np.linspace(0, 1, count))
        heading = pose[2] + turned
        arc = pose[:2] + chord_m[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        return float(self.room_m[tuple(self._on_map(arc).T)].min(initial=np.inf))

    def standing_m(self, point: Array) -> float:
        """Return how near to a point (2,) something stands."""
        return float(self._standing_m[tuple(self._on_map(point).T)].min(initial=np.inf))

    def free_ahead_m(self, pose: Array, reach_m: float) -> float:
        """Return how far the robot gets from a pose x, y, yaw straight on, up to some reach,
        without coming nearer to anything within its radius.
        """
        way_m = np.arange(0, reach_m, self.grid.resolution_m)
        ahead = np.array([np.cos(pose[2]), np.sin(pose[2])])
        room_m = self._standing_m[tuple(self._on_map(pose[:2] + way_m[:, None] * ahead).T)]
        near = room_m < min(self._radius_m, room_m[0]) if len(room_m) else room_m > 0
        return float(way_m[max(int(np.argmax(near)) - 1, 0)]) if near.any() else reach_m

    def way_out(self, pose: Array, near: Array = NOWHERE[:, :2]) -> float:
        """Return 1 for ahead or -1 for back where something stands within the radius of the robot
        at a pose x, y, yaw, which might touch it in a turn: whichever leads out of its reach
        sooner, by no place that is nearer to anything; 0 where neither does, or nothing is there
        by more than half a cell. near: points (N, 2) that stand near the robot now, and leave one
        of two ways; where they leave none they are passed over, as some are wrong.
        """
        play_m = self.grid.resolution_m / 2
        if self.standing_m(pose[:2]) >= self._radius_m - play_m:
            return 0.0
        ahead = np.array([np.cos(pose[2]), np.sin(pose[2])])
        ways_m = np.arange(0, 2 * self._radius_m, self.grid.resolution_m)
        for points in (near, near[:0]):
            best, soonest = 0.0, len(ways_m)
            for sign in (1.0, -1.0):
                places = pose[:2] + sign * ways_m[:, None] * ahead
                room_m = np.array([self.standing_m(place) for place in places])
                away_m = np.hypot(*(points[:, None] - places).T).min(axis=1, initial=np.inf)
                room_m = np.minimum(room_m, away_m)
                ends = (room_m >= self._radius_m) | (room_m < room_m[0] - play_m)
                first = int(np.argmax(ends))
                if first < soonest and room_m[first] >= self._radius_m:
                    best, soonest = sign, first
            if best:
                return best
        return 0.0

    def numbers_of(self, cells: Cells) -> NDArray[np.int64]:
        """Return the numbers (N,) of places at cells (N, 2)."""
        return np.asarray(self._index[tuple(cells.T)])

    def _on_map(self, points: Array) -> Cells:
        cells = self.grid.cells_of(np.reshape(points, (-1, 2)))
        return cells[self.grid.holds(cells)]

    def _discs(self, points: Array, radius_m: float) -> Mask:
        """Return the cells around points."""
        mask = np.zeros(self.grid.cells.shape, np.uint8)
        for row, column in self.grid.cells_of(np.reshape(points, (-1, 2))).tolist():
            cv2.circle(mask, (column, row), round(radius_m / self.grid.resolution_m), 1, -1)
        return mask > 0

    def frontiers(self) -> Cells:
        """Return the places (N, 2) next to free floor that borders on unknown floor: none behind a
        wall.
        """
        near_m = self._radius_m + CELL_M + self.grid.resolution_m
        return np.argwhere(self.stops & (self._edge_m <= near_m))

    def shown(self, point: Array, reach_m: float) -> Array:
        """Return the unknown points (N, 2), one a cell, that a look around from a point (2,) would
        show: nothing stands before them.
        """
        step_m = self.grid.resolution_m
        count = int(2 * np.pi * reach_m / step_m)
        bearing = 2 * np.pi / count * np.arange(count)
        way_m = np.arange(step_m, reach_m, step_m)[:, None, None]
        rays = point + way_m * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        cells = self.grid.cells_of(rays)
        inside = self.grid.holds(cells)
        at = tuple(np.moveaxis(np.where(inside[..., None], cells, 0), -1, 0))
        stopped = np.cumsum(inside & self._walls[at], axis=0) > 0
        seen = ~stopped & (~inside | self._unseen[at])
        return self.grid.centres_of(np.unique(cells[seen], axis=0))


def _without_slits(unknown: Mask) -> Mask:
    """Return what is unknown (H, W), all around the map as well (H + 2, W + 2), without slits that
    the map leaves along walls.
    """
    padded = np.pad(unknown, 1, constant_values=True).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(padded, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0)


@dataclass(frozen=True)
class Body:
    """What the planner knows of the robot. radius_m: it turns within. blind_m: nearer than this its
    camera does not see the floor. speed_m_s, turn_rad_s: at most.
    """

    radius_m: float
    blind_m: float
    speed_m_s: float
    turn_rad_s: float

    def turning_m(self, points: Array, pose: Array) -> Array:
        """Return how far (N,) it drives in the time in which it turns from a pose x, y, yaw to
        points (N, 2).
        """
        return np.abs(_bearings(points, pose)) / self.turn_rad_s * self.speed_m_s


@dataclass
class Goal:
    """A place (2,) in the map to drive to. is_reached: None while it lies ahead. blocked: how many
    times nothing led to it; it is driven to again after the others.
    """

    point: Array
    name: str = ''
    is_reached: bool | None = None
    blocked: int = 0


STOP = (0.0, 0.0)


@dataclass
class Explorer:
    """Decides how to drive, from what is known of map, obstacles and free floor. goals: how
    many to draw at random once everything is explored, the nearest of them first, or which.
    """

    body: Body
    goals: int | Sequence[Goal]
    seed: int = 0
    grid: OccupancyGrid | None = None
    phase: str = 'exploring'
    ended: list[Goal] = field(default_factory=list)
    """Goals that were reached, or given up."""
    path: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Points (N, 2) of the way ahead in the map."""
    obstacles: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Points (N, 2) that ways lead around, beside what the map has."""
    near: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Points (N, 2) that stand near the robot now."""

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._ahead: list[Goal] = [] if isinstance(self.goals, int) else list(self.goals)
        self._driven: list[Array] = []
        self._explores, self._is_drawn = self.phase == 'exploring', False
        self._given_up: list[tuple[Array, float]] = []
        self._target: Array | None = None
        self._facing: Array = np.zeros(2)
        self._is_in_reach = True
        self._end: Array = np.full(2, np.inf)
        """The last place of the way: where something has come near a goal, not the goal."""
        self._in_reach: Array = np.zeros((0, 2))
        self._aside: Array | None = None
        self._planned_s = -np.inf
        self._faced_s: float | None = None
        self._progress_s = 0.0
        self._progress_at: Array = np.zeros(2)
        self._turn_until_s = -np.inf
        self._tries = 0
        self._lost_since_s: float | None = None
        self._turned, self._turn_back = 1.0, 1.0
        self._stepped_s, self._period_s = -np.inf, 0.0
        self._under_way = STOP

    @property
    def is_done(self) -> bool:
        """Whether there is nothing more to do."""
        return self.phase == 'done'

    @property
    def goal(self) -> Goal | None:
        """The goal that is driven to."""
        return self._ahead[0] if self.phase == 'driving' and self._ahead else None

    def take_obstacles(
        self, points: Array, scan: FloorScan | None, T_map_base: Array, near: Array = NOWHERE
    ) -> None:
        """Add points (N, 3) of obstacles in the map, one a cell, and, as Nav2's local costmap does,
        drop those on floor that a scan from a pose has seen to be free since, or under the robot.
        near: points (M, 3) that the robot does not drive into now; some are wrong, so ways lead
        through them.
        """
        known = np.vstack([self.obstacles, points[:, :2]])
        cells = np.floor(known / CELL_M).astype(np.int64)
        known = known[np.sort(np.unique(cells, axis=0, return_index=True)[1])]
        in_base = transform_points(invert(T_map_base), np.pad(known, ((0, 0), (0, 1))))
        away_m = np.hypot(in_base[:, 0], in_base[:, 1])
        kept = (away_m < OBSTACLE_REACH_M) & (away_m > self.body.radius_m / 2)
        if scan is not None and len(scan.ranges_m):
            bearing = np.arctan2(in_base[:, 1], in_base[:, 0])
            ray = np.round((bearing - scan.angle_min_rad) / scan.angle_increment_rad).astype(int)
            seen = (ray >= 0) & (ray < len(scan.ranges_m))
            free_m = np.nan_to_num(scan.ranges_m[np.clip(ray, 0, len(scan.ranges_m) - 1)])
            kept &= ~(seen & (away_m < free_m))
        self.obstacles, self.near = known[kept], near[:, :2]

    def step(self, time_s: float, T_map_base: Array | None) -> tuple[float, float]:
        """Return how to drive from now on, m/s and rad/s, by the pose (4, 4) of the base, None
        while it is not known.
        """
        if T_map_base is None or self.grid is None:
            self._under_way = self._look_for_place(time_s)
            return self._under_way
        self._lost_since_s = None
        self._period_s = min(time_s - self._stepped_s, REPLAN_S)
        self._stepped_s = time_s
        pose = planar(T_map_base)
        if not self._driven or np.hypot(*(self._driven[-1] - pose[:2])) > self.body.radius_m / 2:
            self._driven.append(pose[:2])
        if time_s >= self._planned_s + REPLAN_S or self._is_blocked(pose):
            self._planned_s = time_s
            self._plan(time_s, pose)
        # What is commanded now takes effect at the next frame.
        then = driven_on(pose, self._under_way, self._period_s)
        forward, turn = self._drive(time_s, then)
        if runs_into(self.near, then, (forward, turn), self._period_s + BRAKING_S, self.body):
            forward = 0.0
        self._turned = float(np.sign(turn)) or self._turned
        self._under_way = forward, turn
        return forward, turn

    def _look_for_place(self, time_s: float) -> tuple[float, float]:
        """Stand still, then turn back: SLAM knows what it has seen before."""
        if self._lost_since_s is None:
            self._lost_since_s, self._turn_back = time_s, -self._turned
        if self.grid is None or time_s < self._lost_since_s + LOOK_S:
            return STOP
        return 0.0, self._turn_back * self.body.turn_rad_s / 2

    def _is_blocked(self, pose: Array) -> bool:
        """Whether something has come to stand on the next stretch of the way."""
        assert self.grid is not None
        away_m = np.hypot(*(self.path - pose[:2]).T)
        ahead = self.path[away_m < self.body.radius_m + LOOKAHEAD_S * self.body.speed_m_s]
        if not len(ahead):
            return False
        occupied = self.grid.centres_of(np.argwhere(self.grid.cells >= OCCUPIED))
        standing = np.vstack([self.obstacles, occupied])
        if not len(standing):
            return False
        return bool(np.min(cKDTree(ahead).query(standing)[0]) < self.body.radius_m)

    def _plan(self, time_s: float, pose: Array) -> None:
        """Choose what to drive to, and the way there."""
        assert self.grid is not None
        radius_m = self.body.radius_m + CELL_M  # as far from obstacles as they are known
        driven = np.array([*self._driven, pose[:2]])
        self._costmap = costmap = Costmap.around(self.body, self.grid, self.obstacles, driven)
        ways = costmap.ways_from(pose[:2], 2 * radius_m)
        if ways is not None and self._explores and (self.goal is None or self._target is None):
            self._explore(time_s, self._frontier(costmap, ways, pose), driven)
        if self.phase == 'driving':
            if self._target is None and isinstance(self.goals, int) and ways is not None:
                cost = partial(costmap.cost_to, ways)
                self._ahead.sort(key=lambda goal: (goal.blocked, cost(goal.point)))
            goal = self._ahead[0].point if self._ahead else None
            self._aim_at(time_s, goal if self._aside is None else self._aside)
            self.phase = 'driving' if self._ahead else 'done'
        self.path, self._is_in_reach, self._end = np.zeros((0, 2)), True, np.full(2, np.inf)
        if ways is None or self._target is None:
            return
        self._in_reach = costmap.grid.centres_of(ways.cells[np.isfinite(ways.cost)])
        number, self._is_in_reach = costmap.nearest_in_reach(ways, self._target)
        self.path = self.grid.centres_of(ways.cells[ways.to(number)])
        self._end = self.grid.centres_of(ways.cells[number])

    def _explore(self, time_s: float, frontier: Array | None, driven: Array) -> None:
        """Drive to a frontier; without any turn to see more, then drive to goals. Before each of
        them whatever has become a frontier since is next.
        """
        if frontier is not None or not self._is_drawn:
            self.phase = 'exploring'
            self._aim_at(time_s, frontier)
            if frontier is None and self._tries >= MOST_TRIES:
                self._begin_goals(driven)
        elif self.phase == 'exploring':
            self._begin_goals(driven)

    def _frontier(self, costmap: Costmap, ways: Ways, pose: Array) -> Array | None:
        """Return the frontier to drive to: the soonest that would show as much floor as the robot
        turns in, or the present one while it is one that it can reach: of two that are as soon
        each seems sooner in turn.
        """
        least = self.body.radius_m
        cells = costmap.frontiers()
        points = costmap.grid.centres_of(cells)
        cost = ways.cost[costmap.numbers_of(cells)] + self.body.turning_m(points, pose)
        beyond = ~np.isfinite(cost)  # those come last
        cost[beyond] = FAR_M + np.hypot(*(points[beyond] - pose[:2]).T)
        for given_up, goals in self._given_up:
            is_near = np.hypot(*(points - given_up).T) < 2 * least
            cost = np.where(is_near & (len(self.ended) <= goals), np.inf, cost)
        if self._target is not None:
            is_same = np.hypot(*(points - self._target).T) < 2 * least
            cost = np.where(is_same, cost - FAR_M / 2, cost)
        while (cost < np.inf).any():
            best = points[int(np.argmin(cost))]
            shown = costmap.shown(best, 4 * least)
            if len(shown) * costmap.grid.resolution_m**2 >= (2 * least) ** 2:
                self._facing = shown[np.argmin(np.hypot(*(shown - shown.mean(axis=0)).T))]
                return best
            cost[np.hypot(*(points - best).T) < least / 2] = np.inf
        return None

    def _begin_goals(self, driven: Array) -> None:
        """Everything is explored: draw the goals, wherever the map leads; what stands in the way
        now may go.
        """
        self.phase, self._tries, self._target = 'driving', 0, None
        if isinstance(self.goals, int):
            assert self.grid is not None
            costmap = Costmap.around(self.body, self.grid, np.zeros((0, 2)), driven)
            ways = costmap.ways_from(driven[-1], np.inf)
            assert ways is not None
            places = ways.cells[np.isfinite(ways.cost) & costmap.stops[tuple(ways.cells.T)]]
            count = min(self.goals, len(places))
            if not self._is_drawn:
                self._ahead = [Goal(np.zeros(2), f'goal_{i + 1}') for i in range(count)]
            drawn = self._rng.choice(len(places), count, replace=False)
            points = costmap.grid.centres_of(places[drawn])
            for goal, point in zip(self._ahead, points, strict=False):
                goal.point = goal.point if goal.blocked else point
        self._is_drawn = True

    def _aim_at(self, time_s: float, target: Array | None) -> None:
        is_same = (
            target is not None
            and self._target is not None
            and np.hypot(*(target - self._target)) < ARRIVED_M
        )
        if not is_same:
            self._target, self._faced_s = target, None
            self._progress_s = max(time_s, self._turn_until_s)

    def _drive(self, time_s: float, pose: Array) -> tuple[float, float]:
        """Return how to drive along the way, or how to get on where there is none."""
        if time_s < self._turn_until_s:
            return 0.0, self._turned * self.body.turn_rad_s
        if self._target is not None:
            away_m, short_m = np.hypot(*(np.array([self._target, self._end]) - pose[:2]).T)
            if away_m < ARRIVED_M or (self._is_in_reach and short_m < CELL_M):
                return self._arrive(time_s, pose)
        if np.hypot(*(self._progress_at - pose[:2])) > ARRIVED_M:
            self._progress_s, self._progress_at, self._tries = time_s, pose[:2], 0
        if self.is_done:
            return STOP
        if self._target is None or time_s > self._progress_s + PATIENCE_S:
            return self._recover(time_s)
        way_out = self._costmap.way_out(pose, self.near)
        if way_out:
            return way_out * self.body.speed_m_s / 2, 0.0
        left_m = np.hypot(*(self.path[-1:] - pose[:2]).T)
        if not self._is_in_reach and left_m.max(initial=0) < ARRIVED_M:
            for_s = LOOK_S if self.phase == 'exploring' else PATIENCE_S
            return self._look_at(self._target, for_s, time_s, pose)
        return self._pursue(pose) if len(self.path) else STOP

    def _arrive(self, time_s: float, pose: Array) -> tuple[float, float]:
        """Tick off a goal; look at what is unknown behind a frontier, and give up what stays so."""
        self._progress_s = time_s
        if self.phase == 'driving':
            if self._aside is None:
                self._end_goal(True)
            self._aside, self._target, self._planned_s = None, None, -np.inf
            return STOP
        return self._look_at(self._facing, REPLAN_S, time_s, pose)

    def _look_at(
        self, point: Array, for_s: float, time_s: float, pose: Array
    ) -> tuple[float, float]:
        """Turn to a point (2,); a frontier that stays one is given up after some time."""
        off = float(_bearings(point, pose))
        if abs(off) > FACED_RAD:
            return 0.0, float(np.clip(2 * off, -1, 1)) * self.body.turn_rad_s
        self._progress_s = time_s
        self._faced_s = time_s if self._faced_s is None else self._faced_s
        if time_s >= self._faced_s + for_s:
            self._give_up(is_seen=self._is_in_reach)
        return STOP

    def _recover(self, time_s: float) -> tuple[float, float]:
        """Turn to see more; what cannot be reached after some tries is given up."""
        self._tries += 1
        self._progress_s = time_s
        self._turn_until_s = time_s + np.pi / 2 / self.body.turn_rad_s
        if self._tries >= MOST_TRIES and self._target is not None:
            self._tries = 0
            self._give_up(is_seen=False)
        return STOP

    def _give_up(self, is_seen: bool) -> None:
        """Give up what is driven to: a frontier that was looked at for good, one that cannot be
        reached the first time until after the next goal, a goal until after the others.
        """
        assert self._target is not None
        if self._aside is not None:
            self._aside = None
        elif self.phase == 'driving':
            self._postpone_goal()
        else:
            off_m = [np.hypot(*(self._target - point)) for point, _ in self._given_up]
            is_final = is_seen or min(off_m, default=np.inf) < 2 * self.body.radius_m
            self._given_up.append((self._target, np.inf if is_final else len(self.ended)))
        self._target, self._planned_s = None, -np.inf

    def _postpone_goal(self) -> None:
        """Drive to the other goals first or, where nothing led to them either, make way: to a place
        drawn at random, and who is hemmed in looks all around before.
        """
        goal = self._ahead[0]
        goal.blocked += 1
        if goal.blocked >= GOAL_TRIES:
            self._end_goal(False)
            return
        self._ahead.append(self._ahead.pop(0))
        if all(goal.blocked for goal in self._ahead) and len(self._in_reach):
            self._aside = self._rng.choice(self._in_reach)
            reach_m2 = len(self._in_reach) * self._costmap.grid.resolution_m**2
            if reach_m2 < (2 * self.body.radius_m) ** 2:
                # What is remembered beside and behind it may have gone.
                self._turn_until_s = self._stepped_s + 2 * np.pi / self.body.turn_rad_s

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
            and self._costmap.least_room_m(pose, self.path[ahead + 1]) > body.radius_m + CELL_M / 2
        ):
            ahead += 1
        off = float(_bearings(self.path[ahead], pose))
        is_free = self._costmap.least_room_m(pose, self.path[ahead]) > body.radius_m
        stop_s = self._period_s + BRAKING_S
        most_m = body.speed_m_s * stop_s
        stop_m = min(self._costmap.free_ahead_m(pose, most_m), away_m[-1])
        if not stop_m or abs(off) > (TURN_ON_SPOT_RAD if is_free else FACED_RAD):
            return 0.0, float(np.sign(off)) * min(body.turn_rad_s, abs(off) / stop_s)
        turn = 2 * body.speed_m_s * np.sin(off) / max(away_m[ahead], ARRIVED_M)
        slower = min(1.0, body.turn_rad_s / max(abs(turn), 1e-9), stop_m / most_m)
        return body.speed_m_s * slower, float(turn) * slower


def runs_into(
    points: Array, pose: Array, command: tuple[float, float], until_s: float, body: Body
) -> bool:
    """Whether a command at a pose x, y, yaw brings a robot within its radius of one of some points
    (N, 2), and nearer to that than it is: what Nav2 has its collision monitor for.
    """
    ways = [driven_on(pose, command, share * until_s)[:2] for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    away_m = np.hypot(*(points[:, None] - ways).T)
    return bool((away_m.min(axis=0) < np.minimum(away_m[0], body.radius_m)).any())


def driven_on(pose: Array, command: tuple[float, float], period_s: float) -> Array:
    """Return where a robot at a pose x, y, yaw is after a time with a command, m/s and rad/s."""
    way_m, turn = np.array(command) * period_s
    heading = pose[2] + turn / 2
    return pose + np.array([way_m * np.cos(heading), way_m * np.sin(heading), turn])


def _bearings(points: Array, pose: Array) -> Array:
    """Return where points (..., 2) lie from a pose x, y, yaw: radians (...) left of ahead."""
    angle = np.arctan2(points[..., 1] - pose[1], points[..., 0] - pose[0]) - pose[2]
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
