"""Scene files, solids, meshes, textures and the true map, without rendering."""

from itertools import pairwise

import numpy as np
import pytest

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.simulation.scene import MovingBox, Person, Scene
from segfloor_ros.apps.simulation.scene_file import (
    PLAN,
    merged_rectangles,
    open_scene,
    plan_tour,
    read_scene_values,
    scene_from_mapping,
    shipped,
)
from segfloor_ros.apps.simulation.solids import (
    block,
    cylinder,
    floor_height_m,
    floors,
    is_moving,
    obstacles,
    part_poses,
    true_map,
)
from segfloor_ros.apps.simulation.textures import GENERATORS, make_texture
from segfloor_ros.apps.simulation.world import cap, merge, sides
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.nodes.map_files import save_map

PATH = {'waypoints': [[0.5, 0.5], [1.5, 0.5]]}
ROOM = [[0, 0], [4, 0], [4, 3], [0, 3]]


def scene_with(**values) -> Scene:
    return scene_from_mapping({'description': 'a test', 'path': PATH, **values}, 'test')


def map_of(scene: Scene):
    return true_map(scene, obstacles(scene), floors(scene), np.array(scene.path.waypoints[0]))


def cell(grid, x, y):
    column, row = ((np.array([x, y]) - grid.origin_xy_m) / grid.resolution_m).astype(int)
    return grid.cells[row, column]


@pytest.mark.parametrize('name', sorted(shipped()))
def test_shipped_scenes_leave_room_for_the_robot(name):
    scene = open_scene(name)
    grid = map_of(scene)
    assert (grid.cells == FREE).sum() * grid.resolution_m**2 > 5.0
    occupied = np.argwhere(grid.cells == OCCUPIED)[:, ::-1] + 0.5
    centres = np.array(grid.origin_xy_m) + occupied * grid.resolution_m
    for waypoint in scene.path.waypoints:
        assert np.hypot(*(centres - waypoint).T).min() > 0.2


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'walls': [{'texture': 'plain'}]}, 'walls 1: points is missing'),
        ({'wals': []}, 'unknown entry wals: did you mean walls'),
        ({'camera': {'height_m': 'high'}}, "camera, height_m: 'high' is not a number"),
        ({'camera': {'width': 64.5}}, 'width: 64.5 is not a whole number'),
        ({'boxes': [{'at': [1, 2], 'size': [1, 2]}]}, r'size: expected 3 numbers'),
        ({'boxes': 3}, 'boxes: expected a list'),
        ({'floor': 'tiles'}, 'floor: expected names and values'),
    ],
)
def test_scene_errors_name_the_entry(values, message):
    with pytest.raises(InputError, match=message):
        scene_with(**values)


def test_scene_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match='no such scene'):
        open_scene('corridor_1')
    with pytest.raises(InputError, match=r'none\.yaml: cannot be read'):
        read_scene_values(tmp_path / 'none.yaml')
    (tmp_path / 'bad.yaml').write_text('walls: [\n')
    with pytest.raises(InputError, match=r'bad\.yaml, line 2'):
        read_scene_values(tmp_path / 'bad.yaml')
    (tmp_path / 'bad.yaml').write_text('like: halls\n')
    with pytest.raises(InputError, match='did you mean hall'):
        read_scene_values(tmp_path / 'bad.yaml')


def test_a_scene_takes_over_what_it_does_not_say(tmp_path):
    file = tmp_path / 'mine.yaml'
    file.write_text('like: hall\ncamera: {height_m: 0.5, vibration: {roll_deg: 1}}\nboxes: []\n')
    mine = open_scene(str(file), ['camera.pitch_deg=3', 'seed=9'])
    hall = open_scene('hall')
    assert (mine.camera.height_m, mine.camera.pitch_deg, mine.seed) == (0.5, 3.0, 9)
    assert mine.camera.vibration.roll_deg == 1.0
    assert (mine.walls, mine.path, mine.boxes) == (hall.walls, hall.path, ())


@pytest.mark.parametrize('name', ['plaster', 'concrete', 'carpet', 'marble', 'granite', 'metal'])
def test_noise_repeats_without_a_seam(name):
    pixels = make_texture(name, 3).pixels.astype(float)
    for axis in (0, 1):
        steps = np.abs(np.diff(pixels, axis=axis)).mean(axis=1 - axis)
        seam = np.abs(pixels.take(0, axis) - pixels.take(-1, axis)).mean()
        assert seam <= steps.max()


