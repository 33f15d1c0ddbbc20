"""Maps and trajectories as other programs write them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import segfloor
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.evaluation.trajectory import match_files, score_trajectory
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.trajectory import Trajectory, write_tum
from segfloor_ros.core.geometry import R_ROS_OPTICAL, make_transform


def drive(turns: bool = True, count: int = 120) -> np.ndarray:
    """Return the base (N, 4, 4) on a path of about 12 m, that winds or is straight."""
    yaw = 0.8 * np.sin(np.arange(count) / 15) if turns else np.zeros(count)
    steps = 0.1 * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(count)], axis=1)
    places = np.cumsum(steps, axis=0)
    rotations = Rotation.from_euler('z', yaw[:, None]).as_matrix()
    return np.array([make_transform(R, p) for R, p in zip(rotations, places, strict=True)])


def write(path: Path, poses: np.ndarray) -> Path:
    stamps = 10**9 + 100_000_000 * np.arange(len(poses))
    write_tum(path, Trajectory(stamps, poses))
    return path


def in_axes(poses: np.ndarray, R_base_other: np.ndarray) -> np.ndarray:
    """Return the path of other axes at the base, in the frame of their first pose."""
    turned = poses @ make_transform(R_base_other, np.zeros(3))
    return np.linalg.inv(turned[0]) @ turned


PITCHED = R_ROS_OPTICAL @ Rotation.from_euler('x', -20, degrees=True).as_matrix()


@pytest.mark.parametrize('turns', [True, False])
@pytest.mark.parametrize('axes', [R_ROS_OPTICAL, R_ROS_OPTICAL.T, PITCHED])
def test_other_axes_are_evaluated_in_those_of_the_truth(tmp_path, caplog, axes, turns) -> None:
    truth = write(tmp_path / 'truth.txt', drive(turns))
    estimate = write(tmp_path / 'estimate.txt', in_axes(drive(turns), axes))
    score = score_trajectory(match_files(estimate, truth))
    assert score.ate_rmse_m < 1e-6
    assert score.rpe_translation_m < 1e-6
    assert score.rpe_rotation_rad < 1e-6
    assert score.end_error_m < 1e-6
    (line,) = [r.getMessage() for r in caplog.records]
    angle = np.degrees(Rotation.from_matrix(axes).magnitude())
    assert f'turned by {angle:.0f} degrees' in line or not turns  # its roll is free


def test_a_path_that_drifts_is_no_path_in_other_axes(tmp_path, caplog) -> None:
    poses = drive()
    drift = Rotation.from_euler('z', np.linspace(0, 1.5, len(poses))[:, None]).as_matrix()
    drifting = poses.copy()
    drifting[:, :3, :3] = drift @ poses[:, :3, :3]
    drifting[:, :3, 3] = np.cumsum(
        np.einsum('nij,nj->ni', drift, np.diff(poses[:, :3, 3], axis=0, prepend=0)), axis=0
    )
    truth, estimate = write(tmp_path / 't.txt', poses), write(tmp_path / 'e.txt', drifting)
    score = score_trajectory(match_files(estimate, truth))
    assert score.rpe_rotation_rad > 0.05
    assert not caplog.records


def test_a_path_that_is_wrong_from_the_start_is_none_in_other_axes(tmp_path, caplog) -> None:
    """Turned by 59 degrees to the side, as no optical axes are: that is an error."""
    axes = Rotation.from_euler('z', 59, degrees=True).as_matrix()
    truth = write(tmp_path / 'truth.txt', drive())
    estimate = write(tmp_path / 'estimate.txt', in_axes(drive(), axes))
    assert score_trajectory(match_files(estimate, truth)).rpe_translation_m > 0.5
    assert not caplog.records


@pytest.mark.parametrize(('unit', 'name'), [(10**3, 'ms'), (10**6, 'µs'), (10**9, 'ns')])
@pytest.mark.parametrize('start_s', [0, 1_700_000_000])
@pytest.mark.parametrize('form', ['{}', '{:.18e}'])
def test_times_in_another_unit_are_recognised(tmp_path, caplog, unit, name, start_s, form) -> None:
    truth = write(tmp_path / 'truth.txt', drive())
    rows = [line.split() for line in truth.read_text().splitlines()]
    seconds = [start_s + i / 10 for i in range(len(rows))]
    truth.write_text(
        ''.join(f'{s:.9f} {" ".join(row[1:])}\n' for s, row in zip(seconds, rows, strict=True))
    )
    estimate = tmp_path / 'estimate.txt'
    whole = [start_s * unit + i * unit // 10 for i in range(len(rows))]
    lines = [f'{form.format(t)} {" ".join(row[1:])}\n' for t, row in zip(whole, rows, strict=True)]
    estimate.write_text(''.join(lines))
    matched = match_files(estimate, truth)
    assert len(matched.times_s) == len(rows)
    assert [r.getMessage() for r in caplog.records if f'are read as {name}' in r.getMessage()]


def write_map(path: Path, pixels: list[list[int]], **values: object) -> Path:
    known = {
        'image': 'map.pgm', 'mode': 'trinary', 'resolution': 0.05, 'origin': [0.0, 0.0, 0.0],
        'negate': 0, 'occupied_thresh': 0.65, 'free_thresh': 0.25,
    }  # fmt: skip
    path.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path / 'map.pgm'), np.array(pixels, np.uint8))
    lines = (f'{name}: {value}\n' for name, value in (known | values).items())
    (path / 'map.yaml').write_text(''.join(lines))
    return path / 'map.yaml'


@pytest.mark.parametrize(
    ('pixels', 'values', 'cells', 'is_said'),
    [
        ([[254, 205, 0]], {}, [[0, -1, 100]], True),
        ([[255, 205, 0]], {}, [[0, -1, 100]], True),
        ([[254, 205, 0]], {'free_thresh': 0.196}, [[0, -1, 100]], False),
        ([[254, 206, 0]], {}, [[0, 0, 100]], False),  # no saver's word for unknown
        ([[205, 205, 0]], {}, [[0, 0, 100]], False),  # nothing else is free
        ([[0, 50, 255]], {'negate': 1}, [[0, 0, 100]], False),
        ([[254, 205, 0]], {'mode': 'scale'}, [[0, 0, 100]], False),
        ([[0, 100, 255]], {'mode': 'raw'}, [[0, 100, -1]], False),
    ],
)
def test_what_a_saver_left_unknown_stays_so(
    tmp_path, caplog, pixels, values, cells, is_said
) -> None:
    grid = load_map(write_map(tmp_path, pixels, **values))
    np.testing.assert_array_equal(grid.cells, cells)
    assert bool(caplog.records) == is_said
    assert all('taken for unknown' in r.getMessage() for r in caplog.records)


def test_maps_of_map_server_are_taken_by_info_and_diff(tmp_path) -> None:
    first = write_map(tmp_path / 'a', [[254] * 20] * 10, free_thresh=0.196)
    changed = np.full((10, 20), 254)
    changed[4, 5:9] = 0
    second = write_map(tmp_path / 'b', changed.tolist(), free_thresh=0.196)
    said = segfloor('info', first)
    assert said.returncode == 0, said.stdout
    assert '1.0 x 0.5 m known, 0.5 m² free, 0.0 m² occupied' in said.stdout
    said = segfloor('map', 'info', second, '--json')
    assert '"occupied_m2": 0.01' in said.stdout and '"resolution_m": 0.05' in said.stdout
    said = segfloor('map', 'diff', first, second, tmp_path / 'd.png', '--json')
    assert said.returncode == 0, said.stdout
    assert '"appeared_m2": 0.01' in said.stdout and '"gone_m2": 0.0' in said.stdout
