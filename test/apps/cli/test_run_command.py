"""`segfloor run` for real: a small recording to a results folder, and every kind of bad input."""

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from command_line import segfloor, segfloor_process
from stereo_drive import KNOWN_MOUNT, room_drive, write_kitti
from stereo_room import MOUNT, StereoRoom, planar_pose

from segfloor_ros.apps.evaluation.report import advice, write_report
from segfloor_ros.apps.evaluation.report_pictures import read_run
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.results_folder import floor_heights, memory_growth
from segfloor_ros.core.files.results import read_map_file
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED
from segfloor_ros.core.slam.settings import StereoSlamSettings

FRAMES = 16


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    frames, _ = room_drive(FRAMES)
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', frames)


@pytest.fixture(scope='module')
def result(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp('result') / 'out'
    done = segfloor_process(
        'run', recording, '--out', out, '--save-masks', 'all', '--save-debug', *KNOWN_MOUNT
    )
    assert done.returncode == 0, done.stderr
    return out, done


def test_every_promised_file_is_there(result):
    out, done = result
    assert {path.name for path in out.iterdir()} == {
        '.segfloor_result',
        'map.pgm',
        'map.yaml',
        'trajectory.txt',
        'keyframes.txt',
        'camera_trajectory.txt',
        'labelled_cloud.ply',
        'floor_masks',
        'floor_debug',
        'summary.json',
        'settings.yaml',
    }
    assert len(list((out / 'floor_masks').iterdir())) == FRAMES
    assert 'frames tracked' in done.stdout


def test_summary_has_the_promised_figures(result):
    summary = json.loads((result[0] / 'summary.json').read_text())
    assert summary['frames'] == summary['tracked_frames'] == FRAMES
    assert summary['lost_intervals'] == []
    assert summary['map_updates'] == summary['keyframes'] >= 2
    assert summary['loops'] == 0
    assert summary['camera_height_m'] == pytest.approx(MOUNT.height_m)
    assert summary['camera_pitch_rad'] == pytest.approx(MOUNT.pitch_rad)
    assert summary['frames_per_s'] == pytest.approx(FRAMES / summary['wall_s'], rel=0.01)
    assert {'start', 'peak', 'slope_per_update'} <= set(summary['rss_mb'])
    for name in ('tracking', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid'):
        stage = summary['stages'][name]
        assert set(stage) == {'count', 'mean_ms', 'p50_ms', 'p95_ms', 'max_ms'}
        assert 0 < stage['p50_ms'] <= stage['p95_ms'] <= stage['max_ms']


def test_images_whose_rows_are_off_are_said_with_figure_and_remedy(tmp_path, result):
    good = json.loads((result[0] / 'summary.json').read_text())
    assert good['input_faults'] == []
    assert good['repeated_frames'] == 0
    frames, _ = room_drive(FRAMES)
    frames = [replace(f, right=np.roll(f.right, 3, axis=0)) for f in frames]
    off = write_kitti(tmp_path / 'off', frames)
    done = segfloor_process('run', off, '--out', tmp_path / 'out', *KNOWN_MOUNT)
    (line,) = [line for line in done.stderr.splitlines() if 'rows apart' in line]
    assert f'{off}: left and right images are not rectified' in line
    assert '3.0 rows apart' in line
    assert 'calibrate' in line
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['tracked_frames'] == FRAMES
    estimate = np.loadtxt(tmp_path / 'out' / 'trajectory.txt')
    np.testing.assert_allclose(estimate[:, 1], 0.06 * np.arange(FRAMES), atol=0.01)
    (fault,) = summary['input_faults']
    assert set(fault) == {'fault', 'value', 'unit', 'remedy'}
    assert (fault['fault'], fault['unit']) == ('rows_apart', 'px')
    assert fault['value'] == pytest.approx(3.0, abs=0.1)


def test_trajectory_follows_the_drive(result):
    estimate = np.loadtxt(result[0] / 'trajectory.txt')
    assert len(estimate) == FRAMES
    np.testing.assert_allclose(estimate[:, 0], 0.1 * np.arange(FRAMES), atol=1e-6)
    # room_drive: 6 cm a frame straight ahead.
    np.testing.assert_allclose(estimate[:, 1], 0.06 * np.arange(FRAMES), atol=0.01)
    np.testing.assert_allclose(estimate[:, 2:4], 0, atol=0.015)
    camera = np.loadtxt(result[0] / 'camera_trajectory.txt')
    np.testing.assert_allclose(camera[0, 1:], [0, 0, 0, 0, 0, 0, 1], atol=1e-6)
    # In its own axes: it looks down a little.
    ahead = 0.06 * np.arange(FRAMES)[:, None] * MOUNT.T_base_left[0, :3]
    np.testing.assert_allclose(camera[:, 1:4], ahead, atol=0.015)
    assert len(np.loadtxt(result[0] / 'keyframes.txt', ndmin=2)) >= 2


def test_map_is_free_ahead_and_never_outside_the_room(result):
    grid = load_map(result[0] / 'map.yaml')
    rows, columns = np.indices(grid.cells.shape)
    x = grid.origin_xy_m[0] + (columns + 0.5) * grid.resolution_m
    y = grid.origin_xy_m[1] + (rows + 0.5) * grid.resolution_m
    ahead = (x > 0.5) & (x < 2.5) & (np.abs(y) < 0.3)
    assert (grid.cells[ahead] == FREE).mean() > 0.95
    outside = (x > 6.1) | (np.abs(y) > 2.6)
    assert not (grid.cells[outside] == FREE).any()
    occupied = grid.cells == OCCUPIED
    if occupied.any():
        to_wall = np.minimum(np.abs(x - 6.0), np.abs(np.abs(y) - 2.5))
        assert np.median(to_wall[occupied]) < 0.15


def test_settings_are_written_as_resolved(result):
    settings = yaml.safe_load((result[0] / 'settings.yaml').read_text())
    slam = settings['stereo_slam']['ros__parameters']
    assert slam['camera_height_m'] == MOUNT.height_m
    assert slam['num_features'] == StereoSlamSettings().num_features


def test_masks_show_floor_low_and_none_above_the_horizon(result):
    mask = cv2.imread(str(result[0] / 'floor_masks' / '000005.png'), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(mask)) <= {0, 127, 255}
    assert (mask[-40:, 120:200] == 255).mean() > 0.9
    assert not (mask[:90] == 255).any()


def test_a_second_run_gives_the_same_bytes(recording, result, tmp_path):
    again = segfloor(
        'run', recording, '--out', tmp_path / 'out', '--save-masks', 'none', *KNOWN_MOUNT
    )
    assert again.returncode == 0, again.stderr
    for name in ('map.pgm', 'map.yaml', 'trajectory.txt', 'keyframes.txt', 'labelled_cloud.ply'):
        assert (tmp_path / 'out' / name).read_bytes() == (result[0] / name).read_bytes(), name
    assert not (tmp_path / 'out' / 'floor_masks').exists()
    assert not (tmp_path / 'out' / 'floor_debug').exists()


def test_pictures_of_the_floor_are_of_keyframes_and_coloured_by_the_mask(result):
    out, _ = result
    names = sorted(path.name for path in (out / 'floor_debug').iterdir())
    keyframes = json.loads((out / 'summary.json').read_text())['keyframes']
    assert sum(name.endswith('_overlay.png') for name in names) == keyframes
    assert sum(name.endswith('_v_disparity.png') for name in names) == keyframes
    mask = cv2.imread(str(out / 'floor_masks' / names[0][:6]) + '.png', cv2.IMREAD_UNCHANGED)
    overlay = cv2.imread(str(out / 'floor_debug' / names[0]))
    assert overlay.shape == (*mask.shape, 3)
    blue, green, red = (overlay[..., i].astype(int) for i in range(3))
    assert np.array_equal(green - red > 40, mask == 255)
    assert np.array_equal(red - green > 40, mask == 0)
    assert np.array_equal(blue - green > 20, mask == 127)


def missing_folder(folder):
    return folder / 'nowhere', 'nowhere'


def calibration_missing(folder):
    (folder / 'calib.txt').unlink()
    return folder, 'calib.txt'


@pytest.mark.parametrize('spoil', [missing_folder, calibration_missing])
def test_bad_input_is_one_line_and_leaves_nothing(recording, tmp_path, spoil):
    folder = tmp_path / 'drive'
    shutil.copytree(recording, folder)
    given, words = spoil(folder)
    done = segfloor('run', given, '--out', tmp_path / 'out')
    assert done.returncode == 2
    assert words in done.stderr
    assert len([line for line in done.stderr.splitlines() if line.startswith('segfloor')]) == 1
    assert 'Traceback' not in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ['drive']


def test_bad_input_ends_the_program_with_status_2(tmp_path):
    done = segfloor_process('run', tmp_path / 'nowhere', '--out', tmp_path / 'out')
    assert done.returncode == 2
    assert done.stderr.startswith('segfloor: ')
    assert done.stderr.count('\n') == 1


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--set', 'occupancy_grid.resolution_m=7'], 'occupancy_grid.resolution_m = 7'),
        (['--set', 'occupancy_grid.resolution=0.05'], 'did you mean resolution_m'),
        (['--params', 'nowhere.yaml'], 'nowhere.yaml'),
        (['--masks', 'nowhere'], 'nowhere: no such folder'),
    ],
)
def test_bad_settings_are_one_line(recording, tmp_path, arguments, words):
    done = segfloor('run', recording, '--out', tmp_path / 'out', *arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_no_floor_no_map_and_no_success(tmp_path, recording):
    blank = tmp_path / 'drive'
    shutil.copytree(recording, blank)
    for image in blank.glob('image_*/*.png'):
        cv2.imwrite(str(image), np.zeros((240, 320), np.uint8))
    done = segfloor('run', blank, '--out', tmp_path / 'out')
    assert done.returncode == 1
    (line,) = (line for line in done.stderr.splitlines() if line.startswith('segfloor: '))
    assert 'frames lost: left image without contrast' in line and line.endswith('is no map')
    assert not (tmp_path / 'out').exists()


def test_without_a_floor_everything_but_the_map_is_written(tmp_path):
    """Right before a wall; the path is that of the camera, 2 cm to the left per frame."""
    room, drive, out = StereoRoom(seed=5), tmp_path / 'drive', tmp_path / 'out'
    write_kitti(drive, [room.frame(i, planar_pose(5.5, 0.02 * i, 0.0)) for i in range(8)])
    done = segfloor('run', drive, '--out', out, '--report')
    assert done.returncode == 1, done.stderr
    (line,) = (line for line in done.stderr.splitlines() if line.startswith('segfloor: '))
    assert f'{drive}: no level floor' in line
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['map'] is None and summary['camera_height_m'] is None
    assert summary['tracked_frames'] == 8
    left_m = np.loadtxt(out / 'trajectory.txt')[:, 2]
    np.testing.assert_allclose(left_m, 0.02 * np.arange(8), atol=0.004)
    there = {path.name for path in out.iterdir()}
    assert {'labelled_cloud.ply', 'camera_trajectory.txt', 'settings.yaml'} <= there
    assert 'report.html' in there and not there & {'map.pgm', 'map.yaml', 'floor_masks'}
    done = segfloor('run', drive, '--out', out, '--no-map')
    assert done.returncode == 0 and 'segfloor' not in done.stderr


@pytest.mark.slow
def test_the_figure_of_a_fault_is_the_same_wherever_it_stands(tmp_path, caplog):
    """Rows that are two apart at first, and four later, after that was printed."""
    frames, _ = room_drive(160, step_m=0.02)
    off = [replace(f, right=np.roll(f.right, 2 if f.index < 60 else 4, axis=0)) for f in frames]
    drive, out = write_kitti(tmp_path / 'drive', off), tmp_path / 'out'
    done = segfloor('run', drive, '--out', out, '--no-map', '--report')
    assert done.returncode == 0, done.stderr
    (printed,) = re.findall(r'stand ([0-9.]+) rows apart', caplog.text)
    (fault,) = json.loads((out / 'summary.json').read_text())['input_faults']
    assert f'{fault["value"]:.1f}' == printed == '2.0'
    assert f'rows apart ({fault["value"]:g} px)' in (out / 'report.html').read_text()


def test_the_path_alone_takes_a_mount_that_is_given(recording, result, tmp_path):
    out = tmp_path / 'out'
    done = segfloor('run', recording, '--out', out, '--no-map', *KNOWN_MOUNT)
    assert done.returncode == 0, done.stderr
    for name in ('trajectory.txt', 'keyframes.txt'):
        assert (out / name).read_bytes() == (result[0] / name).read_bytes()
    assert not (out / 'map.pgm').exists()
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['map'] is None and summary['camera_height_m'] == MOUNT.height_m


@pytest.mark.slow
def test_the_path_alone_is_the_path_of_the_map(shared_data, tmp_path):
    """The mount of this camera is measured, and it changes."""
    drive, words = shared_data / 'kitchen', ('--frames', 60)
    for out, more in (tmp_path / 'map', ()), (tmp_path / 'path', ('--no-map',)):
        done = segfloor('run', drive, '--out', out, *more, *words)
        assert done.returncode == 0, done.stderr
    path = (tmp_path / 'path' / 'camera_trajectory.txt').read_bytes()
    assert path == (tmp_path / 'map' / 'camera_trajectory.txt').read_bytes()


@pytest.mark.slow
def test_a_saved_map_is_localized_in(recording, result, tmp_path):
    saved, first = tmp_path / 'room.map', tmp_path / 'first'
    done = segfloor('run', recording, '--out', first, '--save-map', saved, *KNOWN_MOUNT)
    assert done.returncode == 0, done.stderr
    for name in ('trajectory.txt', 'map.pgm'):
        assert (first / name).read_bytes() == (result[0] / name).read_bytes()
    facts = json.loads(segfloor('map', 'info', saved, '--json').stdout)
    summary = json.loads((first / 'summary.json').read_text())
    assert [facts['keyframes'], facts['camera_height_m']] == [summary['keyframes'], MOUNT.height_m]
    assert [s['keyframes'] for s in facts['sessions']] == [facts['keyframes']]
    assert segfloor('map', 'export', saved, tmp_path / 'on_disk.yaml').returncode == 0
    assert (tmp_path / 'on_disk.pgm').read_bytes() == (first / 'map.pgm').read_bytes()
    second = tmp_path / 'second'
    words = '--load-map', saved, '--localize', '--report'
    done = segfloor('run', recording, '--out', second, *words)
    assert done.returncode == 0, done.stderr
    page = (second / 'report.html').read_text()
    assert 'keyframes, all of the loaded map: the run only localised' in page
    done = segfloor('view', second, '--out', tmp_path / 'second.rrd')
    assert done.returncode == 0, done.stderr
    assert (second / 'map.pgm').read_bytes() == (first / 'map.pgm').read_bytes()
    before, after = (np.loadtxt(out / 'trajectory.txt') for out in (first, second))
    assert len(after) >= FRAMES - 3
    same = np.isin(before[:, 0], after[:, 0])
    assert np.abs(before[same, 1:4] - after[:, 1:4]).max() < 0.01
    summary = json.loads((second / 'summary.json').read_text())
    assert summary['map_updates'] == 0
    assert summary['relocalisations'] == []
    # The keyframes of a file are before those of the drive, for SLAM and for the grid.
    grown = tmp_path / 'grown.map'
    words = '--load-map', saved, '--save-map', grown
    done = segfloor('run', recording, '--out', tmp_path / 'on', *words)
    assert done.returncode == 0, done.stderr
    parts = read_map_file(grown).parts
    of_grid = set(parts['grid']['stamp_ns'].tolist())
    assert min(of_grid) < 0
    assert of_grid <= set(parts['slam']['keyframe_stamp_ns'].tolist())
    elsewhere = StereoRoom(seed=77)
    frames = [elsewhere.frame(i, planar_pose(0.06 * i, 0.0, 0.01 * i)) for i in range(FRAMES)]
    other, third, kept = tmp_path / 'other', tmp_path / 'third', saved.read_bytes()
    write_kitti(other, frames)
    done = segfloor('run', other, '--out', third, '--load-map', saved, '--save-map', saved)
    assert done.returncode == 2
    assert 'room.map: is the input' in ' '.join(done.stderr.split())
    assert saved.read_bytes() == kept
    done = segfloor('run', other, '--out', third, '--load-map', saved)
    assert done.returncode == 0, done.stderr
    assert (load_map(third / 'map.yaml').cells == FREE).any()


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        (('--localize',), '--localize needs the map'),
        (('--load-map', 'nowhere.map'), 'nowhere.map: cannot be read'),
        (('--load-map', 'short.map'), 'short.map: is truncated or damaged'),
        (('--load-map', 'short.map', '--localize', '--save-map', 'x'), 'leave --save-map out'),
    ],
)
def test_a_map_that_cannot_be_used_is_one_line(monkeypatch, recording, tmp_path, options, words):
    (tmp_path / 'short.map').write_bytes(b'PK\x03\x04 not much')
    monkeypatch.chdir(tmp_path)
    done = segfloor('run', recording, '--out', tmp_path / 'out', *options)
    assert done.returncode == 2
    assert words in ' '.join(done.stderr.split())
    assert not (tmp_path / 'out').exists()


