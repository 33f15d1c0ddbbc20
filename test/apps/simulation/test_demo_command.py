"""`segfloor demo` and `segfloor simulate` as a user runs them."""

import base64
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from segfloor_ros.apps.cli.commands import DRIVE, demo
from segfloor_ros.apps.cli.commands import simulate as simulate_command
from segfloor_ros.apps.evaluation.maps import load_truth
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.simulation.world import RenderingError
from segfloor_ros.core.camera.settings import StereoCameraSettings

app = typer.Typer()
app.command('demo')(demo)
app.command('simulate')(simulate_command)

SMALL = ('camera.width=160', 'camera.height=120', 'path.waypoints=[[-0.3, 0], [0.3, 0]]')


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if isinstance(result.exception, RenderingError):
        pytest.skip(str(result.exception))
    assert result.exit_code == 0, (result.output, result.exception)
    return result.output


def simulate(out, *options):
    settings = [word for value in SMALL for word in ('--set', value)]
    return run('simulate', 'corridor2', '--out', out, *settings, *options)


@pytest.fixture(scope='module')
def files(tmp_path_factory):
    """A small drive as files."""
    folder = tmp_path_factory.mktemp('simulated') / 'files'
    assert 'pairs, 0.6 m' in simulate(folder)
    return folder


def test_the_demo_drive_is_small_and_complete():
    assert sum(file.stat().st_size for file in DRIVE.iterdir()) < 15e6
    truth = load_truth(DRIVE)
    source = open_source(StereoCameraSettings(input=str(DRIVE / 'drive.mcap')))
    assert len(truth.base_poses) == source.frame_count == 273


def test_a_scene_is_rendered_again_beside_the_folder_that_came_of_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        found = json.loads(simulate('corridor2', '--json'))
        assert found['path_m'] == pytest.approx(0.6, abs=0.01)
        assert len(list((tmp_path / 'corridor2' / 'image_0').iterdir())) == found['pairs']


@pytest.mark.slow
def test_demo_maps_and_scores(tmp_path):
    output = run('demo', '--lockstep', '--out', tmp_path / 'demo').split('\n')
    assert Path(output[-2]) == tmp_path / 'demo' / 'report.html'
    assert cv2.imread(str(tmp_path / 'demo' / 'overlay.png')).shape[2] == 3
    page = (tmp_path / 'demo' / 'report.html').read_text()
    assert set(re.findall(r'(?:src|href)="([a-z]+:)', page)) == {'data:'}
    for heading in ('Against the truth', 'Map', 'Keyframes', 'Floor profile', 'Time per stage'):
        assert f'<h2>{heading}</h2>' in page
    # Nothing moves here. Map, overlay, cloud, v-disparity, memory and six keyframes, each a
    # whole picture.
    pictures = re.findall(r'src="data:image/\w+;base64,([^"]+)"', page)
    sizes = [cv2.imdecode(np.frombuffer(base64.b64decode(p), np.uint8), 1).shape for p in pictures]
    assert len(sizes) == 11
    assert min(min(height, width) for height, width, _ in sizes) > 200
    path = next(line for line in output if line.startswith('path: '))
    assert '7.8 m, 100.0 % of the frames tracked' in path
    free = next(line for line in output if 'free cells' in line).split('│')
    # Measured: 99.1 and 97.4 of the free cells, 99.8 and 97.0 of the occupied ones.
    assert float(free[2]) > 98.5
    assert float(free[3]) > 95.0
    occupied = next(line for line in output if 'occupied cells' in line).split('│')
    assert float(occupied[2]) > 98.5
    assert float(occupied[3]) > 94.0


def test_finer_rendering_is_another_picture_of_the_same(files, tmp_path):
    noiseless = ('--set', 'camera.noise_sigma=0', '--set', 'path.waypoints=[[0, 0], [0.1, 0]]')
    images = []
    for finer in (1, 3):
        simulate(tmp_path / f'{finer}', *noiseless, '--supersampling', finer)
        images.append(cv2.imread(str(tmp_path / f'{finer}' / 'image_0' / '000000.png'), -1))
    off = cv2.absdiff(*images)
    assert 0.5 < off.mean() < 10 and off.max() > 20


def test_simulate_writes_a_folder_that_can_be_read(files):
    source = open_source(StereoCameraSettings(input=str(files)))
    assert source.calibration.camera.fx == pytest.approx(80.0)
    frames = list(source.frames())
    assert len(frames) == len(load_truth(files).base_poses)
