"""The benchmark: its data against geometry, its sums by hand, the command for real."""

import json
import multiprocessing
import os

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from segfloor_ros.apps.evaluation.maps import sample_states
from segfloor_ros.apps.profiling import ReferenceWorkload
from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.errors import MapError, SegfloorError, SettingsError
from segfloor_ros.core.geometry import invert, transform_points
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.nodes.configuration import resolve
from tools.benchmark_stages import (
    CAMERA,
    MOUNT,
    BenchmarkPlan,
    Corridor,
    CorridorImages,
    MeasuredStages,
    UpdateTimes,
    floor_mask,
    main,
    measure_map,
    run_in_process,
)

CONFIGURATION = resolve()
CHAIN_FRAMES = 12

app = typer.Typer()
app.command()(main)


def pixel_of(point_base):
    """Return row and column of a point of the base frame in the left image."""
    in_left = transform_points(invert(MOUNT.T_base_left), np.array([point_base], float))
    u, v, _ = np.rint(CAMERA.project(in_left)[0]).astype(int)
    return v, u


# The corridor without images


def test_the_floor_mask_of_the_corridor():
    mask = floor_mask()
    for point, wanted in [
        ((2.0, 0.0, 0.0), FLOOR),
        ((3.0, 1.4, 0.0), FLOOR),
        ((3.0, -1.6, 0.0), NOT_FLOOR),  # behind the wall
        ((5.0, 1.5, 0.4), NOT_FLOOR),  # on the wall
        ((10.0, 0.0, 0.0), NO_EVIDENCE),  # too far
    ]:
        assert mask[pixel_of(point)] == wanted, point


def test_keyframes_see_points_where_the_camera_would():
    mask = floor_mask()
    keyframes = list(Corridor(4, seed=1).drive())
    assert [len(k.path.stamp_ns) for k in keyframes] == [1, 2, 3, 4]
    sizes = [len(k.cloud.point_id) for k in keyframes]
    assert sizes == sorted(set(sizes))
    for k in keyframes:
        assert k.stamp_ns == k.path.stamp_ns[-1]
        np.testing.assert_array_equal(k.cloud.xyz_map[k.features.point_id], k.features.xyz_map)
        T_left_map = invert(k.path.T_map_base[-1] @ MOUNT.T_base_left)
        in_left = transform_points(T_left_map, k.features.xyz_map.astype(float))
        np.testing.assert_allclose(CAMERA.project(in_left)[:, :2], k.features.uv_px, atol=0.01)
        column, row = np.rint(k.features.uv_px).astype(int).T
        high = k.features.xyz_map[:, 2] > 0.05
        assert not (mask[row, column] == FLOOR)[high].any()
        assert (mask[row, column] == FLOOR)[~high].mean() > 0.9


def test_the_scan_ends_at_the_walls():
    scan = next(iter(Corridor(1, seed=0).drive())).scan
    ahead, aside = (int(np.argmin(abs(scan.bearings_rad - b))) for b in (0.0, np.pi / 4 - 0.01))
    assert scan.ranges_m[ahead] == 6.0
    assert np.isnan(scan.obstacle_m[ahead])
    assert scan.ranges_m[aside] == pytest.approx(1.5 / np.sin(scan.bearings_rad[aside]), abs=0.05)
    assert scan.obstacle_m[aside] == scan.ranges_m[aside]


def test_the_map_turns_to_and_fro_as_after_loop_closings():
    keyframes = list(Corridor(201, seed=0).drive())
    headings = [np.arctan2(*k.path.T_map_base[0, [1, 0], 0]) for k in keyframes]
    np.testing.assert_allclose(headings[:100], 0.0)
    np.testing.assert_allclose(headings[100:200], 0.002)
    assert headings[200] == 0.0
    assert keyframes[150].path.T_map_base[-1, 1, 3] == pytest.approx(150 * 0.25 * 0.002, rel=1e-3)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_data():
    def data(seed):
        keyframe = list(Corridor(3, seed).drive())[-1]
        frame = list(CorridorImages(2, seed).drive())[-1]
        parts = (keyframe.cloud.xyz_map, keyframe.scan.ranges_m, frame.left, frame.right)
        return [part.tobytes() for part in parts]

    assert data(3) == data(3)
    assert all(a != b for a, b in zip(data(3), data(4), strict=True))


