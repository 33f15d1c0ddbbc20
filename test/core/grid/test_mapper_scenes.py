"""The map of small worlds that change, leak and hold thin things."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from conftest import Drive, World, cells_at, centres, no_points

from segfloor_ros.core.contracts import POINT_FLOOR, POINT_OBSTACLE, LabelledPoints
from segfloor_ros.core.grid.occupancy import OccupancyGridSettings

MakeDrive = Callable[..., Drive]
ROOM = World(walls=((4, -3, 4, 3), (-1, 2, 4, 2), (-1, -2, 4, -2)))
AHEAD = [(0.02 * i, 0.0, 0.0) for i in range(100)]


@pytest.mark.parametrize(('reach_m', 'expected'), [(0.005, 0), (0.02, 100), (0.045, 100)])
def test_a_cell_into_which_a_wall_reaches_far_enough_is_occupied(
    make_drive: MakeDrive, reach_m: float, expected: int
) -> None:
    # A fifth of 5 cm is 1 cm.
    wall = World(walls=((2.0 - reach_m, -3, 2.0 - reach_m, 3),))
    drive = make_drive(OccupancyGridSettings(occupied_share=0.2), error_per_m=0.0)
    for pose in AHEAD[:40:4]:
        drive.look(wall, pose)
    assert (cells_at(drive.grid(), centres((1.95, 2.0), (-0.3, 0.3))) == expected).all()


def test_a_wall_seen_askew_is_placed_across_it(make_drive: MakeDrive) -> None:
    # Along the bearing the way through a cell is several times as long.
    wall = World(walls=((-1.0, 0.98, 6.0, 0.98),))
    drive = make_drive(OccupancyGridSettings(occupied_share=0.2), error_per_m=0.0)
    for pose in AHEAD[:60:2]:
        drive.look(wall, pose)
    assert (cells_at(drive.grid(), centres((2.0, 3.0), (0.9, 0.95))) == 0).all()
    assert (cells_at(drive.grid(), centres((2.0, 3.0), (0.95, 1.0))) == 100).mean() > 0.9


def with_disc(world: World, *disc: float) -> World:
    return World((*world.discs, disc), world.walls)  # type: ignore[arg-type]


def test_a_room_is_free_inside_and_its_wall_occupied(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    for pose in AHEAD[:60:4]:
        drive.look(ROOM, pose)
    grid = drive.grid()
    assert (cells_at(grid, centres((1.4, 3.8), (-0.6, 0.6))) == 0).all()
    assert (cells_at(grid, centres((4.05, 6.0), (-2.0, 2.0))) != 0).all()
    wall = cells_at(grid, centres((4.0, 4.05), (-1.0, 1.0)))
    assert len(wall) == 40
    assert (wall == 100).all()


def test_a_person_walking_through_leaves_no_ghost(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    here = (0.0, 0.0, 0.0)
    for _ in range(5):
        drive.look(ROOM, here)
    for k in range(14):  # from right to left at 0.5 m a keyframe and less
        drive.look(with_disc(ROOM, 2.0, -1.6 + 0.25 * k, 0.2), here)
    for _ in range(10):
        drive.look(ROOM, here)
    area = centres((1.5, 3.3), (-1.2, 1.2))
    assert (cells_at(drive.grid(), area) == 0).all()


def test_a_person_who_stands_is_in_the_map_until_gone(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    person = with_disc(ROOM, 2.0, 0.0, 0.2)
    for _ in range(100):
        drive.look(person, (0.0, 0.0, 0.0))
    face = np.array([[1.825, 0.0], [1.825, 0.04]])
    assert (cells_at(drive.grid(), face) == 100).all()
    assert (cells_at(drive.grid(), centres((2.3, 3.5), (-0.1, 0.1))) == -1).all()
    # However long they stood there, this many looks clear the face and then what is behind it:
    # (1.95 + 0.4) / 0.4 = 6 for a cell; the hidden ones from the look on that opens the view.
    for _ in range(7):
        drive.look(ROOM, (0.0, 0.0, 0.0))
    assert (cells_at(drive.grid(), centres((1.5, 3.5), (-0.3, 0.3))) == 0).all()


def test_what_has_come_is_marked_after_a_few_looks(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    for _ in range(100):
        drive.look(ROOM, (0.0, 0.0, 0.0))
    for _ in range(5):
        drive.look(with_disc(ROOM, 2.0, 0.0, 0.2), (0.0, 0.0, 0.0))
    assert cells_at(drive.grid(), np.array([[1.825, 0.0]])) == 100


@pytest.mark.parametrize('miss_share', [0.0, 0.3])
def test_a_chair_leg_stays(make_drive: MakeDrive, miss_share: float) -> None:
    leg = with_disc(ROOM, 3.02, 0.41, 0.015)
    drive = make_drive(OccupancyGridSettings(), miss_share=miss_share)
    for pose in AHEAD:
        drive.look(leg, pose)
    near = cells_at(drive.grid(), centres((2.95, 3.10), (0.35, 0.50)))
    assert (near == 100).any()
    assert (near == 100).sum() <= 4


def test_a_leg_is_not_cleared_from_where_it_cannot_be_seen(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    leg = with_disc(World(walls=((7, -3, 7, 3),)), 3.02, 0.01, 0.015)
    for _ in range(10):
        drive.look(leg, (1.0, 0.0, 0.0))
    drive.miss_share = 0.0
    without = World(walls=leg.walls)
    for k in range(40):  # 4.5 m away: too far to place a thing of 3 cm
        drive.look(without, (-1.5, 0.0, 0.001 * k))
    assert (cells_at(drive.grid(), centres((2.95, 3.15), (-0.1, 0.1))) == 100).any()


@pytest.mark.parametrize('thickness_m', [0.04, 0.001])
def test_a_door_leaf_stays_whole(make_drive: MakeDrive, thickness_m: float) -> None:
    along = np.array([0.7, 0.6])
    across = thickness_m * np.array([-0.6, 0.7]) / math.hypot(0.6, 0.7)
    corners = [np.array([2.5, 0.3]), np.array([2.5, 0.3]) + along]
    corners += [corners[1] - across, corners[0] - across]
    leaf = [(*a, *b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    drive = make_drive(OccupancyGridSettings())
    for pose in AHEAD:
        drive.look(World(walls=(*ROOM.walls, *leaf)), pose)
    middle = np.linspace(0.05, 0.95, 20)[:, None] * along + corners[0] - across / 2
    normal = np.array([-0.6, 0.7]) / math.hypot(0.6, 0.7)
    grid = drive.grid()
    crossing = [cells_at(grid, middle + s * normal) for s in np.arange(-0.1, 0.1, 0.01)]
    # Between two cells that touch at a corner a line may slip through.
    assert (np.max(crossing, axis=0) == 100).mean() >= 0.85


def test_a_thin_leg_stays_while_the_base_circles_around_it(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    leg = with_disc(World(), 0.012, 0.021, 0.012)
    for angle in np.linspace(0, 6 * math.pi, 150):
        x, y = 1.5 * math.cos(angle), 1.5 * math.sin(angle)
        drive.look(leg, (x, y, angle + math.pi + 0.1 * math.sin(7 * angle)))
    near = cells_at(drive.grid(), centres((-0.1, 0.1), (-0.1, 0.1)))
    assert (near == 100).any()


def test_leaks_open_no_way_through_a_wall(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings(), leak_share=0.1)
    for pose in AHEAD:
        drive.look(ROOM, pose)
    behind = cells_at(drive.grid(), centres((4.15, 6.0), (-2.0, 2.0)))
    assert (behind == 0).mean() < 0.002
    assert (cells_at(drive.grid(), centres((2.5, 3.8), (-0.6, 0.6))) == 0).mean() > 0.99


def test_floor_behind_what_stands_is_not_believed_at_first_sight(make_drive: MakeDrive) -> None:
    # The wall ends at y = 0.3: what lies behind it is joined to what is seen past it.
    wall = World(walls=((2.02, -3.0, 2.02, 0.3),))
    drive = make_drive(OccupancyGridSettings(), error_per_m=0.0)
    for _ in range(5):
        drive.look(wall, (0.0, 0.0, 0.0))
    drive.leak_share = 1.0
    behind, through = centres((2.3, 3.2), (-0.4, 0.1)), centres((2.0, 2.05), (-0.4, 0.1))
    drive.look(wall, (0.0, 0.0, 0.0))
    assert (cells_at(drive.grid(), behind) == -1).all()
    for _ in range(3):
        drive.look(wall, (0.0, 0.0, 0.0))
    # The view behind it opens sooner than the wall: there is no way through.
    assert (cells_at(drive.grid(), through) != 0).all()
    for _ in range(17):
        drive.look(wall, (0.0, 0.0, 0.0))
    assert (cells_at(drive.grid(), np.vstack([behind, through])) == 0).all()


def point_cloud(xyz: list[tuple[float, float, float]], label: int) -> LabelledPoints:
    count = len(xyz)
    return LabelledPoints(
        np.arange(count, dtype=np.int32),
        np.array(xyz, np.float32).reshape(-1, 3),
        np.full(count, label, np.uint8),
        np.ones(count, np.float32),
    )


def test_a_table_top_over_free_floor_is_occupied(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    edge = point_cloud([(2.02, 0.02, 0.7)], POINT_OBSTACLE)
    for k in range(20):
        drive.look(ROOM, (0.0, 0.0, 0.0), edge if k % 2 else no_points())
    assert (cells_at(drive.grid(), centres((2.0, 2.1), (0.0, 0.05))) == 100).any()


@pytest.mark.parametrize(('use_points', 'expected'), [(True, 100), (False, 0)])
def test_points_are_left_out_where_asked_for(
    make_drive: MakeDrive, use_points: bool, expected: int
) -> None:
    drive = make_drive(OccupancyGridSettings(use_points=use_points))
    edge = point_cloud([(2.02, 0.02, 0.7)], POINT_OBSTACLE)
    for _ in range(10):
        drive.look(ROOM, (0.0, 0.0, 0.0), edge)
    assert cells_at(drive.grid(), np.array([[2.02, 0.02]])) == expected


def test_one_outlier_marks_nothing(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    drive.look(World(), (0.0, 0.0, 0.0), point_cloud([(2.02, 0.02, 0.5)], POINT_OBSTACLE))
    assert (drive.grid().cells != 100).all()


def test_rays_to_floor_points_free_their_cells(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings(use_scan=False, footprint_radius_m=0.0))
    drive.look(
        World(), (0.0, 0.0, 0.0), point_cloud([(2.0, 0.0, 0.0), (0.0, 1.0, 0.0)], POINT_FLOOR)
    )
    grid = drive.grid()
    assert (cells_at(grid, np.array([[0.5, 0.0], [1.5, 0.0], [0.0, 0.5]])) == 0).all()
    assert (cells_at(grid, np.array([[2.2, 0.0], [1.0, 1.0], [0.0, 1.2], [0.0, -0.5]])) == -1).all()


def test_the_base_has_driven_over_free_floor(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings(footprint_radius_m=0.2, use_scan=False))
    drive.look(World(), (0.0, 0.0, 0.0))
    drive.look(World(), (1.0, 0.0, 0.0))
    grid = drive.grid()
    assert (cells_at(grid, centres((0.0, 1.0), (-0.1, 0.1))) == 0).all()
    beyond = np.concatenate([centres((0.0, 1.0), (0.25, 0.4)), centres((1.3, 1.5), (-0.1, 0.1))])
    assert (cells_at(grid, beyond) == -1).all()


@pytest.mark.parametrize(('opening_cells', 'expected'), [(0, 0), (3, -1)])
def test_opening_removes_single_rays(
    make_drive: MakeDrive, opening_cells: int, expected: int
) -> None:
    settings = OccupancyGridSettings(use_scan=False, opening_cells=opening_cells)
    drive = make_drive(settings)
    drive.look(World(), (0.0, 0.0, 0.0), point_cloud([(2.0, 0.02, 0.0)], POINT_FLOOR))
    assert cells_at(drive.grid(), np.array([[1.5, 0.02]])) == expected
    assert cells_at(drive.grid(), np.array([[0.0, 0.0]])) == 0


def test_what_was_seen_from_near_outweighs_what_is_seen_from_afar(make_drive: MakeDrive) -> None:
    # A wall, seen from 1 m, and from 3 m 12 cm nearer than it is: twenty times as often.
    settings = OccupancyGridSettings(footprint_radius_m=0.0)
    near, far = (World(walls=((x, -3, x, 3),)) for x in (4.02, 3.9))
    drive = make_drive(settings, error_per_m=0.0)
    for _ in range(5):
        drive.look(near, (3.0, 0.0, 0.0))
    for _ in range(100):
        drive.look(far, (1.0, 0.0, 0.0))
    grid = drive.grid()
    assert (cells_at(grid, centres((3.8, 4.0), (-0.4, 0.4))) == 0).all()
    assert (cells_at(grid, centres((4.0, 4.05), (-0.4, 0.4))) == 100).all()


def test_a_wall_seen_from_afar_alone_is_marked(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings(), error_per_m=0.0)
    for _ in range(5):
        drive.look(World(walls=((4.02, -3, 4.02, 3),)), (1.0, 0.0, 0.0))
    assert (cells_at(drive.grid(), centres((4.0, 4.05), (-1.0, 1.0))) == 100).all()


def test_what_seemed_wider_from_afar_hides_nothing_from_near(make_drive: MakeDrive) -> None:
    # The end of a wall, and how it looked from 3.5 m: 8 cm longer.
    long, true = (World(walls=((1.0, -2.0, 1.0, end),)) for end in (0.08, 0.0))
    drive = make_drive(OccupancyGridSettings(footprint_radius_m=0.0), error_per_m=0.0)
    for _ in range(6):
        drive.look(long, (-2.5, -0.5, 0.0))
    behind = np.array([[1.3, 0.0], [1.6, -0.08], [1.9, -0.17]])
    assert (cells_at(drive.grid(), behind) == -1).all()
    assert (cells_at(drive.grid(), centres((1.0, 1.05), (0.0, 0.05))) == 100).all()
    drive.look(true, (0.0, 0.3, 0.0))
    assert (cells_at(drive.grid(), behind) == 0).all()
    assert (cells_at(drive.grid(), centres((1.0, 1.05), (-0.5, -0.1))) == 100).all()


def test_cells_that_the_edge_of_the_view_crosses_are_free(make_drive: MakeDrive) -> None:
    # The wall ends between the bearings of 5 and 5.5 degrees, so the view past it begins at 5.5.
    wall = World(walls=((1.0, -3.0, 1.0, math.tan(math.radians(5.25))),))
    drive = make_drive(OccupancyGridSettings(footprint_radius_m=0.0), error_per_m=0.0)
    drive.look(wall, (0.0, 0.0, 0.0))
    distance = np.linspace(1.3, 2.8, 60)
    edge = math.radians(5.5)
    crossed = np.stack([distance * math.cos(edge), distance * math.sin(edge)], axis=1)
    assert (cells_at(drive.grid(), crossed) == 0).all()
    hidden = np.stack([distance, distance * math.tan(math.radians(2.0))], axis=1)
    assert (cells_at(drive.grid(), hidden) == -1).all()


def test_a_wall_that_turns_out_a_cell_farther_hides_nothing(make_drive: MakeDrive) -> None:
    # Along a wall seen askew, its old cells stand in front of the floor before its new ones.
    old, new = (World(walls=((0.3, y, 4.0, y),)) for y in (0.262, 0.312))
    drive = make_drive(OccupancyGridSettings(footprint_radius_m=0.0), error_per_m=0.0)
    for _ in range(10):
        drive.look(old, (0.0, 0.0, 0.0))
    for _ in range(11):
        drive.look(new, (0.0, 0.0, 0.0))
    before_it = centres((0.6, 1.6), (0.25, 0.3))
    assert (cells_at(drive.grid(), before_it) == 0).all()


def ended_wall(x: float) -> World:
    """Return a wall across the way that ends, so that there is a way around it."""
    return World(walls=((x, -0.5, x, 3.0),))


def test_nothing_stays_free_right_behind_a_wall_that_had_drifted(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    strip = centres((2.05, 2.1), (0.0, 0.5))
    for pose in AHEAD[:40:2]:
        drive.look(ended_wall(2.1), pose)
    assert (cells_at(drive.grid(), strip) == 0).all()
    for pose in AHEAD[:40:2]:
        drive.look(ended_wall(2.0), pose)
    assert (cells_at(drive.grid(), strip) != 0).all()


def test_a_wall_of_a_hand_s_breadth_has_free_floor_on_both_sides(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    for _ in range(3):
        for pose in AHEAD[:40:2]:
            drive.look(ended_wall(2.0), pose)
        for x, y, _ in AHEAD[:40:2]:
            drive.look(ended_wall(2.1), (4.0 - x, y, math.pi))
    for beside in ((1.9, 2.0), (2.1, 2.2)):
        assert (cells_at(drive.grid(), centres(beside, (0.0, 0.5))) == 0).all()


def test_what_could_move_is_in_the_map_where_it_stood_for_most_of_its_life(
    make_drive: MakeDrive,
) -> None:
    parked, gone, left = (2.0, 0.8, 0.3), (2.0, -0.9, 0.3), (3.2, 0.0, 0.2)
    there = [World(discs=discs) for discs in ((parked, gone, left), (parked, left), (parked,))]
    drive = make_drive(OccupancyGridSettings(), movable=there[0])
    at = {disc: centres((disc[0] - 0.3, disc[0]), (disc[1] - 0.2, disc[1] + 0.2)) for disc in
          (parked, gone, left)}  # fmt: skip

    def is_there(disc: tuple[float, float, float]) -> bool:
        return bool((cells_at(drive.grid(), at[disc]) == 100).any())

    for pose in AHEAD[:20]:
        drive.look(ROOM, pose)
    assert is_there(parked) and is_there(gone) and is_there(left)
    # The first one leaves in view, the second one while nobody looks.
    drive.movable = there[1]
    for pose in AHEAD[20:45]:
        drive.look(ROOM, pose)
    assert is_there(parked) and not is_there(gone) and is_there(left)
    drive.movable = there[2]
    for x, y, _ in AHEAD[45:]:
        drive.look(ROOM, (x, y, math.pi))
    assert not (is_there(parked) or is_there(gone) or is_there(left))
    for x, y, _ in AHEAD[45:]:
        drive.look(ROOM, (x - 1, y, math.pi))
    drive.look(ROOM, (0.0, 0.0, 0.0))
    assert is_there(parked) and not (is_there(gone) or is_there(left))


def test_maps_of_earlier_releases_hold_nothing_that_could_move(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings())
    for pose in AHEAD[:20:4]:
        drive.look(ROOM, pose)
    arrays = drive.mapper.to_arrays()
    old = {name: a for name, a in arrays.items() if not name.startswith('movable')}
    read = make_drive(OccupancyGridSettings())
    read.mapper.from_arrays(old, old['stamp_ns'])
    np.testing.assert_array_equal(read.grid().cells, drive.grid().cells)
