"""The map follows the keyframes; its raster, settings and limits."""

from collections.abc import Callable

import numpy as np
import pytest
from conftest import Drive, World, cells_at, centres, no_points, path_of

from segfloor_ros.core.contracts import FloorScan, KeyframeFeatures, KeyframePath
from segfloor_ros.core.errors import MapError
from segfloor_ros.core.grid import mapper as history
from segfloor_ros.core.grid.mapper import OccupancyGridMapper
from segfloor_ros.core.grid.occupancy import (
    ZERO,
    LogOddsRaster,
    OccupancyGrid,
    OccupancyGridSettings,
    render,
)

MakeDrive = Callable[..., Drive]
ROOM = World(discs=((1.5, 0.6, 0.2),), walls=((3, -2, 3, 2), (-1, 1.2, 3, 1.2), (-1, -2, 3, -2)))
NO_FEATURES = KeyframeFeatures(
    np.zeros((0, 2), np.float32), np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
)


def same(first: OccupancyGrid, second: OccupancyGrid) -> bool:
    return (
        first.origin_xy_m == second.origin_xy_m
        and first.resolution_m == second.resolution_m
        and np.array_equal(first.cells, second.cells)
    )


class Recording:
    """A drive's scans, to be fed with other paths."""

    def __init__(self, count: int) -> None:
        drive = Drive(OccupancyGridMapper(OccupancyGridSettings()))
        self.poses = [(0.03 * k, 0.1 * np.sin(k / 9), 0.3 * np.sin(k / 5)) for k in range(count)]
        self.scans = [drive.scan(ROOM, pose) for pose in self.poses]
        self.stamps = path_of(self.poses).stamp_ns

    def feed(self, mapper: OccupancyGridMapper, k: int, path: KeyframePath) -> None:
        mapper.update(int(self.stamps[k]), no_points(), NO_FEATURES, path, self.scans[k])

    def built_at_once(self, poses: list[tuple[float, float, float]]) -> OccupancyGrid:
        mapper = OccupancyGridMapper(OccupancyGridSettings())
        for k in range(len(poses)):
            self.feed(mapper, k, path_of(poses[: k + 1]))
        return mapper.grid()


def test_the_same_map_however_often_it_is_asked_for() -> None:
    recording = Recording(50)
    mapper = OccupancyGridMapper(OccupancyGridSettings())
    for k in range(50):
        recording.feed(mapper, k, path_of(recording.poses[: k + 1]))
        asked = mapper.grid()
    assert same(asked, recording.built_at_once(recording.poses))


@pytest.mark.parametrize('moved', [[49], [33, 40], [17], [0], list(range(60))])
@pytest.mark.parametrize('undo_bytes', [200_000, history.UNDO_BYTES])
def test_after_moves_the_map_equals_one_built_from_scratch(
    monkeypatch: pytest.MonkeyPatch, moved: list[int], undo_bytes: int
) -> None:
    monkeypatch.setattr(history, 'UNDO_BYTES', undo_bytes)
    recording = Recording(60)
    mapper = OccupancyGridMapper(OccupancyGridSettings())
    for k in range(59):
        recording.feed(mapper, k, path_of(recording.poses[: k + 1]))
        mapper.grid()
    poses = list(recording.poses)
    for k in moved:
        x, y, yaw = poses[k]
        poses[k] = (x + 0.08, y - 0.05, yaw + 0.05)
    recording.feed(mapper, 59, path_of(poses))
    assert same(mapper.grid(), recording.built_at_once(poses))


def test_moves_within_a_fraction_of_a_cell_change_nothing() -> None:
    recording = Recording(20)
    mapper = OccupancyGridMapper(OccupancyGridSettings())
    for k in range(19):
        recording.feed(mapper, k, path_of(recording.poses[: k + 1]))
    mapper.grid()
    poses = [(x + 0.006, y, yaw) for x, y, yaw in recording.poses]
    recording.feed(mapper, 19, path_of(poses))
    expected = [*recording.poses[:19], poses[19]]
    assert same(mapper.grid(), recording.built_at_once(expected))


def test_evidence_follows_a_turn_on_the_spot() -> None:
    recording = Recording(20)
    mapper = OccupancyGridMapper(OccupancyGridSettings())
    for k in range(19):
        recording.feed(mapper, k, path_of(recording.poses[: k + 1]))
    poses = [(x, y, yaw + 0.1) for x, y, yaw in recording.poses]
    recording.feed(mapper, 19, path_of(poses))
    assert same(mapper.grid(), recording.built_at_once(poses))
    assert not same(mapper.grid(), recording.built_at_once(recording.poses))


def test_evidence_that_waited_comes_back_to_its_own_keyframes() -> None:
    """A drive in another map, until the first one is recognised and its keyframes are back."""
    recording = Recording(20)
    whole, mapper = path_of(recording.poses), OccupancyGridMapper(OccupancyGridSettings())
    for k in range(10):
        recording.feed(mapper, k, path_of(recording.poses[: k + 1]))
    for k in range(10, 19):
        own = KeyframePath(whole.stamp_ns[10 : k + 1], whole.T_map_base[10 : k + 1])
        recording.feed(mapper, k, own)
        assert len(mapper.to_arrays()['stamp_ns']) == k - 9
    recording.feed(mapper, 19, whole)
    np.testing.assert_array_equal(mapper.to_arrays()['stamp_ns'], whole.stamp_ns)
    assert same(mapper.grid(), recording.built_at_once(recording.poses))


