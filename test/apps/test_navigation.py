"""The planner on small maps: what may be driven over, ways, frontiers, and a robot that explores a
floor plan which it sees bit by bit.
"""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.navigation import STOP, Body, Costmap, Explorer, Goal
from segfloor_ros.core.contracts import FloorScan
from segfloor_ros.core.geometry import make_transform
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

CELL_M = 0.1
BODY = Body(radius_m=0.15, blind_m=0.3, speed_m_s=0.4, turn_rad_s=0.8)
NOTHING = np.zeros((0, 2))

TWO_ROOMS = """
##########################
#............#...........#
#............#...........#
#........................#
#........................#
#........................#
#........................#
#........................#
#............#...........#
#............#...........#
##########################
"""


def grid_of(drawing: str, origin_xy_m=(0.0, 0.0)) -> OccupancyGrid:
    """Return a map of `#` occupied, `.` free, `?` unknown; the lowest row is that of least y."""
    rows = drawing.split()[::-1]
    codes = {'#': OCCUPIED, '.': FREE, '?': UNKNOWN}
    return OccupancyGrid(
        np.array([[codes[c] for c in row] for row in rows], np.int8), CELL_M, origin_xy_m
    )


def costmap_of(grid: OccupancyGrid, obstacles=NOTHING, driven=((0.65, 0.55),)) -> Costmap:
    return Costmap(grid, 0.15, 0.3, np.array(obstacles), np.array(driven), 0.0)


def pose_of(x: float, y: float, yaw: float) -> np.ndarray:
    return make_transform(Rotation.from_euler('Z', yaw).as_matrix(), np.array([x, y, 0.0]))


def test_cells_and_points_are_of_the_map_whatever_its_origin() -> None:
    costmap = costmap_of(grid_of(TWO_ROOMS, (-3.0, 2.0)), driven=[(-2.35, 2.55)])
    place, away_m = costmap.nearest_place(np.array([-2.35, 2.55]))
    ways = costmap.ways_from(np.array([-2.35, 2.55]), 0.3)
    assert away_m < CELL_M and ways is not None
    assert np.hypot(*(costmap.grid.centres_of(ways.cells[place]) - (-2.35, 2.55))) == away_m


def test_a_way_leads_through_the_door_and_keeps_off_the_walls() -> None:
    costmap = costmap_of(grid_of(TWO_ROOMS))
    ways = costmap.ways_from(np.array([0.35, 0.85]), 0.3)
    goal, away_m = costmap.nearest_place(np.array([2.2, 0.85]))
    assert away_m < CELL_M
    way = costmap.grid.centres_of(ways.cells[ways.to(goal)])
    crossing = way[np.abs(way[:, 0] - 1.35) < 0.06]
    assert len(crossing)
    assert ((crossing[:, 1] > 0.4) & (crossing[:, 1] < 0.7)).all()
    rows, columns = costmap.grid.cells_of(way).T
    assert (costmap.room_m[rows, columns] > 0.15).all()
    assert np.hypot(*np.diff(way, axis=0).T).max() < 1.5 * CELL_M


def test_a_crate_in_the_door_closes_the_way() -> None:
    ways = costmap_of(grid_of(TWO_ROOMS), [(1.35, 0.45), (1.35, 0.65)]).ways_from(
        np.array([0.35, 0.85]), 0.3
    )
    assert not np.isfinite(ways.cost[ways.cells[:, 1] > 13]).any()


def test_what_has_come_to_stand_where_the_robot_was_closes_the_way_too() -> None:
    through_the_door = [(x, 0.55) for x in np.arange(2.05, 0.6, -0.1)]
    post = [(1.35, 0.55)]
    for obstacles, is_open in ((NOTHING, True), (post, False)):
        ways = costmap_of(grid_of(TWO_ROOMS), obstacles, through_the_door).ways_from(
            np.array([0.65, 0.55]), 0.3
        )
        assert np.isfinite(ways.cost[ways.cells[:, 1] > 15]).any() == is_open


