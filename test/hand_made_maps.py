"""Small maps made by hand: keyframes that see given points."""

from dataclasses import replace

import numpy as np

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.geometry import make_transform
from segfloor_ros.core.slam.rig import Observations, Rig
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.slam.tracking.images import Features
from segfloor_ros.core.slam.tracking.patch_alignment import SIDE_PX

CAMERA = StereoCamera(640, 480, 300.0, 300.0, 319.5, 239.5, 0.1)
"""f b = 30 px m: at 2 m a disparity of 15 px."""

RNG = np.random.default_rng(3)

SCENES = {
    # A wall at 2 m.
    'wall': np.array(
        [[x, y, 2.0] for x in (-1.0, -0.3, 0.4, 1.1) for y in (-0.6, -0.3, -0.1, 0.2, 0.5, 0.9)]
    ),
    # The floor 0.4 m below the camera.
    'floor': np.stack(
        [RNG.uniform(-1, 1, 24), np.full(24, 0.4), np.linspace(1.0, 3.4, 24)], axis=1
    ),
}

WALL = np.stack([np.linspace(-0.5, 0.5, 10), np.zeros(10), np.full(10, 2.0)], axis=1)
"""Ten points at z = 2."""


def keyframe(index, point_id, x=0.0):
    count = len(point_id)
    found = Features(
        np.zeros((count, 2), np.float32),
        np.zeros(count, np.uint8),
        np.full((count, 32), index, np.uint8),
    )
    return KeyframeRecord(
        index,
        10 * index,
        1000 * index,
        make_transform(np.eye(3), np.array([-x, 0.0, 0.0])),
        found,
        found.octave,
        Observations(np.zeros((count, 3)), np.ones((count, 3))),
        np.array(point_id, np.int32),
    )


def add(sparse_map, record, new_rows=(), new_xyz=()):
    patches = np.full((len(record.point_id), SIDE_PX, SIDE_PX), record.index, np.uint8)
    new_xyz = np.array(new_xyz, np.float64).reshape(-1, 3)
    sparse_map.add_keyframe(record, patches, np.array(new_rows, np.intp), new_xyz)


def seen(points, index, point_id, x=0.0):
    """A keyframe at x that sees points where they are."""
    record = keyframe(index, point_id, x)
    uvr = CAMERA.project(points - [x, 0.0, 0.0])
    uvd = np.stack([uvr[:, 0], uvr[:, 1], uvr[:, 0] - uvr[:, 2]], axis=1)
    return replace(record, observations=Observations(uvd, np.full((len(points), 3), 0.5)))


def row_of_views(count, ids, spacing_m, xyz=WALL):
    """A map whose keyframes stand side by side and see the points `ids` of ten."""
    sparse_map = SparseMap(Rig(CAMERA))
    add(sparse_map, keyframe(0, [NO_POINT] * 10), np.arange(10), xyz)
    for index in range(1, count):
        add(sparse_map, keyframe(index, ids, x=spacing_m * index))
    return sparse_map