def test_a_report_on_a_cloud_that_cannot_be_read_ends_with_status_2(result, tmp_path):
    run = tmp_path / 'run'
    shutil.copytree(result[0], run)
    cloud = run / 'labelled_cloud.ply'
    for damage in (lambda: cloud.write_bytes(b'ply'), cloud.unlink, cloud.mkdir):
        damage()
        done = segfloor('evaluate', 'report', run)
        assert done.returncode == 2
        assert len(done.stderr.strip().splitlines()) == 1
        assert 'labelled_cloud.ply' in done.stderr


def test_the_figures_of_a_run_are_printed_as_json_alone(recording, tmp_path):
    done = segfloor('run', recording, '--out', tmp_path / 'out', '--no-map', '--json')
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert printed.pop('out') == str(tmp_path / 'out')
    assert printed.pop('report') is None
    assert printed == json.loads((tmp_path / 'out' / 'summary.json').read_text())


@pytest.mark.parametrize(
    ('slope', 'words'), [(-0.011, 'none'), (0.0002, 'none'), (0.0149, '0.015 MB')]
)
def test_memory_that_is_freed_is_no_growth(slope, words):
    assert memory_growth({'slope_per_update': slope}) == words


@pytest.fixture(scope='module')
def report_data(result):
    return read_run(result[0])