def test_where_the_robot_stands_is_free_and_what_it_cannot_see_before_it() -> None:
    grid = grid_of('???????????\n' * 11)
    costmap = Costmap(grid, 0.15, 0.3, NOTHING, np.array([(0.55, 0.55)]), 0.4)
    assert costmap.places[5, 5]
    assert costmap.places[5, 7]
    assert not costmap.places[5, 8]


def test_what_it_could_not_see_at_its_start_is_unknown_once_it_has_been_further_away() -> None:
    grid = grid_of(TWO_ROOMS)
    grid.cells[1:10, 1:10] = UNKNOWN
    start = (0.55, 0.55)
    for driven, is_free in (([start, (0.95, 0.55)], True), ([start, (1.15, 0.55), start], False)):
        costmap = Costmap(grid, 0.15, 0.3, NOTHING, np.array(driven), 0.45)
        assert costmap.free[5, 1] == is_free
        assert is_free or len(costmap.frontiers())


def test_frontiers_are_places_to_turn_beside_unknown_floor_but_not_beside_slits() -> None:
    grid = grid_of(TWO_ROOMS)
    grid.cells[1:4, 1] = UNKNOWN
    assert not len(costmap_of(grid).frontiers())
    grid.cells[1:-1, 18:-1] = UNKNOWN
    frontier = costmap_of(grid).frontiers()
    assert frontier[:, 1].max() == 15, 'a radius, what its pose is off, and as fine as the map is'
    assert frontier[:, 1].min() >= 14


def test_less_floor_than_the_robot_turns_in_is_not_worth_a_way_but_is_kept_away_from() -> None:
    grid = grid_of(TWO_ROOMS)
    grid.cells[4:8, 20:24] = UNKNOWN
    for radius_m, is_worth_it in ((0.15, True), (0.18, False)):
        explorer = Explorer(dataclasses.replace(BODY, radius_m=radius_m), 0, grid=grid)
        explorer.step(0.0, pose_of(1.55, 0.55, 0.0))
        assert len(explorer._costmap.frontiers())
        assert (explorer._target is not None) is is_worth_it
        assert explorer._costmap.room_m[6, 19] < 2.5 * CELL_M


def test_no_look_passes_between_two_cells_that_touch_at_a_corner() -> None:
    grid = grid_of(TWO_ROOMS)
    grid.cells[:, 14:] = UNKNOWN
    for row in range(3, 8):
        grid.cells[row, 11 + row % 2] = OCCUPIED
    grid.cells[3:8, 13] = FREE
    assert not len(costmap_of(grid).shown(np.array([0.85, 0.55]), 0.9))


def test_places_that_stay_unseen_however_often_it_looks_are_given_up() -> None:
    grid = grid_of('\n'.join(['#' * 62, *['#' + '.' * 60 + '#'] * 20, '#' * 62]))
    grid.cells[9:13, 8:12] = grid.cells[9:13, 45:49] = UNKNOWN
    explorer, pose, command = Explorer(BODY, 0, grid=grid), np.array([3.0, 0.5, 0.0]), STOP
    explorer._driven = [
        np.array([x, y]) for x in np.arange(0.5, 5.7, 0.1) for y in np.arange(0.9, 1.4, 0.1)
    ]
    for step in range(2000):
        (forward, turn), command = command, explorer.step(0.2 * step, pose_of(*pose))
        heading = np.array([forward * np.cos(pose[2]), forward * np.sin(pose[2]), turn])
        pose = pose + 0.2 * heading
        if explorer.is_done:
            break
    assert explorer.is_done and explorer._given_up


