"""Options with values that nothing can be done with: one line, status 2."""

import pytest
from command_line import segfloor


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['evaluate', 'map', 'a', 'b', '--sight', 'inf'], '--sight inf: expected 0.1 to 1000'),
        (['evaluate', 'map', 'a', 'b', '--fov', 'nan'], '--fov nan: expected 1 to 360'),
        (['evaluate', 'map', 'a', 'b', '--seed', '-1'], '--seed -1: expected at least 0'),
        (['evaluate', 'map', 'a', 'b', '--nodes', '99999999'], '--nodes 99999999: expected 0 to'),
        (['calibrate', 'a', '--square', 'nan'], '--square nan: expected 1e-06 to 100'),
        (
            ['calibrate', 'a', '--square', '0.03', '--board', '²x3'],
            '--board ²x3: expected e.g. 9x6',
        ),
        (['run', 'a', '--out', 'b', '--set', 'a.b=' + '[' * 3000], 'nested too deeply'),
        (['run', 'a', '--out', 'b', '--set', 'stereo_slam.num_features=1e999'], 'larger than any'),
        (['run', 'a', '--out', 'b', '--set', 'stereo_slam.num_features=²'], '--set: stereo_slam'),
        (['simulate', 'corridor1', '--out', 'b', '--set', 'a=&a [*a]'], 'aliases that hold'),
        (['simulate', 'corridor1', '--out', 'b', '--set', 'seed=-1'], 'seed: -1 is not within 0'),
        (['simulate', 'corridor1', '--out', 'b', '--set', 'path.speed_m_s=0'], 'speed_m_s: 0 is'),
        (['simulate', 'corridor1', '--out', 'b', '--set', 'camera.width=1e6'], 'camera, width'),
        (['simulate', 'corridor1', '--out', 'b', '--set', 'camera.height_m=.nan'], 'height_m: nan'),
        (['run', 'o[red]x', '--out', 'b'], 'o[red]x: no such file or folder'),
    ],
)
def test_one_line_says_what_is_expected(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    done = segfloor(*words)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.startswith('segfloor: ')
    assert done.stderr.count('\n') == 1
    assert not list(tmp_path.iterdir())