FAULT = {'fault': 'rows_apart', 'value': 3.2, 'unit': 'px', 'remedy': 'calibrate again'}


def heights(median_m, first_m, last_m):
    return {'planes': 60, 'looks': 60, 'median_m': median_m, 'first_m': first_m, 'last_m': last_m}


SUBMAP = {'first_frame': 4, 'last_frame': 9, 'merged': False}


@pytest.mark.parametrize(
    ('figures', 'words'),
    [
        ({}, 'nothing: the figures are sound'),
        ({'input_faults': [FAULT]}, 'rows apart (3.2 px): calibrate again'),
        ({'lost_intervals': [[3, 5], [7, 7]]}, 'lost in the frames 3 to 5, 7 to 7'),
        ({'submaps': [SUBMAP]}, 'the frames 4 to 9 are in no map'),
        ({'submaps': [SUBMAP | {'merged': True}]}, 'nothing: the figures are sound'),
        ({'blind_frames': 2}, '2 frames show too few features'),
        ({'frames_per_s': 4.0}, '4.0 frames per second are fewer than the 10.0 of the camera'),
        ({'sensor_remarks': ['imu: upside down']}, 'imu: upside down'),
        ({'tracked_frames': 4}, f'4 of {FRAMES} frames (25%) are in the map'),
        ({'interrupted': True}, 'the drive was cut short'),
        ({'floor': heights(1.0, 1.0, 1.0)}, 'nothing: the figures are sound'),
        # A robot sways by 4 %.
        ({'floor': heights(1.03, 1.0, 1.03)}, 'nothing: the figures are sound'),
        ({'floor': heights(1.05, 1.05, 1.05)}, 'the mount says that the camera is 1.000 m'),
        # Of 9 planes the median errs by up to 5 %, and those of 3 differ by up to 12 %.
        (
            {'floor': heights(1.045, 0.95, 1.06) | {'planes': 9, 'looks': 9}},
            'nothing: the figures are sound',
        ),
        ({'floor': heights(1.1, 1.1, 1.1)}, 'the mount says that the camera is 1.000 m above the'),
        ({'floor': heights(1.0, 0.95, 1.05)}, 'the height of the camera above the floor changes'),
        (
            {'floor': heights(1.0, 1.0, 1.0) | {'planes': 2, 'looks': 30}},
            '2 of 30 keyframes show the plane',
        ),
        ({'floor': {'planes': 0, 'looks': 2}}, '0 of 2 keyframes show the plane'),
        ({'floor': {'planes': 0, 'looks': 0}}, 'nothing: the figures are sound'),
        ({'tracked_frames': 1499, 'frames': 1500}, '1499 of 1500 frames (99%) are in the map'),
        ({'floor': None}, 'nothing: the figures are sound'),
    ],
)
def test_a_report_says_what_to_do_next(report_data, figures, words):
    """Of a drive at 10 Hz."""
    usual = {'frames_per_s': 20.0, 'camera_height_m': 1.0, 'floor': heights(1.0, 1.0, 1.0)}
    summary = report_data.summary | usual | figures
    (line,) = advice(replace(report_data, summary=summary))
    assert line.startswith(words)