def test_a_look_shows_what_nothing_stands_before() -> None:
    grid = grid_of(TWO_ROOMS)
    grid.cells[:, 14:] = UNKNOWN
    costmap = costmap_of(grid)
    shown = costmap.shown(np.array([1.15, 0.55]), 0.6)
    assert (shown[:, 0] > 1.4).all() and (np.hypot(*(shown - (1.15, 0.55)).T) < 0.7).all()
    assert len(shown) > 10
    grid.cells[3:5, 13] = OCCUPIED
    half = costmap_of(grid).shown(np.array([1.15, 0.55]), 0.6)
    assert 0 < len(half) < len(shown) and (half[:, 1] > 0.45).all()
    grid.cells[3:8, 13] = OCCUPIED
    assert not len(costmap_of(grid).shown(np.array([1.15, 0.55]), 0.6))


def test_floor_that_it_drove_over_without_seeing_it_is_explored() -> None:
    grid = grid_of(TWO_ROOMS)
    grid.cells[1:7, 1:6] = UNKNOWN
    explorer = Explorer(BODY, 0, grid=grid)
    for x in (0.35, 0.75, 1.15, 2.15):
        explorer.step(10 * x, pose_of(x, 0.45, 0.0))
    assert explorer._target is not None and explorer._target[0] < 1.0
    assert explorer._facing[0] < 0.6


def test_it_goes_on_to_its_frontier_though_another_has_become_nearer_as_long_as_a_way_leads() -> (
    None
):
    grid = grid_of(TWO_ROOMS)
    grid.cells[1:-1, 1:4] = grid.cells[1:-1, 22:25] = UNKNOWN
    explorer = Explorer(BODY, 0, grid=grid)
    ends = []
    for time_s, x, yaw in ((0.0, 1.75, 0.0), (2.0, 0.75, np.pi)):
        explorer.step(time_s, pose_of(x, 0.55, yaw))
        ends.append(explorer.path[-1, 0])
    assert min(ends) > 1.75
    explorer.grid = grid_of(TWO_ROOMS)
    explorer.grid.cells[:] = grid.cells
    explorer.grid.cells[3:8, 13] = OCCUPIED
    explorer.step(4.0, pose_of(0.75, 0.55, np.pi))
    assert explorer.path[-1, 0] < 0.75


ROOM_AND_PASSAGE = """
####################
#.........##########
#.........##########
#..................#
#..................#
#..................#
#.........##########
#.........##########
####################
"""


def test_in_a_passage_as_narrow_as_its_pose_is_sure_it_drives_but_does_not_turn() -> None:
    body, driven = dataclasses.replace(BODY, radius_m=0.12), np.array([[0.5, 0.45]])
    costmap = Costmap.around(body, grid_of(ROOM_AND_PASSAGE), NOTHING, driven)
    ways = costmap.ways_from(np.array([0.5, 0.45]), 0.3)
    assert ways is not None and np.isfinite(costmap.cost_to(ways, np.array([1.65, 0.45])))
    assert costmap.stops[4, 3:7].all() and not costmap.stops[:, 11:].any()
    explorer = Explorer(body, 20, seed=1)
    drive = Drive(grid_of(ROOM_AND_PASSAGE), explorer, np.array([0.5, 0.45, 0.0]), is_known=True)
    while explorer.phase == 'exploring':
        drive.go_on(drive.time_s + 0.2)
    assert explorer._ahead and all(goal.point[0] < 1.05 for goal in explorer._ahead)


def test_what_is_unknown_behind_a_wall_is_no_frontier() -> None:
    grid = grid_of(TWO_ROOMS)
    grid.cells[:, 14:] = UNKNOWN
    grid.cells[3:8, 13] = OCCUPIED
    assert not len(costmap_of(grid).frontiers())
    grid.cells[3:8, 13] = FREE
    assert len(costmap_of(grid).frontiers())


def test_a_scan_clears_what_it_passes_and_nothing_else() -> None:
    explorer = Explorer(BODY, 0)
    ahead, aside, far = (1.0, 0.0, 0.1), (0.0, 1.0, 0.1), (5.0, 0.0, 0.1)
    scan = FloorScan(-0.5, 0.1, np.full(11, 2.0, np.float32), None, 4.0)
    cases = [(None, [ahead, aside]), (scan, [aside])]
    for seen, kept in cases:
        explorer.take_obstacles(np.array([ahead, aside, far]), seen, np.eye(4))
        explorer.grid = grid_of(TWO_ROOMS)
        assert explorer.obstacles.tolist() == [list(point[:2]) for point in kept]


