"""A recording with its truth, small enough to be mapped several times."""

from pathlib import Path

import numpy as np
import pytest
from stereo_drive import room_drive, write_kitti
from stereo_room import MOUNT

from segfloor_ros.core.geometry import invert


@pytest.fixture(scope='session')
def room(tmp_path_factory) -> Path:
    """A drive through a generated room, with the true path of its camera."""
    frames, T_world_base = room_drive(6)
    folder = write_kitti(tmp_path_factory.mktemp('recordings') / 'room', frames)
    T_world_left = np.array(T_world_base) @ MOUNT.T_base_left
    relative = invert(T_world_left[0]) @ T_world_left
    np.savetxt(folder / 'poses.txt', relative[:, :3].reshape(-1, 12))
    return folder
