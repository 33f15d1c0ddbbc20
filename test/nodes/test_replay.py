"""`segfloor replay` for real: five processes, a small drive, and what may go wrong."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import command_line
import numpy as np
import pytest
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.cli.main import main
from segfloor_ros.apps.cli.replay_nodes import unconnected
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.files.results import read_map_file
from segfloor_ros.core.grid.occupancy import FREE
from segfloor_ros.nodes.messages.topics import NODES, published_by

FRAMES, DAMAGED = 20, 7
SAME_FILES = (
    'map.pgm',
    'map.yaml',
    'trajectory.txt',
    'keyframes.txt',
    'camera_trajectory.txt',
    'labelled_cloud.ply',
    'settings.yaml',
)
STOPS = [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]


@pytest.fixture(scope='module')
def drive(tmp_path_factory) -> Path:
    frames, _ = room_drive(FRAMES)
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', frames)


def start(*arguments: object) -> subprocess.Popen[str]:
    environment = {k: v for k, v in os.environ.items() if k != 'ROS_DOMAIN_ID'}
    return subprocess.Popen(
        [sys.executable, '-m', 'segfloor_ros.apps.cli.main', *map(str, arguments)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def segfloor(*arguments: object) -> tuple[int, str, str]:
    process = start(*arguments)
    out, err = process.communicate(timeout=150)
    return process.returncode, out, err


def node_processes(replay: subprocess.Popen[str]) -> dict[str, int]:
    """Return the process ids of a running replay's nodes."""
    children = Path(f'/proc/{replay.pid}/task/{replay.pid}/children')
    found = {}
    for pid in children.read_text().split():
        try:
            words = Path(f'/proc/{pid}/cmdline').read_text().split('\0')
        except OSError:
            continue
        names = [w.rsplit('.', 1)[-1] for w in words if w.startswith('segfloor_ros.')]
        found.update({name: int(pid) for name in names})
    return found


def assert_shown(recording: Path) -> None:
    from rerun.chunk import RrdReader

    entities = {str(c.entity_path) for c in RrdReader(recording).stream().to_chunks()}
    world = ('base', 'base/camera', 'cloud', 'keyframes', 'map', 'path')
    wanted = {f'/world/{part}' for part in world} | {'/keyframe', '/log', '/ms/stereo_slam'}
    assert wanted <= entities


def test_the_replay_gives_what_the_run_gives(drive, tmp_path) -> None:
    """Also where somebody watches, and where an image is damaged: it is skipped with a warning and
    counted.
    """
    shown = tmp_path / 'replay.rrd'
    view = ('--view', shown) if find_spec('rerun') else ()
    drive = Path(shutil.copytree(drive, tmp_path / 'drive'))
    image = drive / 'image_1' / f'{DAMAGED:06d}.png'
    image.write_bytes(image.read_bytes()[:1000])
    done = command_line.segfloor('run', drive, '--out', tmp_path / 'run')
    assert done.returncode == 0, done.stderr
    status, out, errors = segfloor(
        'replay', drive, '--out', tmp_path / 'replay', '--rate', 0, *view
    )
    assert status == 0, errors
    if view:
        assert_shown(shown)
    for name in SAME_FILES:
        run, replay = ((tmp_path / kind / name).read_bytes() for kind in ('run', 'replay'))
        assert run == replay, name
    summaries = [
        json.loads((tmp_path / kind / 'summary.json').read_text()) for kind in ('run', 'replay')
    ]
    same = ('frames', 'tracked_frames', 'lost_intervals', 'keyframes', 'map_updates')
    for key in (*same, 'repeated_frames', 'input_faults'):
        assert summaries[0][key] == summaries[1][key], key
    assert (summaries[1]['frames'], summaries[1]['skipped_frames']) == (FRAMES - 1, 1)
    assert f'frame {DAMAGED} is skipped' in errors
    masks = [
        sorted(p.name for p in (tmp_path / k / 'floor_masks').iterdir()) for k in ('run', 'replay')
    ]
    assert masks[0] == masks[1]
    assert len(masks[0]) == summaries[0]['keyframes']
    assert 'keyframes that failed: 0' in out


@pytest.mark.slow
def test_a_path_alone_is_that_of_the_run(drive, tmp_path) -> None:
    done = command_line.segfloor('run', drive, '--out', tmp_path / 'run', '--no-map')
    assert done.returncode == 0, done.stderr
    words = drive, '--out', tmp_path / 'replay', '--no-map', '--rate', 0
    status, _, errors = segfloor('replay', *words)
    assert status == 0, errors
    same = set(SAME_FILES) - {'map.pgm', 'map.yaml'}
    assert {path.name for path in (tmp_path / 'replay').glob('[!.]*')} == same | {'summary.json'}
    for name in same:
        run, replay = ((tmp_path / kind / name).read_bytes() for kind in ('run', 'replay'))
        assert run == replay, name
    run, replay = (
        json.loads((tmp_path / kind / 'summary.json').read_text()) for kind in ('run', 'replay')
    )
    for key in ('map', 'frames', 'tracked_frames', 'keyframes', 'map_updates', 'camera_height_m'):
        assert run[key] == replay[key], key
    assert (run['map'], run['camera_height_m'], run['tracked_frames']) == (None, None, FRAMES)