def test_a_scan_clears_along_its_own_bearings_wherever_the_robot_looks() -> None:
    explorer = Explorer(BODY, 0)
    # Free to the left of ahead for 2 m, to the right of it for half a metre.
    ranges = np.where(np.arange(11) >= 7, 2.0, 0.5).astype(np.float32)
    scan = FloorScan(-0.5, 0.1, ranges, None, 4.0)
    T_map_base = pose_of(3.0, -1.0, np.pi / 2)
    left, right = np.array([[1.0, 0.35, 0.1], [1.0, -0.35, 0.1]])
    in_map = np.array([T_map_base[:3, :3] @ p + T_map_base[:3, 3] for p in (left, right)])
    explorer.take_obstacles(in_map, scan, T_map_base)
    np.testing.assert_allclose(explorer.obstacles, in_map[1:, :2])


def test_obstacles_out_of_view_are_remembered_until_it_sees_their_floor_or_is_there() -> None:
    explorer = Explorer(BODY, 0)
    beside = np.array([(0.0, 1.0, 0.1), (0.0, 1.01, 0.1)])
    explorer.take_obstacles(beside, None, np.eye(4))
    scan = FloorScan(-0.5, 0.1, np.full(11, 2.0, np.float32), None, 4.0)
    explorer.take_obstacles(np.zeros((0, 3)), scan, np.eye(4))
    assert explorer.obstacles.tolist() == [[0.0, 1.0]], 'one a cell'
    for drops in (pose_of(0.0, 0.0, np.pi / 2), pose_of(0.05, 1.0, np.pi)):
        explorer.take_obstacles(beside, None, np.eye(4))
        explorer.take_obstacles(np.zeros((0, 3)), scan, drops)
        assert not len(explorer.obstacles)


def test_it_does_not_drive_into_what_it_sees_now_but_its_way_leads_through() -> None:
    cases = {(0.25, 0.0): False, (0.8, 0.0): True, (0.1, 0.2): True, (-0.2, 0.0): True}
    cases |= {(0.12, 0.0): False, (-0.12, 0.0): True}
    for (ahead_m, aside_m), drives in cases.items():
        explorer = Explorer(BODY, [Goal(np.array([1.1, 0.55]))], phase='driving')
        explorer.grid = grid_of(TWO_ROOMS)
        near = np.array([[0.45 + ahead_m, 0.55 + aside_m, 0.0]])
        explorer.take_obstacles(np.zeros((0, 3)), None, pose_of(0.45, 0.55, 0.0), near)
        forward, _ = explorer.step(0.0, pose_of(0.45, 0.55, 0.0))
        assert (forward > 0) == drives, (ahead_m, aside_m)
        assert len(explorer.path) and not len(explorer.obstacles)


