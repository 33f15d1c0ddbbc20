"""`tools.benchmark_slam`: recordings with a known path, and scenes rendered once per seed."""

import re
from pathlib import Path

import numpy as np
import pytest
import typer
from rich.console import Console
from stereo_drive import room_drive, write_kitti
from stereo_room import MOUNT
from typer.testing import CliRunner

from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.simulation.world import RenderingError
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.nodes.configuration import resolve
from tools.benchmark_slam import benchmark_slam, drives_table, soak_table
from tools.endless_drive import write_endless_drive
from tools.slam_drives import measure_drive
from tools.soak import Soak

FRAMES = 12

app = typer.Typer()
app.command()(benchmark_slam)


@pytest.fixture(scope='module')
def drive(tmp_path_factory) -> Path:
    """A recording in a generated room, with the true path of its camera."""
    frames, T_world_base = room_drive(FRAMES)
    folder = write_kitti(tmp_path_factory.mktemp('drives') / 'room', frames)
    T_world_left = np.array(T_world_base) @ MOUNT.T_base_left
    relative = invert(T_world_left[0]) @ T_world_left
    np.savetxt(folder / 'poses.txt', relative[:, :3].reshape(-1, 12))
    return folder


def test_a_drive_is_scored_against_its_true_path(drive) -> None:
    told: list[int] = []
    result = measure_drive('room', drive, resolve(), told.append)
    assert told == list(range(1, FRAMES + 1))
    assert (result.score.frames, result.score.tracked) == (FRAMES, 1.0)
    assert result.score.ate_rmse_m < 0.01 < result.score.path_length_m
    assert result.stages['tracking']['count'] == FRAMES
    assert result.stages['mapping']['count'] == result.keyframes
    console = Console(record=True, width=80)
    console.print(drives_table([result, result]))
    text = console.export_text()
    assert '…' not in text
    assert f'{FRAMES}/{FRAMES}' in text
    assert 'of 2 drives' in ' '.join(text.split())


def test_a_recording_without_its_true_path_is_refused(drive, tmp_path) -> None:
    with pytest.raises(InputError, match=r'poses\.txt'):
        measure_drive('room', tmp_path, resolve(), lambda done: None)
    result = CliRunner().invoke(app, ['corridr1'])
    assert isinstance(result.exception, InputError)
    assert 'corridor1' in str(result.exception)


@pytest.mark.slow
def test_scenes_are_driven_once_for_each_seed(tmp_path) -> None:
    scene = tmp_path / 'short.yaml'
    scene.write_text(
        'like: corridor2\ncamera: {width: 160, height: 120}\n'
        'path: {waypoints: [[0.1, 0.0], [0.5, 0.0]]}\n'
    )
    arguments = [str(scene), '--seeds', '2', '--workdir', str(tmp_path / 'work')]
    result = CliRunner().invoke(app, arguments)
    if isinstance(result.exception, RenderingError):
        pytest.skip(str(result.exception))
    assert result.exit_code == 0, result.output
    assert re.findall(r'short-\d', result.output) == ['short-1', 'short-2']
    recordings = [tmp_path / 'work' / f'short-{seed}' for seed in (1, 2)]
    images = [(folder / 'image_0' / '000000.png').read_bytes() for folder in recordings]
    assert images[0] != images[1]
    rendered = (recordings[0] / 'poses.txt').stat().st_mtime_ns
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert (recordings[0] / 'poses.txt').stat().st_mtime_ns == rendered


@pytest.mark.slow
def test_a_soak_goes_to_and_fro_and_its_map_does_not_grow(drive, tmp_path) -> None:
    source = open_source(StereoCameraSettings(input=str(drive)))
    path = write_endless_drive(source, tmp_path / 'drive', duration_s=48.0, rate_hz=2.0)
    endless = open_source(StereoCameraSettings(input=str(path)))
    _, truth = read_trajectory(drive / 'poses.txt')
    pipeline = make_pipeline(endless.camera, resolve())
    parts = Soak(pipeline, endless, truth).run(lambda done: None)
    assert [part.frames for part in parts] == list(range(12, 97, 12))
    assert parts[-1].tracked == 96
    assert parts[-1].minutes == pytest.approx(95 / 2 / 60)
    # The first way shows everything; the others show it again.
    assert parts[-1].keyframes == parts[0].keyframes == parts[0].views
    assert parts[-1].points == parts[0].points > 100
    assert all(part.error_m < 0.02 for part in parts)
    console = Console(record=True, width=80)
    console.print(soak_table('room', parts))
    assert '…' not in console.export_text()