@pytest.mark.slow
def test_eyes_that_are_exchanged_are_said_also_where_no_map_comes_of_it(tmp_path) -> None:
    frames = [replace(f, left=f.right, right=f.left) for f in room_drive(5)[0]]
    drive = write_kitti(tmp_path / 'exchanged', frames)
    status, _, errors = segfloor('replay', drive, '--out', tmp_path / 'out', '--rate', 0)
    assert status == 1
    assert f'{drive}: eyes_swapped, ' in errors
    assert '%; exchange the two' in errors


@pytest.mark.slow
def test_why_there_is_no_map_is_said_as_by_a_run(tmp_path) -> None:
    blank = np.zeros_like(room_drive(5)[0][0].left)
    frames = [replace(f, left=blank, right=blank) for f in room_drive(5)[0]]
    drive = write_kitti(tmp_path / 'blank', frames)
    values = ('camera_height_m=0.3', 'camera_pitch_rad=0', 'camera_roll_rad=0')
    mount = [word for value in values for word in ('--set', f'stereo_slam.{value}')]
    for command, rate in (('run', ()), ('replay', ('--rate', 0))):
        out = tmp_path / 'out'
        status, _, errors = segfloor(command, drive, '--out', out, *rate, *mount)
        assert status == 1
        words = f'{drive}: 5 of 5 frames lost: left image without contrast'
        assert words in ' '.join(errors.split()), errors


@pytest.mark.slow
def test_the_replay_saves_loads_and_localizes_as_the_run_does(drive, tmp_path) -> None:
    maps = {kind: tmp_path / f'{kind}.map' for kind in ('run', 'replay')}
    for kind, rate in (('run', ()), ('replay', ('--rate', 0))):
        for name, options in (
            ('saved', ('--save-map', maps[kind])),
            ('localized', ('--load-map', maps['run'], '--localize')),
        ):
            out = tmp_path / kind / name
            status, _, errors = segfloor(kind, drive, '--out', out, *options, *rate)
            assert status == 0, errors
    for name, files in (('saved', SAME_FILES), ('localized', SAME_FILES)):
        for file in files:
            run, replay = ((tmp_path / kind / name / file).read_bytes() for kind in maps)
            assert run == replay, (name, file)
    run, replay = (read_map_file(file) for file in maps.values())
    assert run.header['camera'] == replay.header['camera']
    for part, arrays in run.parts.items():
        for name, array in arrays.items():
            np.testing.assert_allclose(replay.parts[part][name], array, rtol=1e-6, atol=1e-6)
    summary = json.loads((tmp_path / 'replay' / 'localized' / 'summary.json').read_text())
    assert summary['keyframes'] == len(run.parts['slam']['keyframe_stamp_ns'])
    assert summary['tracked_frames'] >= FRAMES - 2


@pytest.mark.slow
def test_an_interrupted_map_does_not_replace_the_one_that_was_loaded(drive, tmp_path) -> None:
    home, out = tmp_path / 'home.map', tmp_path / 'out'
    start_of_it = write_kitti(tmp_path / 'start', room_drive(FRAMES)[0][:6])
    status, _, errors = segfloor('run', start_of_it, '--out', tmp_path / 'run', '--save-map', home)
    assert status == 0, errors
    before = home.read_bytes()
    grown = shutil.copy(home, tmp_path / 'grown.map')
    maps = ('--load-map', home, '--save-map', grown)
    replay = start('replay', drive, '--out', out, '--rate', 0.2, *maps)
    while not list(tmp_path.rglob('.segfloor-*/floor_masks/*.png')) and replay.poll() is None:
        time.sleep(0.05)
    replay.send_signal(signal.SIGINT)
    _, errors = replay.communicate(timeout=60)
    assert replay.returncode == 128 + signal.SIGINT, errors
    assert home.read_bytes() == before == grown.read_bytes()
    assert f'{grown}: stays as it was; the map is in {grown}.interrupted' in errors
    assert read_map_file(tmp_path / 'grown.map.interrupted').parts.keys() >= {'slam', 'grid'}


def test_a_node_that_dies_ends_the_replay_by_its_name(drive, tmp_path) -> None:
    out = tmp_path / 'out'
    replay = start('replay', drive, '--out', out, '--rate', 0.2)
    nodes = {}
    deadline_s = time.monotonic() + 60
    while len(nodes) < 5 and time.monotonic() < deadline_s:
        nodes = node_processes(replay)
    os.kill(nodes['cloud_labelling'], signal.SIGKILL)
    _, errors = replay.communicate(timeout=60)
    assert replay.returncode == 1
    assert 'node cloud_labelling died (signal SIGKILL)' in errors
    assert not out.exists()
    assert list(tmp_path.iterdir()) == []
    assert not any(Path(f'/proc/{pid}').exists() for pid in nodes.values())