class Drive:
    """A robot on a true map, of which it sees what lies before it within some metres.
    is_known: all of it was seen before.
    """

    def __init__(
        self, truth: OccupancyGrid, explorer: Explorer, pose: np.ndarray, is_known: bool = False
    ) -> None:
        self.truth, self.explorer, self.pose = truth, explorer, pose
        self.time_s, self.nearest_m = 0.0, np.inf
        self._command = STOP
        self._known = truth.cells.copy() if is_known else np.full_like(truth.cells, UNKNOWN)
        room = cv2.distanceTransform((truth.cells == FREE).astype(np.uint8), cv2.DIST_L2, 5)
        self._room_m = room * CELL_M

    def see(self) -> None:
        x, y, yaw = self.pose
        for angle in yaw + np.linspace(-0.8, 0.8, 60):
            for way in np.arange(0.25, 2.0, CELL_M / 3):
                cell = (int((y + way * np.sin(angle)) / CELL_M),
                        int((x + way * np.cos(angle)) / CELL_M))  # fmt: skip
                if not self.truth.holds(np.array([cell]))[0]:
                    break  # between two cells that touch at a corner
                self._known[cell] = self.truth.cells[cell]
                if self._known[cell] == OCCUPIED:
                    break
        self.explorer.grid = OccupancyGrid(self._known.copy(), CELL_M, (0.0, 0.0))

    def go_on(self, until_s: float) -> None:
        while self.time_s < until_s and not self.explorer.is_done:
            self.see()
            x, y, yaw = self.pose
            # What is commanded at a frame takes effect at the next one.
            (forward, turn), self._command = (
                self._command,
                self.explorer.step(self.time_s, pose_of(x, y, yaw)),
            )
            step = np.array([forward * np.cos(yaw), forward * np.sin(yaw), turn])
            self.pose = self.pose + 0.2 * step
            self.time_s += 0.2
            self.nearest_m = min(self.nearest_m, self._room_m[int(y / CELL_M), int(x / CELL_M)])

    @property
    def share(self) -> float:
        floor = self.truth.cells == FREE
        return float((self._known == FREE)[floor].mean())


def test_it_explores_both_rooms_then_drives_to_its_goals_and_touches_nothing() -> None:
    drive = Drive(grid_of(TWO_ROOMS), Explorer(BODY, 3, seed=1), np.array([0.6, 0.55, 3.0]))
    drive.go_on(300.0)
    assert drive.explorer.is_done
    assert drive.share > 0.97
    assert [goal.is_reached for goal in drive.explorer.ended] == [True] * 3
    assert drive.nearest_m > BODY.radius_m - CELL_M / 2


@pytest.mark.slow
def test_goals_that_are_given_are_driven_to_in_their_order_and_one_in_a_wall_is_given_up() -> None:
    goals = [Goal(np.array([2.0, 0.8]), 'desk'), Goal(np.array([1.35, 0.95]), 'wall')]
    drive = Drive(grid_of(TWO_ROOMS), Explorer(BODY, goals), np.array([0.6, 0.55, 0.0]))
    drive.go_on(300.0)
    assert [(g.name, g.is_reached) for g in drive.explorer.ended] == [
        ('desk', True),
        ('wall', False),
    ]


@pytest.mark.slow
def test_a_goal_to_which_a_wall_has_come_too_near_is_reached_from_the_place_beside_it() -> None:
    goal = Goal(np.array([1.12, 0.86]))  # The place is at 1.05, 0.75.
    drive = Drive(grid_of(TWO_ROOMS), Explorer(BODY, [goal]), np.array([0.6, 0.55, 0.0]))
    drive.go_on(200.0)
    assert goal.is_reached
    assert drive.nearest_m > BODY.radius_m - CELL_M / 2


def test_who_is_hemmed_in_by_what_has_gone_looks_around_and_gets_out() -> None:
    grid = grid_of(24 * (30 * '.' + '\n'))
    post = np.array([[1.45, 1.25, 0.1]])
    bearing = np.radians(np.arange(40, 321, 10))
    gone = np.stack([1.2 + 0.25 * np.cos(bearing), 1.25 + 0.25 * np.sin(bearing)], axis=1)
    goal = Goal(np.array([2.5, 1.25]))
    explorer = Explorer(BODY, [goal], phase='driving')
    explorer.grid, pose, command = grid, np.array([1.2, 1.25, 0.0]), STOP
    remembered = np.pad(gone, ((0, 0), (0, 1)), constant_values=0.1)
    for step in range(600):
        T_map_base = pose_of(*pose)
        off, way_m = np.subtract(post[0, :2], pose[:2]), np.full(11, 2.0, np.float32)
        rays = pose[2] - 0.5 + 0.1 * np.arange(11)
        across = np.abs(np.cos(rays) * off[1] - np.sin(rays) * off[0])
        hit = (across < 0.1) & (np.cos(rays) * off[0] + np.sin(rays) * off[1] > 0)
        way_m[hit] = np.hypot(*off) - 0.1
        scan = FloorScan(-0.5, 0.1, way_m, None, 4.0)
        explorer.take_obstacles(
            np.vstack([post, remembered[: len(gone) * (step == 0)]]), scan, T_map_base
        )
        (forward, turn), command = command, explorer.step(0.2 * step, T_map_base)
        pose += 0.2 * np.array([forward * np.cos(pose[2]), forward * np.sin(pose[2]), turn])
        assert np.hypot(*(post[0, :2] - pose[:2])) > BODY.radius_m
        if explorer.is_done:
            break
    assert goal.is_reached


