"""Trajectory files and errors worked out by hand."""

import json

import numpy as np
import pytest
from command_line import segfloor
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.evaluation.trajectory import (
    match_files,
    plane_axes,
    read_truth,
    save_trajectory_plot,
    score_trajectory,
)
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.twists import se3_exp


def drive(count=101, step_m=0.1) -> np.ndarray:
    """Return poses (N, 4, 4) of a straight drive along x."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count) * step_m
    return poses


def write_tum(path, poses, times=None):
    times = np.arange(len(poses)) * 0.1 if times is None else times
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    np.savetxt(path, np.column_stack([times, poses[:, :3, 3], quaternions]))
    return path


def score(tmp_path, estimate, truth, times=None):
    estimate_file = write_tum(tmp_path / 'estimate.txt', estimate, times)
    truth_file = write_tum(tmp_path / 'truth.txt', truth)
    return score_trajectory(match_files(estimate_file, truth_file))


def test_perfect_trajectory(tmp_path):
    result = score(tmp_path, drive(), drive())
    assert result.tracked == 1.0
    assert result.path_length_m == pytest.approx(10.0)
    for error in (
        result.ate_rmse_m,
        result.ate_max_m,
        result.rpe_translation_m,
        result.end_error_m,
    ):
        assert error == pytest.approx(0.0, abs=1e-9)


def test_rigid_motion_of_the_whole_path_costs_nothing(tmp_path):
    moved = se3_exp(np.array([1.0, -2.0, 0.5, 0.2, -0.1, 0.7])) @ drive()
    result = score(tmp_path, moved, drive())
    assert result.ate_rmse_m == pytest.approx(0.0, abs=1e-9)
    assert result.end_error_m == pytest.approx(0.0, abs=1e-9)


def test_scale_is_not_corrected(tmp_path):
    longer = drive()
    longer[:, 0, 3] *= 1.01
    result = score(tmp_path, longer, drive())
    x = np.arange(101) * 0.1
    assert result.end_error_m == pytest.approx(0.1)
    assert result.ate_rmse_m == pytest.approx(0.01 * x.std())
    assert result.ate_max_m == pytest.approx(0.01 * 5.0)
    assert result.rpe_translation_m == pytest.approx(0.01, rel=0.15)


def test_lost_frames_are_reported(tmp_path):
    kept = np.r_[0:30, 60:101]
    result = score(tmp_path, drive()[kept], drive(), times=kept * 0.1)
    assert result.matched == 71
    assert result.frames == 101
    assert result.tracked == pytest.approx(71 / 101)


def test_frames_that_are_named_count_as_lost_where_they_have_no_pose(tmp_path):
    for name in ('truth.txt', 'estimate.txt'):
        write_tum(tmp_path / name, drive())
    found = segfloor('evaluate', 'trajectory', tmp_path / 'estimate.txt', tmp_path / 'truth.txt',
                     '--frames', 202, '--json')  # fmt: skip
    score = json.loads(found.stdout)
    assert (score['frames'], score['matched']) == (202, 101)
    assert score['tracked'] == pytest.approx(0.5)


def test_denser_truth_does_not_count_as_lost_frames(tmp_path):
    write_tum(tmp_path / 'truth.txt', drive(401, 0.025), np.arange(401) * 0.025)
    write_tum(tmp_path / 'estimate.txt', drive())
    matched = match_files(tmp_path / 'estimate.txt', tmp_path / 'truth.txt')
    assert matched.frames == 101
    assert score_trajectory(matched).tracked == 1.0


def test_a_run_knows_how_many_frames_it_had(tmp_path):
    run = tmp_path / 'run'
    run.mkdir()
    write_tum(run / 'camera_trajectory.txt', drive(50))
    write_tum(tmp_path / 'truth.txt', drive(50))
    (run / 'summary.json').write_text('{"frames": 80}')
    assert score_trajectory(match_files(run, tmp_path / 'truth.txt')).tracked == 50 / 80
    (run / 'summary.json').write_text('{}')
    with pytest.raises(InputError, match=r'summary\.json'):
        match_files(run, tmp_path / 'truth.txt')


def test_short_path_has_no_error_over_a_metre(tmp_path):
    result = score(tmp_path, drive(6), drive(6))
    assert np.isnan(result.rpe_translation_m)
    assert result.ate_rmse_m == pytest.approx(0.0, abs=1e-9)


def test_frames_more_than_a_metre_apart_have_an_error_per_metre(tmp_path):
    # 1.5 m from frame to frame; 1.02 times as long, and a milliradian more of yaw with each.
    longer = se3_exp(np.arange(21)[:, None] * [0, 0, 0, 0, 0, 0.001])
    longer[:, 0, 3] = np.arange(21) * 1.53
    result = score(tmp_path, longer, drive(21, 1.5))
    assert result.rpe_rotation_rad == pytest.approx(0.001 / 1.5)
    # Sideways the yaw adds 1.53 m times up to 0.02.
    assert 0.02 <= result.rpe_translation_m < np.hypot(0.02, 0.0204)


def test_kitti_and_tum_agree(tmp_path):
    poses = se3_exp(np.random.default_rng(0).normal(size=(20, 6)) * 0.3)
    np.savetxt(tmp_path / 'poses.txt', poses[:, :3].reshape(-1, 12))
    np.savetxt(tmp_path / 'times.txt', np.arange(20) * 0.1)
    write_tum(tmp_path / 'tum.txt', poses)
    for from_kitti, from_tum in zip(
        read_trajectory(tmp_path / 'poses.txt'), read_trajectory(tmp_path / 'tum.txt'), strict=True
    ):
        np.testing.assert_allclose(from_kitti, from_tum, atol=1e-9)


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ('', 'empty'),
        ('1 2 3\n', 'has 3 columns'),
        ('a b c d e f g h\n', 'line 1: a: not a finite number'),
        ('0 0 0 0 0 0 0 1\n0 1 0 0 0 0 0 1\n', 'must increase'),
        ('0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 0\n', 'row 2: the quaternion'),
        ('0 nan 0 0 0 0 0 1\n', 'line 1: nan: not a finite number'),
    ],
)
def test_malformed_files_name_what_is_wrong(tmp_path, content, message):
    path = tmp_path / 'bad.txt'
    path.write_text(content)
    with pytest.raises(InputError, match=message) as error:
        read_trajectory(path)
    assert 'bad.txt' in str(error.value)


def test_the_truth_of_a_body_is_brought_to_its_left_camera(tmp_path):
    # The camera is 0.1 m ahead of the body's middle, along its x; the body turns on the spot.
    yaw = np.linspace(0, np.pi, 20)
    rows = [
        f'{10**9 + i * 10**8},1,2,3,{np.cos(a / 2)},0,0,{np.sin(a / 2)},0,0,0'
        for i, a in enumerate(yaw)
    ]
    truth = tmp_path / 'state_groundtruth_estimate0' / 'data.csv'
    for folder in (truth.parent, tmp_path / 'cam0'):
        folder.mkdir()
    truth.write_text('\n'.join(['#timestamp [ns], p, q wxyz, v', *rows]))
    T_BS = [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    (tmp_path / 'cam0' / 'sensor.yaml').write_text(f'T_BS: {{rows: 4, cols: 4, data: {T_BS}}}')
    times_s, poses = read_truth(truth)
    np.testing.assert_allclose(times_s, 1 + 0.1 * np.arange(20))
    expected = [1, 2, 3] + 0.1 * np.column_stack([np.cos(yaw), np.sin(yaw), 0 * yaw])
    np.testing.assert_allclose(poses[:, :3, 3], expected, atol=1e-9)
    np.testing.assert_allclose(poses[-1, :3, 0], [-1, 0, 0], atol=1e-9)
    truth.write_text('1000000000,1,2,3,1,0')
    with pytest.raises(InputError, match=r'data.csv, line 1: expected ns, x, y, z, qw, qx, qy, qz'):
        read_truth(truth)


def test_missing_file_and_missing_times_are_named(tmp_path):
    with pytest.raises(InputError, match=r'none\.txt'):
        read_trajectory(tmp_path / 'none.txt')
    np.savetxt(tmp_path / 'poses.txt', drive(3)[:, :3].reshape(-1, 12))
    with pytest.raises(InputError, match=r'times\.txt'):
        read_trajectory(tmp_path / 'poses.txt')


def test_trajectories_of_different_times_are_refused(tmp_path):
    with pytest.raises(InputError, match='only 0 poses'):
        score(tmp_path, drive(10), drive(10), times=1000.0 + np.arange(10))


def test_plot_is_a_picture(tmp_path):
    write_tum(tmp_path / 'a.txt', drive())
    matched = match_files(tmp_path / 'a.txt', tmp_path / 'a.txt')
    save_trajectory_plot({'path': matched}, tmp_path / 'plot.png')
    assert (tmp_path / 'plot.png').read_bytes().startswith(b'\x89PNG')


def test_plot_looks_from_above_along_the_first_stretch():
    # In an optical frame: three metres ahead (z), then two to the right (x); up is -y.
    corner = np.concatenate(
        [np.linspace([0, 0, 0], [0, 0, 3], 30), np.linspace([0, 0, 3], [2, 0, 3], 20)]
    )
    np.testing.assert_allclose(plane_axes(corner), [[0, 0, 1], [-1, 0, 0]], atol=1e-9)
    # In a base frame: along y, then to the left, -x; up is +z.
    corner = np.concatenate(
        [np.linspace([0, 0, 0], [0, 3, 0], 30), np.linspace([0, 3, 0], [-2, 3, 0], 20)]
    )
    np.testing.assert_allclose(plane_axes(corner), [[0, 1, 0], [-1, 0, 0]], atol=1e-9)


def test_the_length_of_the_estimate_is_its_own(tmp_path):
    longer = drive()
    longer[:, 0, 3] *= 1.1
    result = score(tmp_path, longer, drive())
    assert result.path_length_m == pytest.approx(10.0)
    assert result.estimate_length_m == pytest.approx(11.0)


def test_several_estimates_stand_beside_each_other(tmp_path):
    longer = drive()
    longer[:, 0, 3] *= 1.1
    truth = write_tum(tmp_path / 'truth.txt', drive())
    (tmp_path / 'other').mkdir()
    (tmp_path / 'one').mkdir()
    names = ('one/plain.txt', 'one/longer.txt', 'other/plain.txt')
    for name, poses in zip(names, (drive(), longer, drive()[:51]), strict=True):
        write_tum(tmp_path / name, poses)
    files = [tmp_path / name for name in names]
    command = ('evaluate', 'trajectory', *files, truth)
    plot = tmp_path / 'paths.png'
    done = segfloor(*command, '--plot', plot)
    assert done.returncode == 0, done.stderr
    rows = [line.split('│')[1:] for line in done.stdout.splitlines() if line.startswith('│')]
    rows = [[cell.strip() for cell in row] for row in rows]
    assert [(row[0], row[2]) for row in rows] == [
        ('one/plain', '10.00'),
        ('one/longer', '11.00'),
        ('other/plain', '5.00'),
    ]
    assert rows[1][1:4] == ['100.0', '11.00', '10.00']
    assert rows[2][1] == '50.5'
    assert plot.stat().st_size > 0
    found = json.loads(segfloor(*command, '--json').stdout)
    assert list(found) == ['one/plain', 'one/longer', 'other/plain']
    assert found['one/longer']['estimate_length_m'] == pytest.approx(11.0)


def test_a_truth_without_an_estimate_is_refused(tmp_path):
    done = segfloor('evaluate', 'trajectory', write_tum(tmp_path / 'truth.txt', drive()))
    assert done.returncode == 2
    assert 'give one estimate or more, and at last the truth' in done.stderr