# The images


def test_the_floor_in_the_images_has_the_disparity_of_the_floor():
    frame = list(CorridorImages(2, seed=0).drive())[-1]
    v, u = np.indices(frame.left.shape, dtype=np.float64)
    rays = CAMERA.back_project(np.stack([u.ravel(), v.ravel()], 1), np.ones(u.size))
    down = -(rays @ MOUNT.up_in_camera).reshape(u.shape)
    disparity = CAMERA.disparity_times_depth / MOUNT.height_m * down
    at_right = (u - disparity).astype(np.float32)
    expected = cv2.remap(frame.right, at_right, v.astype(np.float32), cv2.INTER_LINEAR)
    floor = (floor_mask() == FLOOR) & (at_right > 0)
    difference = np.abs(expected.astype(float) - frame.left)[floor]
    assert difference.mean() < 3.0  # the noise of two images
    assert np.abs(frame.right.astype(float) - frame.left)[floor].mean() > 10.0


@pytest.mark.slow
def test_the_chain_makes_the_map_of_the_pipeline():
    chain = MeasuredStages(CAMERA, CONFIGURATION, MOUNT)
    settings = {'camera_height_m': 0.3, 'camera_pitch_rad': 0.12, 'camera_roll_rad': 0.0}
    pipeline = make_pipeline(CAMERA, resolve(stereo_slam=settings))
    for frame in CorridorImages(CHAIN_FRAMES, seed=0).drive():
        chain.process(frame)
        pipeline.process(frame)
    grid = pipeline.finish()
    np.testing.assert_array_equal(chain.grid.cells, grid.cells)
    assert chain.grid.origin_xy_m == grid.origin_xy_m
    workload = chain.workload('here')
    assert (workload.items, workload.tracked) == (CHAIN_FRAMES, CHAIN_FRAMES)
    assert workload.map_updates == pipeline.keyframe_stages.map_updates
    assert workload.points == len(pipeline.keyframe_stages.labelled.point_id)
    # The corridor is 3 m wide.
    places = np.array([[2.0, 0.0], [2.5, 1.2], [2.5, -1.2]])
    assert sample_states(grid, places).tolist() == [FREE] * 3
    x, y = np.meshgrid(np.arange(2.2, 2.8, 0.05), [1.45, 1.5, 1.55])
    for side in (1, -1):
        wall = sample_states(grid, np.stack([x.ravel(), side * y.ravel()], 1))
        assert (wall.reshape(x.shape) == OCCUPIED).any(axis=0).mean() > 0.5


# Times


def test_an_update_is_what_is_done_once_per_keyframe():
    times = UpdateTimes()
    for name, seconds in [
        ('tracking', 1.0),
        ('mapping', 0.5),
        ('tracking', 1.0),
        ('mapping', 0.7),  # the first keyframe is still held back
        ('floor_segmentation', 0.1),
        ('occupancy_grid', 0.2),
    ]:
        times.add(name, seconds)
    times.end_update()
    times.add('floor_segmentation', 0.3)
    times.end_update()
    assert times.update_s == pytest.approx([0.8, 1.0])
    assert times.total_s == pytest.approx(3.8)
    assert times.per_update() == pytest.approx({'mean': 0.9, 'p50': 0.9, 'p95': 0.99, 'max': 1.0})
    assert times.summary()['mapping']['count'] == 2