DOORS = """
######################################
#............#.......................#
#....................................#
#....................................#
#....................................#
#....................................#
#............#.......................#
#............#.......................#
#....................................#
#....................................#
#....................................#
#....................................#
#............#.......................#
######################################
"""
LOWER, UPPER = slice(2, 6), slice(8, 12)


START = np.array([0.6, 0.4, 0.0])


def shut(truth: OccupancyGrid, rows: slice, is_shut: bool = True) -> None:
    truth.cells[rows, 13] = OCCUPIED if is_shut else FREE


def test_a_door_that_shuts_is_driven_around() -> None:
    truth = grid_of(DOORS)
    goal = Goal(np.array([2.0, 0.4]))
    drive = Drive(truth, Explorer(BODY, [goal], phase='driving'), START, is_known=True)
    drive.go_on(1.0)
    shut(truth, LOWER)
    drive.go_on(60.0)
    assert goal.is_reached
    assert drive.nearest_m > BODY.radius_m - CELL_M  # as finely as the map is


@pytest.mark.slow
def test_a_goal_behind_a_shut_door_is_driven_to_after_the_others_once_that_is_open_again() -> None:
    truth = grid_of(DOORS)
    goals = [Goal(np.array([2.0, 0.4]), 'behind'), Goal(np.array([0.35, 0.9]), 'here')]
    drive = Drive(truth, Explorer(BODY, goals, phase='driving'), START, is_known=True)
    for rows in (LOWER, UPPER):
        shut(truth, rows)
    drive.go_on(45.0)
    assert [(goal.name, goal.is_reached) for goal in drive.explorer.ended] == [('here', True)]
    for rows in (LOWER, UPPER):
        shut(truth, rows, False)
    drive.go_on(100.0)
    assert [goal.name for goal in drive.explorer.ended if goal.is_reached] == ['here', 'behind']


@pytest.mark.slow
def test_what_was_behind_shut_doors_is_explored_once_they_are_open_and_goals_lie_there_too() -> (
    None
):
    truth = grid_of(DOORS)
    for rows in (LOWER, UPPER):
        shut(truth, rows)
    drive = Drive(truth, Explorer(dataclasses.replace(BODY, radius_m=0.12), 4, seed=3), START)
    while drive.explorer.phase == 'exploring':
        drive.go_on(drive.time_s + 0.2)
    assert drive.share < 0.6
    for rows in (LOWER, UPPER):
        shut(truth, rows, False)
    drive.go_on(drive.time_s + 300.0)
    assert drive.share > 0.97
    assert [goal.is_reached for goal in drive.explorer.ended] == [True] * 4
    assert len({goal.name for goal in drive.explorer.ended}) == 4
    assert any(goal.point[0] > 1.4 for goal in drive.explorer.ended)


def test_where_nothing_leads_to_the_goal_it_goes_near_looks_and_then_makes_way() -> None:
    truth = grid_of(DOORS)
    for rows in (LOWER, UPPER):
        shut(truth, rows)
    goal = Goal(np.array([2.2, 0.4]))
    drive = Drive(truth, Explorer(BODY, [goal], phase='driving'), START, is_known=True)
    drive.go_on(10.0)
    near = drive.pose.copy()
    assert near[0] > 0.9
    bearing = np.arctan2(*(goal.point - near[:2])[::-1])
    assert abs(bearing - near[2]) < np.radians(11)
    away_m = []
    while drive.time_s < 25.0:
        drive.go_on(drive.time_s + 0.2)
        away_m.append(np.hypot(*(drive.pose - near)[:2]))
    assert max(away_m) > 0.3
    for rows in (LOWER, UPPER):
        shut(truth, rows, False)
    drive.go_on(60.0)
    assert goal.is_reached