@pytest.mark.parametrize('name', sorted(GENERATORS))
def test_textures_are_square_and_neither_black_nor_white(name):
    texture = make_texture(name, 3)
    assert texture.pixels.dtype == np.uint8
    assert texture.pixels.shape[0] == texture.pixels.shape[1]
    assert texture.side_m > 0
    assert 30 < texture.pixels.mean() < 240


def test_textures_follow_their_seed():
    made = make_texture.__wrapped__  # not those of before
    first, again, other = (made('cloth', seed).pixels for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first.astype(float) - other).mean() > 5
    with pytest.raises(InputError, match='did you mean marble'):
        make_texture('marbel', 1)


def enclosed_volume(mesh):
    """Return the volume by the divergence theorem, which needs every face to point outwards."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def test_meshes_are_closed_and_face_outwards():
    box = block((3.0, -2.0), (2.0, 1.0, 0.5), 'wood', yaw_deg=30, bottom_m=0.2)
    mesh = merge([sides(box, 1.0), cap(box, 1, 1.0), cap(box, -1, 1.0)])
    assert enclosed_volume(mesh) == pytest.approx(1.0)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    geometric = np.cross(b - a, c - a)
    geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.normals[mesh.faces[:, 0]], geometric, atol=1e-9)
    tube = cylinder((1.0, 1.0), 0.5, 2.0, 'metal')
    mesh = merge([sides(tube, 1.0), cap(tube, 1, 1.0), cap(tube, -1, 1.0)])
    polygon = 32 / 2 * 0.25 * np.sin(2 * np.pi / 32)
    assert enclosed_volume(mesh) == pytest.approx(2.0 * polygon)
    radial = mesh.vertices[: 4 * 32, :2] - 1.0
    np.testing.assert_allclose(mesh.normals[: 4 * 32, :2], radial / 0.5, atol=1e-9)


def test_texture_coordinates_are_in_metres():
    box = block((0.0, 0.0), (2.0, 1.0, 0.5), 'wood', bottom_m=0.25)
    mesh = sides(box, 4.0)
    first_side = mesh.uv[:4] * 4.0
    np.testing.assert_allclose(np.ptp(first_side, axis=0), [2.0, 0.5])
    # Up in the world is up in the picture, where v runs downward.
    assert mesh.uv[mesh.vertices[:, 2] == 0.75][:, 1].max() == pytest.approx(-0.75 / 4)


def test_true_map_of_a_box_on_the_raster():
    walls = [{'points': ROOM, 'closed': True, 'thickness_m': 0.1}]
    boxes = [{'at': [2.0, 2.0], 'size': [0.5, 0.2, 0.3]}]
    grid = map_of(scene_with(walls=walls, boxes=boxes, raster_phase=0.0))
    # The room is 3.9 x 2.9 m inside its walls; the box takes 10 x 4 cells of it.
    assert (grid.cells == FREE).sum() == 78 * 58 - 10 * 4
    assert (grid.cells == OCCUPIED).sum() == 82 * 62 - 78 * 58 + 10 * 4
    assert cell(grid, 2.24, 2.09) == OCCUPIED
    assert cell(grid, 2.26, 2.09) == FREE
    assert cell(grid, 2.24, 2.11) == FREE
    assert cell(grid, -0.3, 1.0) == UNKNOWN


def test_faces_lie_in_the_middle_of_cells_unless_asked_otherwise():
    grid = map_of(scene_with(walls=[{'points': ROOM, 'closed': True}]))
    # The outer face at -0.05 is in the middle of a cell of 0.05: its border is at -0.075.
    offset = (-0.075 - np.array(grid.origin_xy_m)) / 0.05
    np.testing.assert_allclose(offset, np.round(offset), atol=1e-6)
    # Inner faces at 0.05 and 3.95 leave the cells with their middles from 0.1 to 3.9 free.
    row = grid.cells[int((1.5 - grid.origin_xy_m[1]) / 0.05)]
    free = grid.origin_xy_m[0] + (np.flatnonzero(row == FREE) + 0.5) * 0.05
    np.testing.assert_allclose([free[0], free[-1], len(free)], [0.1, 3.9, 77])


def test_true_map_knows_heights():
    walls = [{'points': ROOM, 'closed': True}]
    boxes = [
        {'at': [1.0, 2.0], 'size': [0.4, 0.4, 0.2], 'bottom_m': 1.1},
        {'at': [2.0, 2.0], 'size': [0.4, 0.4, 0.2], 'bottom_m': 0.9},
        {'at': [3.0, 2.0], 'size': [0.4, 0.4, 0.05]},
        {'at': [3.0, 1.0], 'size': [0.4, 0.4, 0.02]},
    ]
    grid = map_of(scene_with(walls=walls, boxes=boxes, robot_height_m=1.0, step_height_m=0.03))
    seen = [cell(grid, x, y) for x, y in ((1, 2), (2, 2), (3, 2), (3, 1))]
    assert seen == [FREE, OCCUPIED, OCCUPIED, FREE]


def test_slopes_are_floor_and_lift_what_stands_in_the_way():
    slopes = [{'start': [1, 1.5, 0], 'end': [3, 1.5, 0.4], 'width_m': 1.0}]
    low = [
        {'at': [2.0, 1.5], 'size': [0.2, 0.2, 0.15]},
        {'at': [1.2, 1.5], 'size': [0.2, 0.2, 0.15]},
    ]
    scene = scene_with(walls=[{'points': ROOM, 'closed': True}], slopes=slopes, boxes=low)
    heights = floor_height_m(floors(scene), np.array([[1, 1.5], [2, 1.6], [3, 1.5], [3.2, 1.5]]))
    np.testing.assert_allclose(heights, [0.0, 0.2, 0.4, 0.0], atol=1e-9)
    grid = map_of(scene)
    # The first block lies below the ramp's surface there, the second sticks out of it.
    assert cell(grid, 2.0, 1.5) == FREE
    assert cell(grid, 1.2, 1.5) == OCCUPIED


def test_posters_do_not_stand_in_the_way():
    walls = {'points': ROOM, 'closed': True}
    bare, hung = (map_of(scene_with(walls=[{**walls, 'posters': n}])) for n in (0, 20))
    np.testing.assert_array_equal(bare.cells, hung.cells)


def test_start_on_an_obstacle_is_refused():
    with pytest.raises(InputError, match='starts on an obstacle'):
        map_of(scene_with(boxes=[{'at': [0.5, 0.5], 'size': [1, 1, 1]}]))


def test_rectangles_cover_exactly_what_is_occupied():
    mask = np.random.default_rng(0).uniform(size=(40, 31)) < 0.6
    mask[5:20, 8:14] = True
    drawn = np.zeros(mask.shape, int)
    for bottom, top, left, right in merged_rectangles(mask):
        drawn[bottom:top, left:right] += 1
    np.testing.assert_array_equal(drawn, mask.astype(int))
    whole = merged_rectangles(np.ones((4, 7), bool))
    np.testing.assert_array_equal(whole, [[0, 4, 0, 7]])


def assert_same_walls(file):
    scene = open_scene(str(file))
    plan, grid = load_map(file), map_of(scene)
    shift = np.round((np.array(plan.origin_xy_m) - grid.origin_xy_m) / grid.resolution_m).astype(
        int
    )
    expected = {tuple(c) for c in np.argwhere(plan.cells == OCCUPIED) + shift[::-1]}
    assert {tuple(c) for c in np.argwhere(grid.cells == OCCUPIED)} == expected


def test_a_drawn_floor_plan_becomes_the_same_map_again(tmp_path):
    cells = np.zeros((70, 110), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = OCCUPIED
    cells[30:45, 20:28] = cells[10:12, 60:] = OCCUPIED
    save_map(OccupancyGrid(cells, 0.05, (-1.5, 0.75)), tmp_path / 'plan.yaml')
    assert_same_walls(tmp_path / 'plan.yaml')


@pytest.mark.slow
@pytest.mark.parametrize('name', ['depot', 'house_map'])
def test_floor_plan_becomes_the_same_map_again(shared_data, name):
    assert_same_walls(shared_data / 'maps' / f'{name}.yaml')


def test_tour_keeps_clear_of_walls_and_comes_back():
    free = np.zeros((120, 200), bool)
    free[10:110, 10:190] = True
    free[40:80, 60:140] = False
    cells = np.where(free, FREE, OCCUPIED).astype(np.int8)
    tour = plan_tour(OccupancyGrid(cells, 0.05, (-1.0, 2.0)))
    np.testing.assert_allclose(tour[0], tour[-1])
    blocked = np.argwhere(~free)[:, ::-1] * 0.05 + 0.025 + np.array([-1.0, 2.0])
    for start, end in pairwise(tour):
        line = np.linspace(start, end, 40)
        gaps = np.linalg.norm(blocked[None] - line[:, None], axis=2)
        assert gaps.min() > PLAN.clearance_m - 0.1
    # All around the block in the middle, from the widest of the places on.
    assert np.ptp(tour, axis=0).min() > 2.0
    stride = round(PLAN.cell_m / 0.05)
    room_m = OccupancyGrid(cells, 0.05, (-1.0, 2.0)).away_m(~free)
    widest_m = room_m[stride // 2 :: stride, stride // 2 :: stride].max()
    assert np.linalg.norm(blocked - tour[0], axis=1).min() == pytest.approx(widest_m)
    with pytest.raises(InputError, match='no place'):
        plan_tour(OccupancyGrid(np.full((20, 20), OCCUPIED, np.int8), 0.05, (0.0, 0.0)))


def test_people_walk_to_and_fro():
    person = Person(points=((0.0, 0.0), (2.0, 0.0), (2.0, 1.0)), speed_m_s=0.5, start_s=1.0)
    expected = {0: (0, 0, 0), 3: (1, 0, 0), 6: (2, 0.5, 90), 8: (2, 0.5, -90), 12: (0.5, 0, 180)}
    for time_s, (x, y, yaw_deg) in expected.items():
        T_world_torso = part_poses(person, time_s)[0]
        np.testing.assert_allclose(T_world_torso[:2, 3], (x, y), atol=1e-9)
        forward = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
        np.testing.assert_allclose(T_world_torso[:2, 0], forward, atol=1e-9)


def test_people_without_return_stay_at_the_end_and_move_only_on_their_way():
    person = Person(points=((0.0, 0.0), (1.0, 0.0)), speed_m_s=0.5, start_s=4.0, returns=False)
    np.testing.assert_allclose(part_poses(person, 60.0)[0, :2, 3], (1, 0))
    assert [is_moving(person, t) for t in (1.0, 4.1, 5.0, 7.0)] == [False, True, True, False]


def test_a_door_slides_shut_stays_and_opens_again_without_turning_round():
    door = MovingBox(((1.0, 0.0), (1.0, 2.0)), speed_m_s=0.5, start_s=3.0, stays_s=10.0)
    way = {2.0: 0, 5.0: 1, 7.0: 2, 16.9: 2, 19.0: 1, 21.0: 0, 30.9: 0, 33.0: 1, 40.0: 2}
    for time_s, y in way.items():
        T_world_door = part_poses(door, time_s)[0]
        np.testing.assert_allclose(T_world_door[:2, 3], (1, y), atol=1e-9)
        np.testing.assert_allclose(T_world_door[:2, 0], (0, 1), atol=1e-9)
    assert [is_moving(door, t) for t in (2.0, 5.0, 12.0, 19.0, 25.0)] == [0, 1, 0, 1, 0]


def test_a_foot_of_someone_who_walks_stays_on_the_floor_and_does_not_slide():
    person = Person(points=((0.0, 0.0), (20.0, 0.0)), speed_m_s=1.0)
    times = np.arange(3.0, 6.0, 0.02)
    poses = np.array([part_poses(person, t)[[2, 6]] for t in times])
    ankles = (poses @ [0, 0, -0.42, 1])[..., :3]
    np.testing.assert_allclose(ankles[..., 2].min(axis=1), 0.02, atol=0.03)
    slide = np.diff(ankles[..., 0], axis=0).min(axis=1)
    # At any time one of them is at rest while the body moves by 2 cm.
    assert np.median(slide) < 0.005 and slide.max() < 0.02