def test_the_reference_is_always_the_same_work():
    reference = ReferenceWorkload()
    features, disparity_px = reference.run()
    assert (features, disparity_px) == ReferenceWorkload().run()
    assert features >= 1900  # of 2000
    assert disparity_px == 24.0  # the shift between the two images
    reference.time()
    assert reference.median_ms > 0


def test_map_stages_alone():
    done = []
    workload = measure_map(BenchmarkPlan(), 30, CONFIGURATION, done.append)
    assert done == list(range(1, 31))
    assert workload.map_updates == workload.items == 30
    assert set(workload.stages) == {'cloud_labelling', 'occupancy_grid', 'map'}
    # Known: a strip 3 m wide, 30 strides of 0.25 m and some of what lies ahead.
    assert workload.cells * 0.05**2 > 3 * 30 * 0.25
    assert workload.points == pytest.approx(400 * (29 * 0.25 + 6), rel=0.05)


# Processes


def half(number, on_progress):
    on_progress(1)
    on_progress(2)
    if number == 0:
        os._exit(3)
    if number < 0:
        raise MapError(f'{number}: negative')
    return number / 2, os.getpid()


@pytest.mark.slow
def test_work_in_a_process():
    done = []
    value, process = run_in_process(half, 3, on_progress=done.append)
    assert value == 1.5
    assert process != os.getpid()
    assert done == [1, 2]
    with pytest.raises(MapError, match='-1: negative'):
        run_in_process(half, -1, on_progress=done.append)
    with pytest.raises(SegfloorError, match='status 3'):
        run_in_process(half, 0, on_progress=done.append)
    assert multiprocessing.active_children() == []


# The command


def run(*arguments, fails=False):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if fails:
        raise result.exception
    assert result.exit_code == 0, (result.output, result.exception)
    return result.output


@pytest.mark.slow
def test_benchmark_prints_json_in_place_of_tables():
    document = json.loads(run('--sizes', '5,20', '--frames', '8', '--seed', '2', '--json'))
    assert document['version'] == 1
    assert document['plan'] == {'sizes': [5, 20], 'frames': 8, 'seed': 2, 'threads': 1}
    assert set(document['machine']) == {'system', 'processor', 'python', 'numpy', 'opencv'}
    images, few, more = document['workloads']
    assert [w['name'] for w in (images, few, more)] == ['images', '5 keyframes', '20 keyframes']
    assert [w['items'] for w in (images, few, more)] == [8, 5, 20]
    assert images['tracked'] == images['stages']['tracking']['count'] == 8
    assert list(images['stages']) == [
        'tracking',
        'moving',
        'mapping',
        'floor_segmentation',
        'cloud_labelling',
        'occupancy_grid',
        'map',
    ]
    assert 1 < images['map_updates'] < 8
    assert more['points'] > few['points']
    assert more['cells'] >= few['cells']
    for workload in (images, few, more):
        for name, stage in workload['stages'].items():
            assert stage['p50_ms'] <= stage['p95_ms'] <= stage['max_ms']
            ratio = stage['p50_ms'] / workload['reference_ms']
            assert stage['p50_ratio'] == pytest.approx(ratio, abs=1e-3)
            if name not in ('tracking', 'moving'):
                assert stage['count'] == workload['map_updates']
        update_s = workload['update_s']
        assert update_s['p50'] <= update_s['p95'] <= update_s['max']
        assert {'start', 'peak', 'slope_per_update'} <= set(workload['memory_mb'])
        assert workload['memory_mb']['peak'] >= workload['memory_mb']['start'] > 0


@pytest.mark.slow
def test_benchmark_prints_tables():
    output = run('--sizes', '3,5', '--frames', '3')
    for words in ('3 keyframes', '5 keyframes', 'floor_segmentation', 'reference', 'MB/update'):
        assert words in output


@pytest.mark.parametrize('sizes', ['10,many', '', '10,0'])
def test_bad_sizes(sizes):
    with pytest.raises(SettingsError, match=r'--sizes .*expected numbers'):
        run('--sizes', sizes, fails=True)
