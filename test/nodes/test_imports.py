"""What the processes of the nodes carry along."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.programs import program_of
from segfloor_ros.core.geometry import quaternions_of
from segfloor_ros.core.quaternions import rotations_of

USE = """
import sys
import numpy as np
import {node}
from segfloor_ros.nodes.messages.poses import PathMessages, path_arrays, pose_array, pose_message
from segfloor_ros.core.contracts import KeyframePath, Mount
Mount.from_transform(Mount(0.3, 0.1).T_base_left)
pose_array(pose_message(np.eye(4)))
path_arrays(PathMessages('map').next(1, KeyframePath(np.array([1]), np.eye(4)[None])))
packages = {{name.partition('.')[0] for name in sys.modules}}
print(sorted(packages & {{'scipy', 'matplotlib', 'rosbags'}}))
"""


@pytest.mark.parametrize(
    'node', ['stereo_camera', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid']
)
def test_a_node_does_without_large_libraries_that_it_does_not_need(node) -> None:
    """SciPy takes 20 MB of every process that imports it."""
    command = [sys.executable, '-c', USE.format(node=program_of(node))]
    found = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert found.stdout.strip() == '[]', found.stderr


def test_quaternions_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    half_turns = [[0, 0, np.pi], [0, np.pi, 0], [np.pi, 0, 0], [np.pi - 1e-9, 0, 0], [0, 0, 0]]
    rotations = Rotation.from_rotvec(np.vstack([rng.normal(size=(200, 3)) * 2, half_turns]))
    found, expected = quaternions_of(rotations.as_matrix()), rotations.as_quat()
    assert (found[:, 3] >= 0).all()
    np.testing.assert_allclose(np.abs((found * expected).sum(axis=1)), 1.0, atol=1e-12)
    np.testing.assert_allclose(rotations_of(3 * expected), rotations.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotations_of(found), rotations.as_matrix(), atol=1e-12)
    assert quaternions_of(np.zeros((0, 3, 3))).shape == (0, 4)
