"""The published scenes: rendered once, mapped, scored, shown beside the published figures."""

import json
import sys

import cv2
import numpy as np
import pytest
from rich.console import Console
from stereo_drive import room_drive, write_kitti
from stereo_room import MOUNT

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.simulation.scene_file import open_scene, shipped
from segfloor_ros.apps.simulation.world import RenderingError
from segfloor_ros.core.errors import SegfloorError, SettingsError
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.nodes.configuration import resolve
from tools import benchmark_published, published_paths
from tools.benchmark_published import (
    AS_PUBLISHED,
    MODES,
    SCENES,
    as_document,
    keep,
    published_scene,
    published_table,
    run_rtabmap,
    run_scene,
    without_specks,
)
from tools.published_figures import HEADS, PUBLISHED, Row, page_table, parse_scenes
from tools.published_paths import DRIVES, PAGE_HEADS, PathRow, paths_table, run_drive
from tools.published_peers import RUNNERS, SlamRow, run_peers, run_program, slam_table

CONFIGURATION = resolve()


def test_an_unknown_scene_is_refused():
    with pytest.raises(SettingsError, match='did you mean corridor2'):
        parse_scenes('corridor1,coridor2', SCENES)


def test_recordings_alone_need_no_scene():
    assert parse_scenes('', SCENES) == []


def test_the_published_scenes_are_shipped_and_their_rows_name_a_page():
    assert set(SCENES) == {*PUBLISHED, *DRIVES} <= set(shipped())
    for name, scene in PUBLISHED.items():
        assert all(row.scene == name and 'p. ' in row.source for row in scene.rows)
        assert published_scene(name).camera.rate_hz == 15.0


def test_only_specks_within_free_floor_are_removed():
    cells = np.full((12, 16), FREE, np.int8)
    cells[:, 0] = UNKNOWN
    cells[2, 2] = OCCUPIED  # a point
    cells[5:8, 2:5] = OCCUPIED  # what an erosion removes at most
    cells[4:8, 8] = OCCUPIED  # longer
    cells[2, 8] = UNKNOWN  # a hole, nothing that stands there
    cells[10, 1] = OCCUPIED  # beside what is not known
    cells[0, 12] = OCCUPIED  # on the border
    kept = without_specks(OccupancyGrid(cells, 0.05, (0.0, 0.0))).cells
    changed = np.argwhere(kept != cells)
    assert {tuple(cell) for cell in changed.tolist()} == {
        (2, 2), *((row, column) for row in (5, 6, 7) for column in (2, 3, 4))
    }  # fmt: skip
    assert (kept[changed[:, 0], changed[:, 1]] == FREE).all()


def test_rows_are_kept_by_scene_and_system(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark_published, 'KEPT', tmp_path / 'published.json')
    keep(Row('corridor1', 'a', precision_percent=1.23456), Row('corridor2', 'a'), source='once')
    keep(
        Row('corridor1', 'a', precision_percent=99.0),
        Row('corridor1', 'b'),
        PathRow('town', next(iter(published_paths.MODES)), '', 50.0, 51.0, 90.0, 0.1, 0.03),
        SlamRow('corridor1', 'RTAB-Map', '', '', 98.76, 0.01234, 9.8, 123.4),
        SlamRow('corridor1', 'ORB-SLAM2', problem='no such file'),
        source='again',
    )
    document = json.loads((tmp_path / 'published.json').read_text())
    assert [row['source'] for row in document['rows']] == ['again', 'once', 'again']
    rows = [Row(**row) for row in document['rows']]
    assert [(row.scene, row.system) for row in rows] == [
        ('corridor1', 'a'), ('corridor2', 'a'), ('corridor1', 'b')
    ]  # fmt: skip
    assert rows[0].precision_percent == 99.0
    paths = paths_table([PathRow(**row) for row in document['paths']])
    assert '| Husky 01, S | 53.54 | 56.81 | 55.67 |' in paths
    assert '| KITTI 00 | 3662.13 | 3083.56 | 3290.67 |' in paths
    assert '| 51.00 | 50.00, 0.100 off, 90 % tracked |  |' in paths
    assert all(line.count('|') == len(PAGE_HEADS) + 1 for line in paths.splitlines())
    slam = slam_table([SlamRow(**row) for row in document['slam']])
    assert '| drive | RTAB-Map | ORB-SLAM2 |' in slam
    assert '| corridor1 | 98.8 % tracked, 12.3, 10, 123 | failed |' in slam
    assert slam.endswith('Measured: again.\n')
    page = page_table(rows)
    lines = [line.strip('| ').split(' | ') for line in page.splitlines()]
    assert lines[2][0] == 'corridor1: a' and lines[2][2] == '99.0'
    assert all(line.count('|') == len(HEADS) + 1 for line in page.splitlines())


