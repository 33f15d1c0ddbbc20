"""Two cameras that are not on one mount end a run with one line."""

from pathlib import Path

import numpy as np
import pytest
from camera_recordings import kitti_line, write_image
from command_line import segfloor
from stereo_drive import room_drive
from stereo_room import CAMERA

from segfloor_ros.core.plugins.rig.check import SETTLED_FRAMES


@pytest.mark.slow
def test_two_cameras_side_by_side_are_named_and_not_mapped(tmp_path: Path) -> None:
    folder, out = tmp_path / 'phones', tmp_path / 'out'
    rng = np.random.default_rng(3)
    for i, frame in enumerate(room_drive(SETTLED_FRAMES + 5, step_m=0.03)[0]):
        right = np.roll(frame.right, rng.integers(-10, 11), axis=0)
        write_image(folder / 'image_0' / f'{i:06d}.png', frame.left)
        write_image(folder / 'image_1' / f'{i:06d}.png', right)
    P = np.hstack([CAMERA.K, np.zeros((3, 1))])
    text = kitti_line('P0', P)
    P[0, 3] = -CAMERA.disparity_times_depth
    (folder / 'calib.txt').write_text(text + kitti_line('P1', P))
    said = segfloor('run', folder, '--out', out)
    assert said.returncode == 2
    (line,) = [line for line in said.stderr.splitlines() if 'no stereo camera' in line]
    assert line.startswith(f'segfloor: {folder}: ')
    assert not (out / 'trajectory.txt').exists()
    assert 'no_rig' in segfloor('info', folder, '--json').stdout