def test_a_run_measures_the_height_of_the_camera_in_single_keyframes(result):
    summary = json.loads((result[0] / 'summary.json').read_text())
    floor = summary['floor']
    assert 0 < floor['planes'] <= floor['looks'] == summary['keyframes']
    for name in ('median_m', 'first_m', 'last_m'):
        assert floor[name] == pytest.approx(MOUNT.height_m, rel=0.02)
    assert f'{floor["median_m"]:.3f} m ({floor["planes"]} planes' in result[1].stdout


def test_heights_of_a_drive_are_medians_of_all_and_of_its_ends():
    heights_m = np.array([1.0, 1.0, 5.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0])
    assert floor_heights(heights_m, 12) == {
        'planes': 9, 'looks': 12, 'median_m': 2.0, 'first_m': 1.0, 'last_m': 3.0,
    }  # fmt: skip
    assert floor_heights(heights_m[:0], 3) == {'planes': 0, 'looks': 3}


@pytest.mark.slow
def test_a_report_names_its_colours_and_the_length_of_the_path(result, tmp_path):
    run = tmp_path / 'run'
    shutil.copytree(result[0], run)
    page = write_report(run).read_text()
    assert page.count('<h2>What to do next</h2><ul class="next"><li>') == 1
    for name in ('floor', 'not floor', 'no evidence', 'moving'):
        assert re.search(f'<span class="colour" style="background: rgb[^"]*"></span>{name}', page)
    # room_drive: 6 cm a frame.
    assert f'<b>{0.06 * (FRAMES - 1):.1f} m</b><span>of path' in page


