"""The profile of `segfloor benchmark`, for real."""

import json

import pytest
from command_line import segfloor

from segfloor_ros.apps.cli.commands import DRIVE


def run(*arguments: object) -> str:
    done = segfloor('benchmark', *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_steps_of_a_recording_are_within_their_stages():
    document = json.loads(run('--frames', 8, '--json'))
    share = {tuple(step['path']): step['share'] for step in document['steps']}
    stages = {path: whole for path, whole in share.items() if len(path) == 1}
    assert {('tracking',), ('mapping',), ('floor_segmentation',)} <= stages.keys()
    assert sum(stages.values()) == pytest.approx(1.0, abs=0.01)
    for path, whole in share.items():
        within = [s for p, s in share.items() if p[:-1] == path]
        assert sum(within) <= whole + 0.01, path
    paths = list(share)
    assert all(p[:-1] in ((), *paths[:i]) for i, p in enumerate(paths))
    calls = {tuple(step['path']): step['calls'] for step in document['steps']}
    assert calls['tracking',] == 8
    assert calls['tracking', 'by flow'] == 7
    assert calls['mapping', 'observe', 'extract'] == calls['mapping',]
    assert 'align pixels' in run(DRIVE / 'drive.mcap', '--frames', 3)