RTABGRID = """#!{python}
import sys
from pathlib import Path
words = sys.argv[1:]
out = words[words.index('--out') + 1]
recording = Path(words[1])
if words[0] == 'slam':
    poses = [line.split() for line in (recording / 'poses.txt').read_text().splitlines()]
    times = (recording / 'times.txt').read_text().split()
    rows = [f'{{t}} {{p[3]}} {{p[7]}} {{p[11]}} 0 0 0 1' for t, p in zip(times, poses)]
    Path(out).write_text('\\n'.join(rows))
    print('rtabmap-slam frames 3 slam_nodes 7 loops 0')
else:
    assert words[words.index('--step') + 1] == '10'
    assert 'Grid/RangeMax=2' in words
    for end in ('.pgm', '.yaml'):
        text = (recording / f'map{{end}}').read_bytes()
        Path(out + end).write_bytes(text.replace(b'map.pgm', Path(out).name.encode() + b'.pgm'))
    print('rtabmap-grid frames 3 every 10 median_ms 150.0 p95_ms 3 assemble_median_ms 50.0 size')
"""


def test_the_runner_of_rtabmap_maps_the_same_drive(tmp_path):
    recording = tmp_path / 'recording'
    recording.mkdir()
    grid = OccupancyGrid(np.full((40, 60), FREE, np.int8), 0.05, (0.0, 0.0))
    benchmark_published.save_map(grid, recording / 'map.yaml')
    (recording / 'scene.yaml').write_text(
        'start_pose_world: [0, 0, 0]\nfov_x_deg: 90\nrate_hz: 10.0\ncamera_height_m: 0.21\n'
        'camera_pitch_rad: 0.12\n'
    )
    poses = [f'1 0 0 {0.1 * k} 0 1 0 0 0 0 1 {0.2 * k * k}' for k in range(12)]
    (recording / 'poses.txt').write_text('\n'.join(poses))
    (recording / 'times.txt').write_text('\n'.join(f'{0.1 * k:.1f}' for k in range(12)))
    (recording / 'base_poses.txt').write_text('0 0.5 0.5 0\n0.1 0.6 0.5 0\n')
    program = tmp_path / 'rtabgrid'
    program.write_text(RTABGRID.format(python=sys.executable))
    program.chmod(0o755)
    row = run_rtabmap(program, 'corridor1', tmp_path, lambda what, total: lambda done: None)
    assert (row.system, row.keyframes) == ('RTAB-Map, ray tracing', 7)
    assert row.update_s == pytest.approx(0.2)
    assert row.recall_all_percent > 90
    assert row.path_error_m == pytest.approx(0.0, abs=1e-6)
    assert row.peak_mb > 1
    program.write_text('#!/bin/sh\necho no such folder\nexit 3\n')
    with pytest.raises(SegfloorError, match='status 3: no such folder'):
        run_rtabmap(program, 'corridor1', tmp_path, lambda what, total: lambda done: None)


def test_other_programs_estimate_the_same_path(tmp_path):
    """Stand-ins for them write the true path of a drive, which is also mapped here."""
    frames, poses = room_drive(12)
    recording = write_kitti(tmp_path / 'room', frames)
    rows = [(pose @ MOUNT.T_base_left)[:3].ravel() for pose in poses]
    np.savetxt(recording / 'poses.txt', rows)
    for folder in ('bin', 'vocab'):
        (tmp_path / folder).mkdir()
    for program in ('rtabgrid', 'orb_kitti'):
        runner = RTABGRID.format(python=sys.executable).replace("words[0] == 'slam'", 'True')
        (tmp_path / 'bin' / program).write_text(runner)
        (tmp_path / 'bin' / program).chmod(0o755)
    stella = tmp_path / 'bin' / 'stella_kitti'
    stella.write_text('#!/bin/sh\necho vocabulary $1\nexit 3\n')
    stella.chmod(0o755)
    found = run_peers('room', recording, tmp_path, tmp_path / 'paths', lambda what, total: None)
    rows = {row.system: row for row in found}
    assert list(rows) == ['segfloor_ros', *list(RUNNERS)[:-1]]  # the last has no runner here
    for name in ('RTAB-Map', 'ORB-SLAM2'):
        assert rows[name].path_error_m == pytest.approx(0.0, abs=1e-6)
    said = (tmp_path / 'paths' / '1.log').read_text()
    assert said.strip() == 'rtabmap-slam frames 3 slam_nodes 7 loops 0'
    for row in (rows['segfloor_ros'], rows['RTAB-Map']):
        assert row.tracked_percent == 100 and row.path_error_m < 0.02
        assert row.peak_mb > 1 and row.cpu_s > 0.01
    assert 'vocabulary none' in rows['stella_vslam, no loops'].problem
    assert f'vocabulary {tmp_path}/vocab/orb.fbow' in rows['stella_vslam'].problem