@pytest.mark.slow
def test_the_larger_of_two_parts_that_were_not_joined_is_the_map(tmp_path):
    rooms = StereoRoom(), StereoRoom(seed=77)
    lengths = 20, 60
    places = [(room, k) for room, n in zip(rooms, lengths, strict=True) for k in range(n)]
    frames = [
        room.frame(i, planar_pose(0.03 * k, 0.0, 0.03 * k)) for i, (room, k) in enumerate(places)
    ]
    drive, out = write_kitti(tmp_path / 'drive', frames), tmp_path / 'out'
    done = segfloor('run', drive, '--out', out, *KNOWN_MOUNT)
    assert done.returncode == 0, done.stderr
    summary = json.loads((out / 'summary.json').read_text())
    first, last = 0, lengths[0] - 1
    assert summary['submaps'] == [{'first_frame': first, 'last_frame': last, 'merged': False}]
    ((lost_from, lost_to),) = summary['lost_intervals']
    assert lost_from == 0 and last < lost_to < lengths[0] + 20
    assert summary['left_out_frames'] == lengths[0]
    assert f'{lengths[0]} ({first}-{last})' in done.stdout
    begin, *rest = (out / 'trajectory.txt').read_text().splitlines()
    assert begin.startswith(f'# frames {first}-{last} are left out') and '#' not in ''.join(rest)
    written = np.loadtxt(out / 'trajectory.txt')
    assert len(written) == summary['tracked_frames'] == sum(lengths) - lost_to - 1
    assert written[0, 0] == pytest.approx(frames[lost_to + 1].stamp_ns * 1e-9)
    assert summary['map_updates'] >= summary['keyframes'] > 2
