"""Drives of a suite in order, each in the map of the last."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from stereo_drive import room_drive, write_kitti
from test_check_command import check

STEP_M = 0.06
SUITE = """
defaults:
  set: {{stereo_slam.num_features: 700}}
recordings:
  - input: {folder}/first
  - input: {folder}/second
    continue_from: previous
  - input: {folder}/second
    name: alone
"""


def start_of(folder: Path) -> np.ndarray:
    return np.loadtxt(folder / 'trajectory.txt')[0, 1:3]


@pytest.mark.slow
def test_a_drive_goes_on_in_the_map_of_the_last(tmp_path):
    frames, _ = room_drive(12, STEP_M)
    write_kitti(tmp_path / 'first', frames[:8])
    # It begins where the first drive has been: at its fifth frame.
    second = [dataclasses.replace(f, index=i) for i, f in enumerate(frames[4:])]
    write_kitti(tmp_path / 'second', second)
    suite, out = tmp_path / 'suite.yaml', tmp_path / 'out'
    suite.write_text(SUITE.format(folder=tmp_path))
    done = check(suite, '--out', out, '--no-cache')
    assert done.returncode == 0, done.stderr
    # Three frames that agree tell where that is, and then where the first of them was.
    np.testing.assert_allclose(start_of(out / 'second'), (4 * STEP_M, 0.0), atol=0.01)
    np.testing.assert_allclose(start_of(out / 'alone'), 0.0, atol=0.03)
    area = {
        name: json.loads((out / name / 'measured.json').read_text())['measured']['known_area_m2']
        for name in ('first', 'second', 'alone')
    }
    assert area['second'] > max(area['first'], area['alone'])

    # What another drive continues is found again, and so is what continues it.
    resumed = check(suite, '--out', out, '--no-cache', '--resume')
    assert resumed.stdout.count('(kept)') == 3
    (out / 'second' / 'measured.json').unlink()
    again = check(suite, '--out', out, '--no-cache', '--resume')
    assert again.stdout.count('(kept)') == 2
    # Three frames that agree tell where that is, and then where the first of them was.
    np.testing.assert_allclose(start_of(out / 'second'), (4 * STEP_M, 0.0), atol=0.01)
