"""`segfloor check` for real, on a drive through a generated room."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
import yaml
from command_line import segfloor
from junitparser import JUnitXml
from stereo_room import ROOM_MAX, ROOM_MIN

from segfloor_ros.apps.suite.description import RESULTS, Entry
from segfloor_ros.apps.suite.job import Job, do_job
from segfloor_ros.apps.suite.result_files import digest_of, unpack
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, OccupancyGrid
from segfloor_ros.nodes.map_files import save_map

SAME = ('map.pgm', 'map.yaml', 'trajectory.txt', 'labelled_cloud.ply', 'floor_masks')
SUITE = """
name: rooms
defaults:
  set: {{stereo_slam.num_features: 700}}
recordings:
  - input: {room}
    name: good
    expect: {{tracked_percent: 100, path_error_m: 0.02, return_m: 1}}
  - input: {empty}
    name: empty
    expect: {{tracked_percent: 100}}
"""


def check(*arguments) -> SimpleNamespace:
    return segfloor('check', *arguments)


def suite_of(folder: Path, room: Path, text: str = SUITE) -> Path:
    (folder / 'empty').mkdir(exist_ok=True)
    path = folder / 'suite.yaml'
    path.write_text(text.format(room=room, empty=folder / 'empty'))
    return path


def good_alone(text: str = SUITE) -> str:
    return text.partition('  - input: {empty}')[0]


@pytest.mark.slow
def test_a_suite_is_checked_kept_and_resumed(room, tmp_path):
    out, cache = tmp_path / 'out', tmp_path / 'cache'
    done = check(suite_of(tmp_path, room), '--out', out, '--cache', cache)
    # A recording that cannot be mapped fails alone.
    assert done.returncode == 1, done.stderr
    assert 'empty: ' in done.stderr
    document = JUnitXml.fromfile(str(out / 'junit.xml'))
    assert (document.tests, document.failures, document.errors, document.skipped) == (6, 0, 1, 1)
    assert '1 of 2 recordings' in (out / 'suite.html').read_text()
    assert '<h2>Time per stage</h2>' in (out / 'good' / 'report.html').read_text()
    measured = json.loads((out / 'good' / 'measured.json').read_text())['measured']
    assert measured['tracked_percent'] == 100
    assert 0 < measured['path_error_m'] < 0.02
    # Driven 0.3 m straight on.
    assert measured['return_m'] == pytest.approx(0.3, abs=0.02)
    assert measured['time_ratio'] > 0

    # The same content elsewhere is not mapped again; bounds are always looked at anew.
    copy = tmp_path / 'moved'
    shutil.copytree(room, copy)
    strict = good_alone().replace('path_error_m: 0.02', 'path_error_m: 0.000001')
    again = check(suite_of(tmp_path, copy, strict), '--out', tmp_path / 'new', '--cache', cache)
    assert again.returncode == 1
    assert 'good: fails (kept)' in again.stdout
    assert 'good: path_error_m: ' in again.stderr
    assert 'wanted at most 1e-06 m' in again.stderr
    for name in SAME:
        assert digest_of(tmp_path / 'new' / 'good' / name) == digest_of(out / 'good' / name)

    # An interrupted check goes on with what is there, without any cache.
    resumed = check(suite_of(tmp_path, room, good_alone()), '--out', out, '--resume', '--no-cache')
    assert resumed.returncode == 0, resumed.stderr
    assert 'good: ok (kept)' in resumed.stdout


@pytest.mark.slow
def test_what_became_worse_than_the_baseline_is_named(room, tmp_path):
    baseline, common = tmp_path / 'baseline.json', ('--out', tmp_path / 'out', '--no-cache')
    first = check(suite_of(tmp_path, room, good_alone()), *common, '--write-baseline', baseline)
    assert first.returncode == 0, first.stderr
    worse = good_alone().replace('700', '700, floor_segmentation.scan_range_m: 1.0')
    second = check(suite_of(tmp_path, room, worse), *common, '--baseline', baseline)
    assert second.returncode == 1
    assert 'good: known_area_m2: ' in second.stderr
    assert '(baseline ' in second.stderr


def test_what_a_check_has_found_is_printed_as_json_alone(tmp_path):
    text = 'recordings: [{{input: {empty}, name: empty, expect: {{tracked_percent: 100}}}}]'
    done = check(suite_of(tmp_path, tmp_path, text), '--out', tmp_path / 'out', '--json')
    assert done.returncode == 1
    found = json.loads(done.stdout)
    (recording,) = found.pop('recordings')
    assert found == {'name': 'suite', 'holds': False}
    assert (recording['name'], recording['state']) == ('empty', 'no map')
    assert recording['wrong'][0].startswith('empty: ')


def test_a_bad_suite_ends_with_status_2(room, tmp_path):
    path = suite_of(tmp_path, room, good_alone() + '    colour: red\n')
    done = check(path, '--out', tmp_path / 'out')
    assert done.returncode == 2
    assert f'{path}, line 9: unknown colour' in done.stderr
    assert not (tmp_path / 'out').exists()


def test_credentials_of_a_recording_are_nowhere(tmp_path):
    url = 'ftp://me:s3cret@localhost:1/night.mcap?sig=s3cret'
    path, out = tmp_path / 'suite.yaml', tmp_path / 'out'
    path.write_text(f'recordings: [{{input: "{url}"}}]')
    done = check(path, '--out', out, '--cache', tmp_path / 'cache')
    assert done.returncode == 1
    assert 'night: ftp://localhost:1/night.mcap: cannot be read' in done.stderr
    texts = [file.read_text() for file in (out, tmp_path / 'cache') for file in file.rglob('*.*')]
    assert len(texts) >= 2
    assert not [text for text in (done.stdout, done.stderr, *texts) if 's3cret' in text]


def job_of(room, tmp_path, **changes) -> Job:
    entry = Entry('room', str(room), assignments=('stereo_slam.num_features=700',), **changes)
    return Job(entry, '', str(tmp_path / 'cache'), reuse=False)


def test_what_decides_the_result_is_in_its_key(room, tmp_path):
    job = job_of(room, tmp_path)
    elsewhere = job_of('/elsewhere', tmp_path, timeout_s=7.0)
    replayed = job_of(room, tmp_path, mode='replay')
    (masks := tmp_path / 'masks').mkdir()
    keys = [job.content_digest([room]), job.content_digest([room, masks])]
    (masks / '000000.png').write_bytes(b'1')
    keys += [job.content_digest([room, masks]), replayed.content_digest([room])]
    assert len(set(keys)) == 4
    assert elsewhere.content_digest([room]) == keys[0]
    assert elsewhere.digest() != job.digest()
    # What continues another map is another one, and so is one that is continued.
    others = [dataclasses.replace(job, origin='a'), dataclasses.replace(job, origin='b'),
              dataclasses.replace(job, is_continued=True)]  # fmt: skip
    assert len({one.digest() for one in (job, *others)}) == 4


def truth_of_room(folder: Path) -> Path:
    """The true map of the room, turned by a quarter: the drive starts at (14, 11)."""
    (low_x, low_y, _), (high_x, high_y, _) = ROOM_MIN, ROOM_MAX
    cells = np.full((round(20 * (high_x - low_x)), round(20 * (high_y - low_y))), FREE, np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = OCCUPIED
    folder.mkdir()
    save_map(OccupancyGrid(cells, 0.05, (14.0 - high_y, 11.0 + low_x)), folder / 'map.yaml')
    start_pose = [14.0, 11.0, float(np.pi / 2)]
    facts = {'start_pose_world': start_pose, 'fov_x_deg': 90.0}
    (folder / 'scene.yaml').write_text(yaml.safe_dump(facts))
    return folder


def test_a_map_is_measured_where_its_drive_starts(room, tmp_path):
    truth = truth_of_room(tmp_path / 'truth')
    outcome = do_job(job_of(room, tmp_path, truth=str(truth)))
    assert outcome.problem == ''
    assert outcome.start_pose == pytest.approx((14.0, 11.0, np.pi / 2))
    assert outcome.measured['free_precision_percent'] > 99
    # What continues a map has its frame, wherever it starts itself.
    unpack(outcome.archive, tmp_path / 'run')
    entry = Entry('second', str(tmp_path / 'run'), RESULTS, truth=str(truth / 'map.yaml'))
    job = Job(entry, '', str(tmp_path / 'cache'), reuse=False)
    assert do_job(job, outcome).measured['free_precision_percent'] > 99
    assert do_job(job).measured['free_precision_percent'] < 10


def programs() -> list[psutil.Process]:
    """Return the programs that map for this process."""
    children = psutil.Process().children()
    return [c for c in children if 'segfloor_ros.apps.cli.main' in ' '.join(c.cmdline())]


def test_a_recording_that_hangs_ends_at_its_time_out(room, tmp_path):
    start_s = time.monotonic()
    outcome = do_job(job_of(room, tmp_path, timeout_s=1.0))
    assert outcome.problem == 'no map within 1 s'
    assert time.monotonic() - start_s < 60
    assert programs() == []


def test_a_program_that_crashes_is_the_problem_of_its_recording(room, tmp_path):
    outcomes = []
    worker = threading.Thread(target=lambda: outcomes.append(do_job(job_of(room, tmp_path))))
    worker.start()
    while not (mapping := programs()):
        time.sleep(0.02)
    os.kill(mapping[0].pid, signal.SIGSEGV)
    worker.join()
    assert outcomes[0].problem.endswith('(signal SIGSEGV)')


def test_what_nobody_foresaw_fails_one_recording_only(tmp_path, monkeypatch):
    monkeypatch.setattr('segfloor_ros.apps.suite.job.measure_run', lambda *_: 1 / 0)
    entry = Entry('a', str(tmp_path), RESULTS)
    outcome = do_job(Job(entry, '', str(tmp_path / 'cache'), reuse=False))
    assert outcome.problem.startswith('ZeroDivisionError: ')


def test_a_recording_is_not_taken_for_its_results(room, tmp_path, monkeypatch):
    aisle = tmp_path / 'aisle'
    shutil.copytree(room, aisle)
    before = digest_of(aisle)
    suite = suite_of(tmp_path, room, 'recordings:\n  - input: aisle\n')
    monkeypatch.chdir(tmp_path)
    for out in ('.', 'aisle', 'aisle/out'):
        done = check(suite, '--out', out)
        assert done.returncode == 2
        assert 'is, holds or lies in' in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
    assert digest_of(aisle) == before
    # Nor is a folder of somebody else by the name of a recording.
    (tmp_path / 'out' / 'aisle' / 'floor_masks').mkdir(parents=True)
    (tmp_path / 'out' / 'aisle' / 'floor_masks' / 'mine').write_text('mine')
    done = check(suite, '--out', 'out')
    assert done.returncode == 2
    assert 'out: holds files and no .segfloor_result' in done.stderr
    assert (tmp_path / 'out' / 'aisle' / 'floor_masks' / 'mine').read_text() == 'mine'


@pytest.mark.slow
def test_a_recording_that_fails_keeps_the_results_of_last_time(room, tmp_path):
    out = tmp_path / 'out'
    recording = tmp_path / 'good'
    shutil.copytree(room, recording)
    suite = suite_of(tmp_path, recording, good_alone())
    done = check(suite, '--out', out, '--no-cache')
    assert done.returncode == 0, done.stderr
    before = {path: path.read_bytes() for path in (out / 'good').rglob('*') if path.is_file()}
    (recording / 'calib.txt').rename(tmp_path / 'calib.txt')
    done = check(suite, '--out', out, '--no-cache')
    assert done.returncode == 1
    after = {path: path.read_bytes() for path in (out / 'good').rglob('*') if path.is_file()}
    marker = out / 'good' / '.segfloor_result'
    assert after.pop(out / 'good' / 'failed.txt').startswith(b'good') is False
    assert {**after, marker: b''} == {**before, marker: b''}
    assert 'good/report.html' not in (out / 'suite.html').read_text()
    # It is mapped again, though what is there is of the same job.
    (tmp_path / 'calib.txt').rename(recording / 'calib.txt')
    done = check(suite, '--out', out, '--no-cache', '--resume')
    assert done.returncode == 0, done.stderr
    assert 'good: ok (kept)' not in done.stdout
    assert not (out / 'good' / 'failed.txt').exists()
    # A link in place of a file is not written through.
    (out / 'good' / 'measured.json').unlink()
    (tmp_path / 'mine.json').write_text('mine')
    (out / 'good' / 'measured.json').symlink_to(tmp_path / 'mine.json')
    done = check(suite, '--out', out, '--no-cache')
    assert done.returncode == 2
    assert 'holds measured.json' in done.stderr
    assert (tmp_path / 'mine.json').read_text() == 'mine'


BENCHMARK = """
name: rooms
published: {{Other: 'a paper, table I; rigid alignment'}}
defaults:
  no_map: true
  set: {{stereo_slam.num_features: 700}}
