"""Map scores on grids small enough to work out by hand."""

import cv2
import numpy as np
import pytest

from segfloor_ros.apps.evaluation.map_score import (
    COLOURS,
    RoadMapPlan,
    candidate_edges,
    compare,
    draw_overlay,
    edges_are_free,
    opened,
    overlay_png,
    sample_nodes,
    score_cells,
    score_map,
    score_road_maps,
)
from segfloor_ros.apps.evaluation.maps import MapTruth, find_alignment, observable, resample
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.grid.occupancy import OccupancyGrid

FEW = RoadMapPlan(nodes=20, repetitions=5)


def grid_of(rows_from_top: list[str], resolution_m=0.1, origin=(0.0, 0.0)) -> OccupancyGrid:
    """Return the grid drawn with `.` free, `#` occupied, ` ` unknown; the top line is highest y."""
    values = {'.': 0, '#': 100, ' ': -1}
    cells = [[values[letter] for letter in row] for row in rows_from_top[::-1]]
    return OccupancyGrid(np.array(cells, np.int8), resolution_m, origin)


def room(width: int, height: int) -> list[str]:
    return ['#' * (width + 2), *['#' + '.' * width + '#'] * height, '#' * (width + 2)]


def shifted_right(grid: OccupancyGrid, cells: int) -> OccupancyGrid:
    x, y = grid.origin_xy_m
    return OccupancyGrid(grid.cells, grid.resolution_m, (x + cells * grid.resolution_m, y))


def test_perfect_map_scores_full_marks():
    grid = grid_of(room(12, 9))
    score = score_map(grid, MapTruth(grid), plan=FEW)
    assert (score.raw.precision.mean, score.raw.recall.mean) == (1.0, 1.0)
    assert (score.opened.precision.mean, score.opened.recall.mean) == (1.0, 1.0)
    assert score.raw.recall.std == 0.0
    assert score.cells.free_precision == score.cells.free_recall == 1.0
    assert score.cells.occupied_precision == score.cells.occupied_recall == 1.0
    assert score.area_m2 == pytest.approx(12 * 9 * 0.01)
    assert not score.observable_only


def test_empty_map_scores_nothing():
    grid = grid_of(room(12, 9))
    empty = OccupancyGrid(np.full_like(grid.cells, -1), 0.1, (0.0, 0.0))
    score = score_map(empty, MapTruth(grid), plan=FEW)
    assert (score.raw.precision.mean, score.raw.recall.mean) == (0.0, 0.0)
    assert score.cells.free_precision == score.cells.free_recall == 0.0
    assert score.cells.occupied_recall == 0.0


def test_map_shifted_by_one_cell():
    grid = grid_of([row + ' ' for row in room(10, 10)])
    maps = compare(shifted_right(grid, 1), MapTruth(grid), (0.0, 0.0, 0.0))
    cells = score_cells(maps, tolerance_m=0.0)
    # 9 of 10 free columns coincide; the tenth lies on the right wall.
    assert cells.free_precision == cells.free_recall == pytest.approx(0.9)
    # Of the 44 wall cells 22 stay covered: 11 above and 11 below.
    assert cells.occupied_precision == cells.occupied_recall == pytest.approx(22 / 44)
    # With one cell of tolerance every wall is found again.
    tolerant = score_cells(maps, tolerance_m=0.1)
    assert tolerant.occupied_precision == tolerant.occupied_recall == 1.0


def test_false_corridor_costs_precision_not_recall():
    walls = ['#' * 27, *['#' + '.' * 10 + '#' * 5 + '.' * 10 + '#'] * 10, '#' * 27]
    opened_up = list(walls)
    for row in (5, 6, 7):
        opened_up[row] = '#' + '.' * 25 + '#'
    truth, estimate = grid_of(walls), grid_of(opened_up)
    score = score_map(estimate, MapTruth(truth), plan=FEW)
    assert score.cells.free_precision == pytest.approx(200 / 215)
    assert score.cells.free_recall == 1.0
    assert score.raw.recall.mean == 1.0
    assert 0.5 < score.raw.precision.mean < 1.0
    assert 0.5 < score.opened.precision.mean < 1.0


def test_opening_removes_a_lone_ray():
    truth = room(10, 10)
    with_ray = list(truth)
    with_ray[5] = '#' + '.' * 10 + '.'
    padded = [row + ' ' * 9 for row in with_ray]
    padded[5] = '.' * 21
    estimate = grid_of(padded)
    truth_grid = grid_of([row + ' ' * 9 for row in truth])
    free = estimate.cells == 0
    assert opened(free).sum() == 100
    score = score_map(estimate, MapTruth(truth_grid), plan=FEW)
    assert score.raw.precision.mean < 1.0
    assert score.opened.precision.mean == 1.0


def test_same_seed_same_score_other_seed_other_nodes():
    free = np.ones((30, 30), bool)
    holes = free.copy()
    holes[10:14, 10:14] = False
    scores = [
        score_road_maps(holes, free, free, 0.1, RoadMapPlan(20, repetitions=4, seed=seed))
        for seed in (1, 1, 2)
    ]
    assert scores[0] == scores[1] != scores[2]


def test_nodes_keep_their_distance_and_lie_on_free_cells():
    free = np.zeros((40, 25), bool)
    free[3:30, 2:20] = True
    nodes = sample_nodes(free, 30, 3.0, np.random.default_rng(0))
    assert len(nodes) == 30
    assert free[nodes[:, 0], nodes[:, 1]].all()
    gaps = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)[~np.eye(30, dtype=bool)]
    assert gaps.min() >= 3.0


