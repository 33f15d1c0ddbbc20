"""`segfloor evaluate`, each command for real."""

import json

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from segfloor_ros.apps.cli.evaluate import app
from segfloor_ros.apps.evaluation.maps import load_truth
from segfloor_ros.core.errors import InputError, SettingsError


def write_map(folder, shift_cells=0):
    """Write a room of 30 x 20 cells of 0.1 m, its lower left corner at the origin, all free but
    a pillar of 2 x 5 that tells its ends apart.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cells = np.full((30, 45), 205, np.uint8)
    cells[4:26, 4 + shift_cells : 36 + shift_cells] = 0
    cells[5:25, 5 + shift_cells : 35 + shift_cells] = 254
    cells[10:15, 28 + shift_cells : 30 + shift_cells] = 0
    cv2.imwrite(str(folder / 'map.pgm'), cells[::-1])
    (folder / 'map.yaml').write_text(
        yaml.safe_dump(
            {
                'image': 'map.pgm',
                'mode': 'trinary',
                'resolution': 0.1,
                'origin': [-0.5, -0.5, 0.0],
                'negate': 0,
                'occupied_thresh': 0.65,
                'free_thresh': 0.196,
            }
        )
    )
    return folder


def write_scene(folder):
    write_map(folder)
    (folder / 'scene.yaml').write_text('start_pose_world: [0.4, 0.0, 0.0]\nfov_x_deg: 90.0\n')
    np.savetxt(folder / 'base_poses.txt', [[0.0, 0.4, 1.0, 0.0], [1.0, 0.8, 1.0, 0.0]])
    return folder


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_map_of_a_scene_starts_where_the_scene_says(tmp_path):
    scene = write_scene(tmp_path / 'scene')
    # The robot's frame lies four cells to the right, so in it everything is four to the left.
    estimate = write_map(tmp_path / 'run', shift_cells=-4)
    score = json.loads(run('map', estimate, scene, '--json', '--overlay', tmp_path / 'o.png'))
    assert score['alignment'] == [0.4, 0.0, 0.0]
    assert score['cells']['free_precision'] == 1.0
    assert score['raw']['precision']['mean'] == 1.0
    assert score['observable_only']
    assert (tmp_path / 'o.png').is_file()


@pytest.mark.parametrize('align', ['found', '0.4,0,0'])
def test_map_alignment_without_a_scene(tmp_path, align):
    truth = write_map(tmp_path / 'truth')
    estimate = write_map(tmp_path / 'run', shift_cells=-4)
    assert 'x 0.400 m' in run('map', estimate / 'map.yaml', truth / 'map.yaml', '--align', align)
    # Left where it is, 80 of its 590 free cells lie outside and 10 on the pillar.
    score = json.loads(run('map', estimate, truth / 'map.yaml', '--json'))
    assert score['cells']['free_precision'] == pytest.approx(500 / 590)


def test_map_with_a_trajectory_of_the_run(tmp_path):
    truth = write_map(tmp_path / 'truth')
    drive = tmp_path / 'trajectory.txt'
    drive.write_text('0 0.1 1 0 0 0 0 1\n')
    score = json.loads(
        run('map', truth, truth, '--trajectory', drive, '--align', '0,0,0', '--fov', '60', '--json')
    )
    assert score['observable_only']
    assert 2.0 < score['area_m2'] < 6.0


@pytest.mark.slow
def test_a_trajectory_of_the_run_lies_where_its_map_is_aligned(tmp_path):
    """The same drive, in the frame of the estimate and, as `t x y yaw`, in that of the truth."""
    truth, drive, true_drive = write_map(tmp_path / 'truth'), tmp_path / 't.txt', tmp_path / 'b.txt'
    x, y, yaw = 2.0, 0.3, 2.2
    drive.write_text(f'0 1.0 0.0 0 0 0 {np.sin(0.2)} {np.cos(0.2)}\n')
    true_drive.write_text(f'0 {x + np.cos(yaw)} {y + np.sin(yaw)} {yaw + 0.4}\n')
    align = ('--align', f'{x},{y},{yaw}', '--fov', '60', '--json')
    here, there = (
        json.loads(run('map', truth, truth, '--trajectory', file, *align))
        for file in (drive, true_drive)
    )
    assert here['area_m2'] == there['area_m2'] > 0.5
    assert here['cells'] == there['cells']


def test_bad_alignment_and_bad_scene(tmp_path):
    scene = write_scene(tmp_path / 'scene')
    with pytest.raises(SettingsError, match='--align left'):
        run('map', scene, scene, '--align', 'left')
    (scene / 'scene.yaml').write_text('fov_x_deg: 90\n')
    with pytest.raises(InputError, match=r'scene\.yaml.*start_pose_world'):
        load_truth(scene)


def test_missing_maps_are_named(tmp_path):
    scene = write_scene(tmp_path / 'scene')
    with pytest.raises(InputError, match=r'none.*map\.yaml'):
        run('map', tmp_path / 'none' / 'map.yaml', scene)
    with pytest.raises(InputError, match=r'run.*summary\.json'):
        run('report', tmp_path / 'run')


def test_trajectory_and_floor_commands(tmp_path):
    poses = np.tile(np.eye(4)[:3].ravel(), (30, 1))
    poses[:, 11] = np.arange(30) * 0.1
    np.savetxt(tmp_path / 'poses.txt', poses)
    np.savetxt(tmp_path / 'times.txt', np.arange(30) * 0.1)
    output = run('trajectory', tmp_path / 'poses.txt', tmp_path, '--plot', tmp_path / 'p.png')
    assert '100.0' in output
    assert (tmp_path / 'p.png').is_file()
    (tmp_path / 'floor').mkdir()
    cv2.imwrite(str(tmp_path / 'floor' / '000000.png'), np.full((4, 4), 255, np.uint8))
    assert json.loads(run('floor', tmp_path / 'floor', tmp_path, '--json'))['iou'] == 1.0