recordings:
  - input: {room.name}
    published: {{Other: 0.025}}
    expect: {{path_error_m: 0.02}}
  - input: far_away
"""


@pytest.mark.slow
def test_paths_are_held_beside_published_ones_and_what_is_missing_is_said(room, tmp_path):
    suite, out = tmp_path / 'suite.yaml', tmp_path / 'out'
    suite.write_text(BENCHMARK.format(room=room))
    done = check(suite, '--out', out, '--no-cache', '--data', room.parent)
    assert done.returncode == 0, done.stderr
    assert f'far_away: is not in {room.parent}, skipped' in done.stderr
    row = next(line for line in done.stdout.splitlines() if f'{room.name} ' in line and '│' in line)
    cells = [cell.strip() for cell in row.strip('│').split('│')]
    # Tracked, our error, no map, and the published error.
    assert cells[:3] == [room.name, 'ok', '100']
    assert float(cells[3]) < 0.02
    assert cells[4:6] == ['', '']
    assert cells[-1] == '0.025'
    assert 'error m of Other: a paper, table I' in done.stdout
    assert not (out / room.name / 'map.yaml').exists()
    lengths = BENCHMARK.format(room=room) + 'published_measure: length_m\n'
    suite.write_text(lengths.replace('0.025', '0.31'))
    done = check(suite, '--out', out, '--data', room.parent)
    assert done.returncode == 0, done.stderr
    row = next(line for line in done.stdout.splitlines() if f'{room.name} ' in line and '│' in line)
    ours, true, published = (cell.strip() for cell in row.strip('│').split('│')[-3:])
    assert float(ours) == pytest.approx(float(true), rel=0.1)
    assert published == '0.31'
    assert 'length m of Other: a paper, table I' in done.stdout