def test_a_single_cell_gives_a_single_node():
    free = np.zeros((4, 6), bool)
    free[2, 5] = True
    np.testing.assert_array_equal(sample_nodes(free, 5, 2.0, np.random.default_rng(0)), [[2, 5]])
    assert len(sample_nodes(np.zeros((4, 6), bool), 5, 2.0, np.random.default_rng(0))) == 0


def test_edges_are_checked_along_the_whole_line():
    free = np.ones((5, 9), bool)
    free[:, 4] = False
    free[2, 4] = True
    starts = np.array([[0, 0], [2, 0], [1, 0], [0, 0]])
    ends = np.array([[0, 8], [2, 8], [3, 8], [4, 3]])
    # Through the wall; through the door; slanted through the door (row 2 at column 4); beside it.
    np.testing.assert_array_equal(edges_are_free(free, starts, ends), [False, True, True, True])


def test_edges_no_longer_than_allowed():
    starts, ends = candidate_edges(np.array([[0, 0], [0, 3], [4, 0]]), 4.0)
    pairs = {frozenset([tuple(a), tuple(b)]) for a, b in zip(starts, ends, strict=True)}
    assert pairs == {frozenset([(0, 0), (0, 3)]), frozenset([(0, 0), (4, 0)])}


def test_estimate_turned_by_a_quarter_lands_where_it_belongs():
    # The estimate's frame lies at (0.3, 0) in the truth, turned left: its x is the truth's y.
    estimate = grid_of(['.#.#.', '  .. ', '#.   '])
    truth = OccupancyGrid(np.zeros((5, 3), np.int8), 0.1, (0.0, 0.0))
    expected = np.array([[100, 0, -1, -1, -1], [-1, -1, 0, 0, -1], [0, 100, 0, 100, 0]])
    # Column c of the estimate becomes row c; its row r becomes column 2 - r.
    np.testing.assert_array_equal(
        resample(estimate, truth, (0.3, 0.0, np.pi / 2)), expected[::-1].T
    )


def test_only_what_is_in_sight_counts():
    truth = grid_of(
        ['#########', '#.......#', '#...#...#', '#...#...#', '#...#...#', '#########'],
        resolution_m=1.0,
    )
    # Low on the left, looking along +x with a narrow view: three cells, then the inner wall.
    floor, obstacles = observable(truth, np.array([[1.5, 1.5, 0.0]]), 0.1, 20.0)
    assert {tuple(cell) for cell in np.argwhere(floor)} == {(1, 1), (1, 2), (1, 3)}
    assert {tuple(cell) for cell in np.argwhere(obstacles)} == {(1, 4)}
    # Range ends sight: within 1.5 m the wall is not reached.
    floor, obstacles = observable(truth, np.array([[1.5, 1.5, 0.0]]), 0.1, 1.5)
    assert {tuple(cell) for cell in np.argwhere(floor)} == {(1, 1), (1, 2)}
    assert not obstacles.any()


def test_recall_counts_only_the_observable_floor():
    truth = grid_of(room(20, 8), resolution_m=0.1)
    half = truth.cells.copy()
    half[:, 11:] = -1
    estimate = OccupancyGrid(half, 0.1, (0.0, 0.0))
    drive = np.array([[1.05, 0.5, np.pi]])
    whole = score_map(estimate, MapTruth(truth), plan=FEW)
    assert whole.cells.free_recall == 0.5
    score = score_map(estimate, MapTruth(truth, base_poses=drive), plan=FEW)
    assert score.observable_only
    assert score.cells.free_recall == 1.0
    assert score.raw.recall.mean == 1.0 > whole.raw.recall.mean


@pytest.mark.parametrize('near', [None, (1.05, -0.6, 0.55)])
def test_alignment_is_found(near):
    walls = room(40, 25)
    for row in range(14, 26):
        walls[row] = '#' + '.' * 22 + '#' * 19
    walls[5] = '#' + '.' * 30 + '###' + '.' * 7 + '#'
    truth = grid_of(walls, resolution_m=0.1, origin=(-0.7, -1.2))
    pose = (1.2, -0.5, 0.5)
    # The estimate is the truth seen from its own frame, with unknown cells around it.
    around = OccupancyGrid(np.zeros((90, 90), np.int8), 0.05, (-2.0, -2.5))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    seen_from = (-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2])
    states = resample(truth, around, seen_from)
    cells = np.select([states == 0, states == 1], [0, 100], -1).astype(np.int8)
    found = find_alignment(OccupancyGrid(cells, 0.05, (-2.0, -2.5)), truth, near)
    assert np.hypot(found[0] - pose[0], found[1] - pose[1]) < 0.05
    assert abs(found[2] - pose[2]) < 0.02


def test_alignment_of_an_unknown_map_is_refused():
    truth = grid_of(room(5, 5))
    unknown = OccupancyGrid(np.full((5, 5), -1, np.int8), 0.1, (0.0, 0.0))
    with pytest.raises(InputError, match='no known cell'):
        find_alignment(unknown, truth)


def test_overlay_colours_each_class(tmp_path):
    truth = grid_of(['##.', '...'])
    estimate = grid_of(['#. ', '...'])
    maps = compare(estimate, MapTruth(truth), (0.0, 0.0, 0.0))
    picture = draw_overlay(maps)
    side = 1000 // 3
    corners = [
        [tuple(int(v) for v in picture[r * side, c * side]) for c in range(3)] for r in (0, 1)
    ]
    assert corners[0] == [
        COLOURS['occupied, agree'],
        COLOURS['free, but is not'],
        COLOURS['floor missed'],
    ]
    assert corners[1] == [COLOURS['free, agree']] * 3
    decoded = cv2.imdecode(np.frombuffer(overlay_png(maps), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(decoded, picture)