@pytest.mark.parametrize('stop', STOPS)
def test_an_interrupt_leaves_nothing_behind(drive, tmp_path, stop) -> None:
    replay = start('replay', drive, '--out', tmp_path / 'out', '--rate', 0.2)
    nodes = {}
    while len(nodes) < 5 and replay.poll() is None:
        nodes = node_processes(replay)
    stop_s = time.monotonic()
    replay.send_signal(stop)
    replay.communicate(timeout=60)
    # Where other programs compete for the processors, ending takes longer by their number.
    assert time.monotonic() - stop_s < 5 * max(1.0, os.getloadavg()[0] / os.cpu_count())
    assert not any(Path(f'/proc/{pid}').exists() for pid in nodes.values())
    # On a busy machine a first keyframe may be in the map by then, which is kept.
    has_map = (tmp_path / 'out' / 'map.yaml').exists()
    assert replay.returncode == 128 + stop
    assert has_map or list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('stop', STOPS)
@pytest.mark.slow
def test_an_interrupt_while_mapping_keeps_the_map(drive, tmp_path, stop) -> None:
    out = tmp_path / 'out'
    replay = start('replay', drive, '--out', out, '--rate', 0.2)
    while not list(tmp_path.rglob('floor_masks/*.png')) and replay.poll() is None:
        time.sleep(0.05)
    nodes = node_processes(replay)
    replay.send_signal(stop)
    _, errors = replay.communicate(timeout=60)
    assert replay.returncode == 128 + stop, errors
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['interrupted'] is True
    assert 0 < summary['frames'] == summary['tracked_frames'] < FRAMES
    assert len(read_trajectory(out / 'trajectory.txt')[0]) == summary['frames']
    assert (load_map(out / 'map.yaml').cells == FREE).any()
    assert not any(Path(f'/proc/{pid}').exists() for pid in nodes.values())


@pytest.mark.slow
def test_a_killed_replay_leaves_no_node_and_no_file(drive, tmp_path, monkeypatch) -> None:
    (temporary := tmp_path / 'temporary').mkdir()
    monkeypatch.setenv('TMPDIR', str(temporary))
    replay = start('replay', drive, '--out', tmp_path / 'out', '--rate', 0.2)
    while not list(tmp_path.rglob('.segfloor-*/floor_masks/*.png')) and replay.poll() is None:
        time.sleep(0.05)
    nodes = node_processes(replay)
    assert len(nodes) == 5
    replay.kill()
    replay.communicate()
    end_s = time.monotonic() + 30

    def left() -> list[object]:
        running = [pid for pid in nodes.values() if Path(f'/proc/{pid}').exists()]
        return running

    while left() and time.monotonic() < end_s:
        time.sleep(0.05)
    assert left() == []
    status, _, errors = segfloor('convert', drive, tmp_path / 'next.mcap')  # removes what is left
    assert status == 0, errors
    assert list(temporary.iterdir()) == []
    assert [path.name for path in (tmp_path / 'out').iterdir()] == ['.segfloor_result']


@pytest.mark.slow
def test_a_node_that_dies_midway_keeps_what_is_mapped(drive, tmp_path) -> None:
    out = tmp_path / 'out'
    replay = start('replay', drive, '--out', out, '--rate', 0.2)
    while len(list(tmp_path.rglob('.segfloor-*/floor_masks/*.png'))) < 2 and replay.poll() is None:
        time.sleep(0.05)
    time.sleep(1.0)  # the map of them arrives
    os.kill(node_processes(replay)['floor_segmentation'], signal.SIGKILL)
    _, errors = replay.communicate(timeout=60)
    assert replay.returncode == 1
    assert 'node floor_segmentation died (signal SIGKILL)' in errors
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['interrupted'] is True
    assert summary['map_updates'] >= 1
    assert (load_map(out / 'map.yaml').cells == FREE).any()


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['missing'], 'missing'),
        (['drive', '--set', 'occupancy_grid.resolution_m=7'], 'occupancy_grid.resolution_m = 7'),
        (['drive', '--set', 'occupancy_grid.resolution=1'], 'did you mean resolution_m'),
        (['drive', '--save-masks', 'all'], '--save-masks all'),
        (['drive', '--rate', '-1'], 'rate = -1'),
        (['drive', '--localize'], '--load-map FILE'),
        (['drive', '--load-map', 'missing.map'], 'missing.map: cannot be read'),
    ],
)
def test_bad_input_ends_with_one_line_before_anything_is_written(
    drive, tmp_path, monkeypatch, capsys, arguments, words
) -> None:
    given = [str(drive) if word == 'drive' else word for word in arguments]
    command = ['segfloor', 'replay', *given, '--out', str(tmp_path / 'out')]
    monkeypatch.setattr('sys.argv', command)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    errors = capsys.readouterr().err
    assert words in errors
    assert len(errors.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_no_frame_is_sent_before_every_topic_is_connected() -> None:
    assert unconnected({}) == [f'{node} (no sign of life)' for node in NODES]
    enough = {node: {t.name: 9 for t in published_by(node)} for node in NODES}
    for counts in enough.values():
        counts['/diagnostics'] = 2
    assert unconnected(enough) == []
    enough['stereo_slam']['keyframe/features'] = 1
    assert unconnected(enough) == ['keyframe/features (1 of 2 subscribers)']