@pytest.mark.parametrize(('post', 'sign'), [((0.95, 0.55), -1), ((0.35, 0.55), 1)])
def test_it_drives_straight_away_from_what_it_would_touch_in_a_turn(post, sign) -> None:
    body = dataclasses.replace(BODY, radius_m=0.35)
    explorer = Explorer(body, [Goal(np.array([0.65, 1.3]))], phase='driving')
    explorer.grid = grid_of(13 * (14 * '.' + '\n'))
    explorer.obstacles = np.array([post, post])
    assert explorer.step(0.0, pose_of(0.65, 0.55, 0.0)) == (sign * BODY.speed_m_s / 2, 0.0)
    explorer.obstacles = NOTHING
    forward, turn = explorer.step(1.0, pose_of(0.65, 0.55, 0.0))
    assert forward == 0 and turn > 0


@pytest.mark.parametrize('x', np.arange(0.31, 1.1, 0.13))
def test_from_what_stands_beside_it_it_drives_on_one_way_until_it_may_turn(x) -> None:
    posts = [(0.65, 0.75), (1.05, 0.35)]
    costmap = Costmap(grid_of(13 * (20 * '.' + '\n')), 0.3, 0.6, np.array(posts), NOTHING, 0.0)
    signs = [costmap.way_out(np.array([x, 0.55, 0.0]))]
    while signs[-1] and len(signs) < 20:
        x += 0.05 * signs[-1]
        signs.append(costmap.way_out(np.array([x, 0.55, 0.0])))
    assert signs[-1] == 0 and abs(sum(signs)) == len(signs) - 1
    assert costmap.standing_m(np.array([x, 0.55])) >= 0.3 - CELL_M / 2


def test_it_does_not_back_out_past_what_would_come_nearer() -> None:
    posts = np.array([(0.85, 0.85), (1.55, 0.55)])
    costmap = Costmap(grid_of(13 * (24 * '.' + '\n')), 0.45, 0.9, posts, NOTHING, 0.0)
    assert costmap.way_out(np.array([1.05, 0.55, 0.0])) == 0


def test_it_does_not_drive_out_towards_what_is_near_now() -> None:
    pose, beside = np.array([0.65, 0.55, 0.0]), np.array([[0.55, 0.75]])
    costmap = Costmap(grid_of(13 * (24 * '.' + '\n')), 0.3, 0.6, beside, NOTHING, 0.0)
    assert costmap.way_out(pose) == 1
    assert costmap.way_out(pose, np.array([[0.95, 0.55]])) == -1
    assert costmap.way_out(pose, np.array([[0.95, 0.55], [0.35, 0.55]])) == 1, 'one may be wrong'


@pytest.mark.parametrize('yaw', [0.0, np.pi])
def test_along_a_wall_that_it_might_touch_it_turns_as_neither_way_leads_off(yaw) -> None:
    body = dataclasses.replace(BODY, radius_m=0.35)
    explorer = Explorer(body, [Goal(np.array([1.3, 1.5]))], phase='driving')
    explorer.grid = grid_of('#' * 26 + 20 * ('\n' + 26 * '.') + '\n' + '#' * 26)
    forward, turn = explorer.step(0.0, pose_of(1.3, 0.35, yaw))
    assert forward == 0 and turn != 0


def test_what_stands_within_its_radius_it_does_not_creep_towards() -> None:
    costmap = costmap_of(grid_of(TWO_ROOMS), [(0.85, 0.55)])
    assert costmap.free_ahead_m(np.array([0.72, 0.55, 0.0]), 1.0) == 0
    assert costmap.free_ahead_m(np.array([0.72, 0.55, np.pi]), 0.3) == 0.3


