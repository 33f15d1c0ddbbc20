"""`--network` of run and replay, for real: a network beside a small drive, and wrong ones."""

import json
from importlib.util import find_spec

import cv2
import numpy as np
import pytest
from command_line import segfloor, segfloor_process
from small_network import constant_network, grey_network
from stereo_drive import KNOWN_MOUNT, room_drive, write_kitti

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.core.contracts import FLOOR
from segfloor_ros.core.grid.occupancy import FREE, UNKNOWN

FRAMES = 16
CLASSES = ('person', 'floor')


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', room_drive(FRAMES)[0])


@pytest.mark.parametrize(
    ('chosen', 'words'),
    [
        ('person', '100 % of an image are of classes that move'),
        pytest.param('floor', '', marks=pytest.mark.slow),
    ],
)
def test_with_a_wrong_network_tracking_goes_on_and_it_is_said(tmp_path, drive, chosen, words):
    roles = {'moves': ['person'], 'floor': ['floor']}
    network = constant_network(tmp_path / 'wrong.onnx', chosen, CLASSES, **roles)
    out = tmp_path / 'out'
    done = segfloor_process('run', drive, '--network', network, '--out', out, *KNOWN_MOUNT)
    assert done.returncode == 0, done.stderr
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['tracked_frames'] == FRAMES
    assert summary['stages']['network']['count'] >= FRAMES
    assert done.stderr.count('classes that move') == bool(words)
    assert words in ''.join(summary['sensor_remarks'])
    mask = cv2.imread(str(next((out / 'floor_masks').iterdir())), cv2.IMREAD_UNCHANGED)
    assert 0.1 < (mask == FLOOR).mean() < 0.6
    labels, grid = load_map(out / 'map_labels.yaml'), load_map(out / 'map.yaml')
    assert labels.cells.shape == grid.cells.shape
    number = CLASSES.index(chosen)
    known = labels.cells != UNKNOWN
    assert known[grid.cells == FREE].mean() > 0.5 and (labels.cells[known] == number).all()
    assert (out / 'map_semantic.png').is_file()
    points = (out / 'point_labels.csv').read_text().splitlines()
    assert points[0] == 'id,class' and {row.partition(',')[2] for row in points[1:]} == {chosen}


@pytest.mark.slow
def test_what_moves_leaves_features_and_floor_even_if_the_network_sees_keyframes_alone(
    tmp_path, drive
):
    """What is dark is said to move: it stays out of the floor masks."""
    network = grey_network(tmp_path / 'n.onnx', 160, 120, moves=['dark'], every=0, mean=[100.0])
    out = tmp_path / 'out'
    done = segfloor_process('run', drive, '--network', network, '--out', out, *KNOWN_MOUNT)
    assert done.returncode == 0, done.stderr
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['stages']['network']['count'] == summary['keyframes'] < FRAMES
    for file in (out / 'floor_masks').iterdir():
        image = cv2.imread(str(drive / 'image_0' / file.name), cv2.IMREAD_UNCHANGED)
        dark = cv2.blur(image, (9, 9)) < 90
        floor = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) == FLOOR
        assert np.mean(floor[dark]) < 0.1 < np.mean(floor)


def test_a_file_that_is_no_network_ends_run_and_replay_in_one_line(tmp_path, drive):
    file = tmp_path / 'damaged.onnx'
    file.write_bytes(b'nothing')
    file.with_suffix('.yaml').write_text('{kind: semantic, input: [8, 8], classes: [a]}')
    for command in ('run', 'replay')[: 1 + (find_spec('rclpy') is not None)]:
        result = segfloor(command, drive, '--network', file, '--out', tmp_path / 'out')
        assert result.returncode == 2
        assert str(file) in ' '.join(result.stderr.split())
    assert not (tmp_path / 'out').exists()


@pytest.mark.slow
def test_a_saved_map_keeps_its_classes(tmp_path, drive):
    network = constant_network(tmp_path / 'n.onnx', 'floor', CLASSES, floor=['floor'])
    saved, again, out = (tmp_path / name for name in ('a.map', 'b.map', 'out'))
    words = ('--network', network, '--save-map', saved)
    assert segfloor_process('run', drive, '--out', out, *words, *KNOWN_MOUNT).returncode == 0
    facts = json.loads(segfloor('map', 'info', saved, '--json').stdout)
    assert facts['classes_m2'] == {'floor': pytest.approx(facts['free_m2'], rel=0.5)}
    assert 'floor' in segfloor('map', 'info', saved).stdout
    assert segfloor('map', 'export', saved, tmp_path / 'e.yaml').returncode == 0
    exported = load_map(tmp_path / 'e_labels.yaml')
    np.testing.assert_array_equal(exported.cells, load_map(out / 'map_labels.yaml').cells)
    assert (tmp_path / 'e_semantic.png').is_file()
    # It goes on without a network.
    words = ('--load-map', saved, '--save-map', again)
    done = segfloor_process('run', drive, '--out', tmp_path / 'later', *words, *KNOWN_MOUNT)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / 'later' / 'map_semantic.png').is_file()
    assert json.loads(segfloor('map', 'info', again, '--json').stdout)['classes_m2'].keys() == {
        'floor'
    }


@pytest.mark.slow
def test_replay_runs_the_network_beside_the_five_nodes(tmp_path, drive):
    pytest.importorskip('rclpy')
    roles = {'moves': ['person'], 'floor': ['floor']}
    network = constant_network(tmp_path / 'n.onnx', 'floor', CLASSES, **roles)
    out = tmp_path / 'out'
    done = segfloor_process(
        'replay', drive, '--network', network, '--rate', '0', '--out', out, *KNOWN_MOUNT
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['tracked_frames'] == FRAMES
    assert summary['map_updates'] == summary['keyframes'] >= 2
    labels, grid = load_map(out / 'map_labels.yaml'), load_map(out / 'map.yaml')
    assert (labels.cells[grid.cells == FREE] == CLASSES.index('floor')).mean() > 0.5
    assert (out / 'map_semantic.png').is_file()
    assert 'segfloor_masks' not in done.stderr, 'the node has nothing to warn of'