@pytest.mark.slow
def test_a_scene_is_rendered_once_mapped_and_scored(tmp_path):
    steps = []

    def announce(description, total):
        steps.append((description, total))
        return lambda done: None

    def scene_result(*changes, system='segfloor_ros'):
        steps.clear()
        small = ('camera.width=160', 'camera.height=120', 'path.speed_m_s=0.35', *changes)
        scene, configuration = published_scene('corridor2', small), resolve(None, MODES[system])
        return run_scene('corridor2', scene, tmp_path, configuration, 1, announce, system)

    way = 'path.waypoints=[[0, 0], [0.6, 0]]'
    try:
        first = scene_result(way)
    except RenderingError as error:
        pytest.skip(str(error))
    frames = first.workload.items
    assert steps == [('rendering corridor2', frames), ('mapping corridor2', frames)]
    assert first.workload.tracked == frames
    assert first.row.cell_m == load_map(tmp_path / 'map.yaml').resolution_m == 0.01
    assert load_map(tmp_path / 'recording' / 'map.yaml').resolution_m == 0.01
    assert first.row.recall_seen_percent > first.row.recall_all_percent
    assert first.raw.precision.mean > 0.8
    assert first.row.keyframes == first.workload.map_updates
    assert first.row.path_error_m < 0.05
    assert load_map(tmp_path / 'map.yaml').cells.size == first.workload.cells
    assert cv2.imread(str(tmp_path / 'map_overlay.png')) is not None

    second = scene_result(way)
    assert steps == [('mapping corridor2', frames)]
    assert second.opened == first.opened

    points = scene_result(way, system=AS_PUBLISHED)
    assert steps == [('mapping corridor2', frames)]
    assert points.row.keyframes > first.row.keyframes
    assert points.row.recall_all_percent < first.row.recall_all_percent
    assert cv2.imread(str(tmp_path / 'map_as_published_overlay.png')) is not None

    other = scene_result('path.waypoints=[[0, 0], [0.5, 0]]')
    assert [description for description, _ in steps] == ['rendering corridor2', 'mapping corridor2']
    assert other.workload.items < frames

    console = Console(record=True, width=240)
    console.print(published_table([first.row]))
    text = console.export_text()
    assert '…' not in text
    row = next(line for line in text.split('\n') if ' Segfloor ' in line)
    cells = [cell.strip() for cell in row.split('│')]
    assert cells[2:5] == ['1; 220', '99.6; –/97.2', '–/0.38']
    document = json.loads(json.dumps(as_document([first], [first.row])))
    assert document['rows'][0]['scene'] == 'corridor2'
    assert document['published'][0]['system'] == 'Segfloor'


def test_the_memory_of_a_program_is_its_own_and_not_that_of_who_starts_it():
    held = bytearray(400_000_000)
    said, cpu_s, peak_mb = run_program([sys.executable, '-c', 'a = b"1" * 60_000_000; print(7)'])
    assert len(held) and said.strip() == '7'
    assert cpu_s > 0 and 60 < peak_mb < 200
    with pytest.raises(SegfloorError, match='status 3: it broke'):
        run_program([sys.executable, '-c', 'print("it broke"); raise SystemExit(3)'])


@pytest.mark.slow
def test_a_drive_is_mapped_with_and_without_what_moves(tmp_path, monkeypatch):
    """A short part of it; the whole is measured with the figures."""

    def short(name):
        small = ('camera.width=320', 'camera.height=240', 'path.waypoints=[[0, -2], [0.8, -2]]')
        return open_scene(name, small)

    monkeypatch.setattr(published_paths, 'open_scene', short)
    try:
        rows = run_drive('house', tmp_path, lambda what, total: lambda done: None)
    except RenderingError as error:
        pytest.skip(str(error))
    assert [row.system for row in rows] == list(published_paths.MODES)
    for row in rows:
        assert row.drive == 'house'
        assert row.true_length_m == pytest.approx(0.8, abs=0.05)
        assert row.length_m == pytest.approx(row.true_length_m, rel=0.05)
        assert 0 < row.frame_s < 5
    settings = [(tmp_path / f'run{k}' / 'settings.yaml').read_text() for k in (0, 1)]
    assert ['detect_moving: true' in text for text in settings] == [True, False]