def test_it_would_stop_a_radius_and_what_a_map_is_off_from_a_wall() -> None:
    body = dataclasses.replace(BODY, radius_m=0.18)
    costmap = Costmap.around(body, grid_of(TWO_ROOMS), NOTHING, np.array([(1.55, 0.55)]))
    # The wall's cells have their middle at 2.55 m; a step beyond is what it notices it by.
    most_m = 2.55 - (0.18 + 0.05) - 1.55 + CELL_M
    assert costmap.free_ahead_m(np.array([1.55, 0.55, 0.0]), 2.0) < most_m


@pytest.mark.parametrize('period_s', [0.1, 0.4])
def test_it_stops_before_a_wall_although_commands_take_effect_a_frame_later(period_s) -> None:
    explorer = Explorer(BODY, [Goal(np.array([2.2, 0.55]))], phase='driving')
    explorer.grid = grid_of(TWO_ROOMS)
    x_m, late = 1.55, [STOP]
    for i in range(100):
        late.append(explorer.step(i * period_s, pose_of(x_m, 0.55, 0.0)))
        x_m += late.pop(0)[0] * period_s
    assert explorer.is_done and explorer.ended[0].is_reached
    assert x_m < 2.5 - BODY.radius_m - CELL_M, 'a radius and a cell from the wall'


def test_goals_are_drawn_wherever_the_map_leads_also_behind_somebody_in_the_way() -> None:
    explorer = Explorer(BODY, 20, seed=1)
    drive = Drive(grid_of(TWO_ROOMS), explorer, np.array([0.6, 0.55, 0.0]), is_known=True)
    explorer.obstacles = np.array([(1.35, y) for y in np.arange(0.35, 0.8, 0.05)])
    drive.go_on(20.0)
    assert explorer.phase == 'driving'
    assert any(goal.point[0] > 1.5 for goal in explorer._ahead)


@pytest.mark.slow
def test_of_drawn_goals_the_nearest_is_next_and_one_without_a_way_waits_for_the_others() -> None:
    explorer = Explorer(BODY, 20, seed=2)
    drive = Drive(grid_of(TWO_ROOMS), explorer, np.array([0.6, 0.55, 0.0]), is_known=True)
    while explorer.phase == 'exploring':
        drive.go_on(drive.time_s + 0.2)
    nearest = min(explorer._ahead, key=lambda g: np.hypot(*(g.point - drive.pose[:2])))
    assert explorer.goal is nearest
    shut = drive.truth.cells[3:7, 13]
    shut[:] = OCCUPIED
    while any(goal.point[0] < 1.3 for goal in explorer._ahead):
        drive.go_on(drive.time_s + 0.2)
    assert all(goal.is_reached and goal.point[0] < 1.3 for goal in explorer.ended)
    shut[:] = FREE
    drive.go_on(drive.time_s + 100)
    assert [goal.is_reached for goal in explorer.ended] == [True] * 20


def test_without_a_pose_it_stops_at_once_and_later_turns_back() -> None:
    drive = Drive(grid_of(TWO_ROOMS), Explorer(BODY, 0), np.array([0.6, 0.55, 0.0]))
    drive.go_on(2.0)
    commands = [drive.explorer.step(2.0 + 0.1 * i, None) for i in range(60)]
    assert commands[0] == STOP
    assert all(forward == 0 for forward, _ in commands)
    assert abs(commands[-1][1]) > 0
    after = [drive.explorer.step(9.0 + 0.1 * i, pose_of(*drive.pose)) for i in range(100)]
    assert set(after) != {STOP}


def test_before_the_first_map_it_stands_still() -> None:
    explorer = Explorer(BODY, 0)
    assert {explorer.step(float(t), np.eye(4)) for t in range(10)} == {STOP}