def test_evidence_of_removed_keyframes_goes_with_them() -> None:
    recording = Recording(20)
    mapper = OccupancyGridMapper(OccupancyGridSettings())
    for k in range(19):
        recording.feed(mapper, k, path_of(recording.poses[: k + 1]))
    mapper.grid()
    whole = path_of(recording.poses)
    kept = np.ones(20, bool)
    kept[[3, 4, 11]] = False
    recording.feed(mapper, 19, KeyframePath(whole.stamp_ns[kept], whole.T_map_base[kept]))

    fresh = OccupancyGridMapper(OccupancyGridSettings())
    for k in np.flatnonzero(kept):
        recording.feed(fresh, int(k), whole)
    assert same(mapper.grid(), fresh.grid())


def test_the_raster_never_shifts(make_drive: MakeDrive) -> None:
    drive = make_drive(OccupancyGridSettings(resolution_m=0.04))
    earlier: list[OccupancyGrid] = []
    for k in range(6):
        drive.look(World(), (1.3 * (-1) ** k * k, 0.7 * k, 2.1 * k))
        earlier.append(drive.grid())
    grid = earlier[-1]
    cells = np.array([g.origin_xy_m for g in earlier]) / 0.04
    np.testing.assert_allclose(cells, np.rint(cells), atol=1e-6)
    assert grid.cells.shape != earlier[0].cells.shape
    first = earlier[0]
    rows, columns = np.nonzero(first.cells == 0)
    xy = np.array(first.origin_xy_m) + (np.stack([columns, rows], 1) + 0.5) * 0.04
    assert (cells_at(grid, xy) == 0).all()


@pytest.mark.parametrize('resolution_m', [0.01, 0.05, 0.2])
def test_resolutions(make_drive: MakeDrive, resolution_m: float) -> None:
    drive = make_drive(OccupancyGridSettings(resolution_m=resolution_m))
    for k in range(6):
        drive.look(ROOM, (0.05 * k, 0.0, 0.0))
    grid = drive.grid()
    assert grid.resolution_m == resolution_m
    assert (cells_at(grid, np.array([[1.0, 0.0], [2.5, -0.5]])) == 0).all()
    wall = np.stack([np.linspace(2.98, 3.03, 20), np.full(20, -0.3)], axis=1)
    assert (cells_at(grid, wall) == 100).any()


def test_free_cells_that_nothing_joins_to_the_path_are_unknown() -> None:
    raster = LogOddsRaster()
    cells = raster.patch((0, 0), (10, 30))
    cells[2:8, 2:10] = cells[2:8, 15:25] = ZERO - 40
    here, there = centres((0.1, 0.5), (0.1, 0.4)), centres((0.75, 1.25), (0.1, 0.4))
    alone = render(raster, np.array([[0.3, 0.25]]), OccupancyGridSettings())
    assert (cells_at(alone, here) == 0).all()
    assert (cells_at(alone, there) == -1).all()
    both = render(raster, np.array([[0.3, 0.25], [1.0, 0.25]]), OccupancyGridSettings())
    assert (cells_at(both, here) == 0).all()
    assert (cells_at(both, there) == 0).all()


def test_probabilities() -> None:
    recording = Recording(12)
    trinary, soft = (
        OccupancyGridMapper(OccupancyGridSettings(probabilistic=p)) for p in (False, True)
    )
    for k in range(12):
        path = path_of(recording.poses[: k + 1])
        recording.feed(trinary, k, path)
        recording.feed(soft, k, path)
    plain, graded = trinary.grid().cells, soft.grid().cells
    assert ((plain == -1) == (graded == -1)).all()
    # Log-odds -2 and 1.95 are the limits: 1 / (1 + e^2) = 12 % and 1 / (1 + e^-1.95) = 88 %.
    assert graded[plain == 0].min() == 12
    assert graded[plain == 100].max() == 88
    assert graded[plain == 0].max() < 50 < graded[plain == 100].min()


def test_a_keyframe_must_be_in_its_path() -> None:
    mapper = OccupancyGridMapper(OccupancyGridSettings())
    scan = FloorScan(0.0, 0.01, np.zeros(3, np.float32))
    with pytest.raises(MapError, match='keyframe 5 ns'):
        mapper.update(5, no_points(), NO_FEATURES, path_of([(0.0, 0.0, 0.0)]), scan)


def test_a_keyframe_that_saw_nothing() -> None:
    mapper = OccupancyGridMapper(OccupancyGridSettings(footprint_radius_m=0.0))
    nothing = FloorScan(0.0, 0.01, np.full(5, np.nan, np.float32), np.full(5, np.nan, np.float32))
    mapper.update(0, no_points(), NO_FEATURES, path_of([(0.0, 0.0, 0.0)]), nothing)
    assert (mapper.grid().cells == -1).all()


def test_memory_of_a_keyframe_is_small() -> None:
    recording = Recording(1)
    mapper = OccupancyGridMapper(OccupancyGridSettings())
    recording.feed(mapper, 0, path_of(recording.poses))
    evidence = mapper._history.evidence[0]
    assert evidence.fan_m.nbytes + evidence.positions_m.nbytes < 3000
