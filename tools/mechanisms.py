"""The mechanisms that can be left out, and how: what is patched, and what is set."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np

from segfloor_ros.configuration import Configuration

ROOM = 'segfloor_ros.'
NOTHING = 'nothing'


@dataclass(frozen=True)
class Mechanism:
    """patches: by name within the package, what stands there without the mechanism. settings: of
    stereo SLAM.
    """

    patches: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)

    def left_out(self) -> ExitStack:
        """Return a context in which the mechanism is left out, as far as it is code."""
        stack = ExitStack()
        for target, value in self.patches.items():
            stack.enter_context(mock.patch(ROOM + target, value))
        return stack

    def configured(self, configuration: Configuration) -> Configuration:
        """Return a configuration without the mechanism."""
        slam = dataclasses.replace(configuration.stereo_slam, **self.settings)
        return dataclasses.replace(configuration, stereo_slam=slam)


def _none(*_: object, **__: object) -> None:
    return None


def _no_rows(*_: object, **__: object) -> Any:
    return np.zeros(0, np.intp)


def _first(value: Any, *_: object, **__: object) -> Any:
    return value


def _nowhere(like: Any, *_: object) -> Any:
    return np.zeros(like.shape, np.bool_)


SLAM: dict[str, Mechanism] = {
    NOTHING: Mechanism(),
    'deblocking': Mechanism({'camera.rectification.deblocked': _first}),
    'fusion of points': Mechanism({'slam.mapping.fuse_duplicates': _none}),
    'triangulation by motion': Mechanism({'slam.mapping.LocalMapper._partners': lambda *_: []}),
    'place keyframes in the local map': Mechanism({'slam.local_map.views_near': _no_rows}),
    'alignment of patches': Mechanism({'slam.tracking.align_pixels': _none}),
    'following between keyframes': Mechanism({'slam.following.Follower.follow': _none}),
    'disparity offset': Mechanism(settings={'disparity_offset_sigma_px': 0.0}),
    'depth check of matches': Mechanism({'slam.mapping.LocalMapper._contradicted': _no_rows}),
    'bad adjustments left out': Mechanism({'slam.mapping.MIN_KEPT_RATIO': 0.0}),
    'known views': Mechanism({'slam.places.KNOWN_SHARE': 2.0}),
    'retiring of keyframes': Mechanism({'slam.mapping.retire_redundant': _none}),
    'loops': Mechanism({'slam.back_end.BackEnd._close_loop': lambda *_: False}),
    'two motions told apart': Mechanism(
        {'slam.consensus._differ': lambda a, b: False, 'slam.consensus.KNOWN_NOISE': 1e9}
    ),
    'scene flow': Mechanism({'slam.scene_flow.SceneFlow._earlier': lambda *_: []}),
    'points seen through': Mechanism({'slam.sparse_map.GONE_AFTER': 1 << 30}),
    'search for what moves': Mechanism(settings={'detect_moving': False}),
}
"""What makes the path."""

FLOOR: dict[str, Mechanism] = {
    NOTHING: Mechanism(),
    'memory': Mechanism(
        {'floor.remembered_floor.FloorMemory.fill': lambda self, view, mask, *_: mask}
    ),
    'slope ahead': Mechanism({'floor.segmentation.FloorSegmentation._slope': _none}),
    'level expectation': Mechanism(
        {
            'floor.segmentation.FloorSegmentation._expectations': lambda self, mount, _: np.array(
                [[mount.pitch_rad, mount.roll_rad, mount.height_m]]
            )
        }
    ),
    'guard at the right border': Mechanism({'floor.segmentation._BORDER_BLOCKS': 0}),
    'floor up to contacts': Mechanism(
        {'floor.filling.fill_to_contact': lambda view, mask, alike, *_: _nowhere(alike)}
    ),
    'boards count twice': Mechanism({'floor.segmentation._BOARD': 1}),
    'filling of regions': Mechanism(
        {'floor.segmentation.fill_regions': lambda view, mask, *_: mask}
    ),
    'filling of gaps': Mechanism(
        {'floor.segmentation.fill_gaps': lambda view, profile, mask, *_: mask}
    ),
    'islands dropped': Mechanism({'floor.segmentation.drop_islands': _first}),
    'end of texture': Mechanism({'floor.segmentation.beyond_texture': _nowhere}),
    'what stands beside the left border': Mechanism(
        {'floor.segmentation.beside_something': lambda view, mask: _nowhere(mask)}
    ),
    'trimming to edges': Mechanism({'floor.segmentation.trim_to_edges': _first}),
    'what hangs at the height of the robot': Mechanism(
        {'floor.overhead.OverheadMatcher.positions': lambda *_, **__: np.zeros((2, 0), np.float32)}
    ),
}
"""What makes the masks and the floor scan."""

GRID: dict[str, Mechanism] = {
    'ray limit Q3 + 1.5 IQR': Mechanism({'grid.keyframe_evidence.ray_length_limit': lambda _: 1e9}),
    'rays shortened': Mechanism({'grid.keyframe_evidence._certain': _first}),
    'partly free edges': Mechanism({'grid.fan.Fan.edges': lambda self: _nowhere(self.lengths)}),
    'dilation of hits': Mechanism({'grid.fold._AROUND': np.ones((1, 1), np.uint8)}),
    'slant': Mechanism({'grid.keyframe_evidence.slant': lambda range_m, _: np.ones(len(range_m))}),
    'shadows of what stands': Mechanism({'grid.fan.Fan.shadow': _none}),
}
"""What makes the map of masks, scans and points."""

RECORDED: dict[str, Mechanism] = {
    'mirror': Mechanism({'floor.mount.MountEstimator._mirror': _none}),
    'deblocking': SLAM['deblocking'],
}
"""What changes the images or the mount, and so SLAM as well."""
