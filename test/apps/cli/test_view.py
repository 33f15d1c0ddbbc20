"""What `--view` and `segfloor view` write, read back by the reader of rerun."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import segfloor, segfloor_process
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.cli import main, view
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.core.grid.occupancy import OccupancyGrid

FRAMES = 16
SAME = ('map.pgm', 'trajectory.txt', 'keyframes.txt', 'labelled_cloud.ply', 'settings.yaml')


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    frames, _ = room_drive(FRAMES)
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', frames)


@pytest.fixture(scope='module')
def run(recording, tmp_path_factory):
    pytest.importorskip('rerun', reason='rerun is not installed')
    folder = tmp_path_factory.mktemp('run')
    out, shown = folder / 'out', folder / 'run.rrd'
    done = segfloor_process('run', recording, '--out', out, '--view', shown)
    assert done.returncode == 0, done.stderr
    return out, shown, done


def chunks(path):
    chunk = pytest.importorskip('rerun.chunk', reason='rerun is not installed')
    return chunk.RrdReader(path).stream().to_chunks()


def rows(path) -> Counter[str]:
    """Return how much was logged, by entity."""
    counted: Counter[str] = Counter()
    for chunk in chunks(path):
        counted[str(chunk.entity_path)] += chunk.num_rows
    return counted


def values(path, entity: str, component: str) -> list:
    """Return what was logged last of a component."""
    found = [c.to_record_batch() for c in chunks(path) if str(c.entity_path) == entity]
    columns = [batch.column(name) for batch in found for name in batch.schema.names
               if name.endswith(component)]  # fmt: skip
    return columns[-1].to_pylist()[-1]


@pytest.mark.slow
def test_a_view_changes_no_result(recording, run, tmp_path):
    done = segfloor_process('run', recording, '--out', tmp_path / 'alone')
    assert done.returncode == 0, done.stderr
    for name in SAME:
        assert (run[0] / name).read_bytes() == (tmp_path / 'alone' / name).read_bytes(), name


def test_a_run_shows_images_floor_cloud_path_map_times_and_state(run):
    out, shown, done = run
    assert f'view: {shown}' in done.stdout
    counted = rows(shown)
    world = ('base', 'base/camera', 'cloud', 'keyframes', 'map', 'path')
    others = ('about', 'keyframe', 'log', 'ms/floor_segmentation', 'ms/tracking')
    for entity in (*others, *(f'world/{part}' for part in world)):
        assert counted[f'/{entity}'], entity
    keyframes = len(np.loadtxt(out / 'keyframes.txt', ndmin=2))
    assert len(values(shown, '/world/keyframes', 'positions')) == keyframes
    grid = load_map(out / 'map.yaml')
    (data,) = values(shown, '/world/map', 'data')
    np.testing.assert_array_equal(np.ravel(data), grid.picture.ravel())
    assert values(shown, '/world/map', 'colormap') == [1]  # grey levels
    assert values(shown, '/world/map', 'cell_size') == pytest.approx([grid.resolution_m])


def test_results_are_shown_with_every_pose_and_image(run, tmp_path):
    shown = tmp_path / 'result.rrd'
    done = segfloor('view', run[0], '--out', shown)
    assert done.returncode == 0, done.stderr
    counted = rows(shown)
    assert counted['/world/base'] == FRAMES
    assert counted['/world/base/camera'] >= FRAMES
    assert counted['/keyframe'] == len(list((run[0] / 'floor_masks').iterdir()))
    last = np.loadtxt(run[0] / 'trajectory.txt')[-1, 1:4]
    np.testing.assert_allclose(values(shown, '/world/base', 'translation')[0], last, atol=1e-5)


def test_results_whose_recording_is_gone_are_shown_without_images(run, recording, tmp_path):
    settings = (run[0] / 'settings.yaml').read_text()
    out = tmp_path / 'out'
    out.mkdir()
    for path in run[0].iterdir():
        if path.is_file():
            (out / path.name).write_bytes(path.read_bytes())
    (out / 'settings.yaml').write_text(settings.replace(str(recording), str(tmp_path / 'gone')))
    done = segfloor('view', out, '--out', tmp_path / 'result.rrd')
    assert done.returncode == 0, done.stderr
    assert 'without images' in values(tmp_path / 'result.rrd', '/log', 'text')[0]


def test_a_recording_is_shown_pair_by_pair(recording, run, tmp_path):
    shown = tmp_path / 'recording.rrd'
    done = segfloor('view', recording, '--frames', 5, '--out', shown)
    assert done.returncode == 0, done.stderr
    counted = rows(shown)
    assert counted['/world/base/camera'] == counted['/right'] == 5


def test_a_loop_is_noted_and_marked_on_the_path(run, tmp_path):
    """The summary says when loops were closed; the view marks the keyframe of that time."""
    out = tmp_path / 'out'
    out.mkdir()
    for path in run[0].iterdir():
        if path.is_file():
            (out / path.name).write_bytes(path.read_bytes())
    keyframes = np.loadtxt(out / 'keyframes.txt', ndmin=2)
    summary = json.loads((out / 'summary.json').read_text())
    (out / 'summary.json').write_text(json.dumps(summary | {'loop_times_s': [keyframes[1, 0]]}))
    assert segfloor('view', out, '--out', tmp_path / 'result.rrd').returncode == 0
    (marked,) = values(tmp_path / 'result.rrd', '/world/loops', 'positions')
    np.testing.assert_allclose(marked, keyframes[1, 1:4], atol=1e-5)


def test_running_nodes_are_shown_until_an_interrupt(tmp_path):
    pytest.importorskip('rerun', reason='rerun is not installed')
    rclpy = pytest.importorskip('rclpy', reason='ROS is not installed')
    from segfloor_ros.apps.cli.replay_nodes import isolated_environment
    from segfloor_ros.nodes.messages.grids import grid_message
    from segfloor_ros.nodes.messages.topics import TOPICS

    environment, shown = isolated_environment(), tmp_path / 'live.rrd'
    cells = np.array([[0, 100, -1], [0, 0, 100]], np.int8)
    context = rclpy.Context()
    with pytest.MonkeyPatch.context() as patch:
        for name in ('ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE'):
            patch.setenv(name, environment[name])
        rclpy.init(context=context)
    try:
        node = rclpy.create_node('grid', context=context, namespace='/robot')
        publisher = node.create_publisher(TOPICS['map'].type, 'map', TOPICS['map'].profile)
        publisher.publish(grid_message(10**9, 'map', OccupancyGrid(cells, 0.5, (-1.0, 2.0))))
        process = segfloor_started('view', '/robot', '--live', '--out', shown, env=environment)
        end_s = time.monotonic() + 60.0
        while publisher.get_subscription_count() < 1 and time.monotonic() < end_s:
            time.sleep(0.1)
        time.sleep(2.0)
        process.send_signal(signal.SIGINT)
        errors = process.communicate(timeout=30)[1]
    finally:
        rclpy.try_shutdown(context=context)
    assert process.returncode == 0, errors
    (data,) = values(shown, '/world/map', 'data')
    np.testing.assert_array_equal(np.ravel(data), [254, 254, 0, 254, 0, 205])
    np.testing.assert_allclose(values(shown, '/world/map', 'translation')[0], [-1, 2, 0])


def segfloor_started(*words, env):
    command = [sys.executable, '-m', 'segfloor_ros.apps.cli.main', *map(str, words)]
    return subprocess.Popen(
        command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_what_takes_long_is_shown_less_often(monkeypatch):
    rerun = pytest.importorskip('rerun', reason='rerun is not installed')
    clock = {'wall': 0.0}
    monkeypatch.setattr(view.time, 'perf_counter', lambda: clock['wall'])
    shown = view.View(view.Canvas(rerun.RecordingStream('test'), rerun))
    times = []

    def show() -> None:
        times.append(clock['wall'])
        clock['wall'] += 0.01

    for _ in range(1000):
        clock['wall'] += 0.01
        shown.paced('image', show)
    assert 0.01 * len(times) / clock['wall'] == pytest.approx(view.SHARE, rel=0.2)


def test_bad_targets_end_with_one_line(recording, run, tmp_path):
    done = segfloor('view', recording, '--out', tmp_path / 'view.txt')
    assert done.returncode == 2
    assert 'ends in .rrd' in done.stderr
    done = segfloor('view', tmp_path / 'nothing', '--out', tmp_path / 'view.rrd')
    assert done.returncode == 2
    assert 'nothing' in done.stderr


def test_without_rerun_one_line_says_how_to_install_it(recording, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'rerun', None)
    done = segfloor('run', recording, '--out', tmp_path / 'out', '--view', tmp_path / 'v.rrd')
    assert done.returncode == 2
    assert "pip install 'segfloor_ros[view]'" in done.stderr
    assert done.stderr.count('\n') == 1
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    ('words', 'read'),
    [
        ('run --view drive --out x', 'run --view= drive --out x'),
        ('run drive --view x.rrd', 'run drive --view x.rrd'),
        ('run drive --view', 'run drive --view='),
        ('run drive --view=x.rrd', 'run drive --view=x.rrd'),
        ('', ''),
    ],
)
def test_the_file_of_a_view_may_be_left_out(words, read):
    assert main.with_optional_values(words.split()) == read.split()


def test_the_page_is_served_on_this_machine_alone_and_ends_with_the_command(recording) -> None:
    pytest.importorskip('rerun_cli')
    environment = {k: v for k, v in os.environ.items() if not k.endswith('DISPLAY')}
    command = [sys.executable, '-m', 'segfloor_ros.apps.cli.main', 'view', str(recording)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    try:
        line = next(text for text in process.stdout if text.startswith('view: '))
        port = int(re.fullmatch(r'view: http://127\.0\.0\.1:(\d+)\?url=.*\n', line)[1])
        wait_until(lambda: port in listening())
        assert listening()[port] == {'0100007F'}  # 127.0.0.1
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(60)
    wait_until(lambda: port not in listening())


def listening() -> dict[int, set[str]]:
    """Return the ports on which this machine listens, and the addresses of each (Linux)."""
    found: dict[int, set[str]] = {}
    for name in ('tcp', 'tcp6'):
        for line in Path(f'/proc/net/{name}').read_text().splitlines()[1:]:
            _, local, _, state = line.split()[:4]
            if state == '0A':
                address, _, port = local.partition(':')
                found.setdefault(int(port, 16), set()).add(address)
    return found


def wait_until(is_so: Callable[[], bool], seconds: float = 60.0) -> None:
    end_s = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.1)
