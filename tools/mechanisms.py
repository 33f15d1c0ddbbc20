"""The mechanisms that can be left out, and how: what is patched, and what is set."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np

from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.floor.mask.filling import fill_to_contact
from segfloor_ros.core.floor.mask.pixel_evidence import FrameEvidence

ROOM = 'segfloor_ros.'
NOTHING = 'nothing'
_UPRIGHT_PX = FrameEvidence.__dict__['upright_px']


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


def _empty(*_: object, **__: object) -> list[Any]:
    return []


def _no_rows(*_: object, **__: object) -> Any:
    return np.zeros(0, np.intp)


def _none_aligned(left: Any, observations: Any, rows: Any, *_: object) -> Any:
    return _nowhere(rows)


def _found(front_end: Any, images: Any, features: Any, found: Any, expected: Any) -> Any:
    return found


def _first(value: Any, *_: object, **__: object) -> Any:
    return value


def _nowhere(like: Any, *_: object) -> Any:
    return np.zeros(like.shape, np.bool_)


def _above_anything(frame: FrameEvidence) -> Any:
    textured = dataclasses.replace(frame.pair, texture=np.full_like(frame.pair.texture, np.inf))
    return _UPRIGHT_PX.func(dataclasses.replace(frame, pair=textured))


def _begun_anywhere(frame: Any, mask: Any, alike: Any, may_begin: Any) -> Any:
    return fill_to_contact(frame, mask, alike, np.ones_like(may_begin))


SLAM: dict[str, Mechanism] = {
    NOTHING: Mechanism(),
    'deblocking': Mechanism({'core.camera.rectification.deblocked': _first}),
    'fusion of points': Mechanism({'core.slam.mapping.keyframe_mapping.fuse_duplicates': _none}),
    'place keyframes in the local map': Mechanism(
        {'core.slam.tracking.map_tracking.views_near': _no_rows}
    ),
    'alignment of patches': Mechanism(
        {'core.slam.tracking.map_tracking.align_pixels': _none_aligned}
    ),
    'following between keyframes': Mechanism(
        {'core.slam.tracking.map_tracking.Follower.follow': _none}
    ),
    'disparity offset': Mechanism({'core.slam.rig.DisparityOffset.learn': lambda *_: None}),
    'bad adjustments left out': Mechanism({'core.slam.mapping.keyframe_mapping.MAJORITY': 0.0}),
    'known views': Mechanism({'core.slam.places.views.NEARLY_ALL': 2.0}),
    'retiring of keyframes': Mechanism(
        {'core.slam.mapping.keyframe_mapping.retire_redundant': _none}
    ),
    'keyframes where few points are found': Mechanism({'core.slam.places.views.MAJORITY': 0.0}),
    'loops': Mechanism({'core.slam.mapping.back_end.BackEnd._close_loop': lambda *_: False}),
    'whole map adjusted after some loops alone': Mechanism(
        {'core.slam.mapping.back_end.GROWN': 0.0}
    ),
    'the map stays where its first keyframes came': Mechanism(
        {'core.slam.mapping.bundle_adjustment._brought_back': lambda *_: np.eye(4)}
    ),
    'places by their floor': Mechanism(
        {'core.slam.places.loops.PlaceMatcher.look_at_floor': _empty}
    ),
    'places by several views': Mechanism(
        {'core.slam.places.place_recognition.is_enough': lambda *_: True}
    ),
    'what stands around a place': Mechanism(
        {'core.plugins.maps.known_map.KnownPlaces.around': lambda *_: np.inf}
    ),
    'other places that a view fits': Mechanism(
        {'core.slam.places.loops.PlaceMatcher.agree': lambda *_: True}
    ),
    'map parts': Mechanism({'core.plugins.maps.session.LOST_NS': 1 << 62}),
    'two motions distinguished': Mechanism({'core.slam.tracking.pose.differ': lambda a, b: False}),
    'motion so far': Mechanism({'core.slam.tracking.front_end.FrontEnd._standing': _found}),
    'noise of a motion that goes on': Mechanism(
        {'core.slam.tracking.motion.Surprises.learn': _none}
    ),
    'frame to frame': Mechanism({'core.slam.tracking.frame_to_frame.FrameToFrame.find': _none}),
    'crowds of corners': Mechanism(
        {'core.slam.tracking.frame_to_frame.crowded_area_px2': lambda _, whole_px2: whole_px2}
    ),
    'images weighed against wheels': Mechanism(
        {'core.slam.tracking.front_end.FrontEnd._weighed': lambda self, track: track}
    ),
    'sensors that know more than images': Mechanism(
        {'core.slam.tracking.motion.CameraMotion.knows_more': lambda *_: False}
    ),
    'error of what a keyframe shows anew': Mechanism(
        {'core.slam.tracking.track.ObservedFeatures.known_share': 1.0}
    ),
    'bias of the gyroscope at rest': Mechanism(
        {'core.plugins.sensors.body_motion.AT_REST': (-1.0, -1.0)}
    ),
    'offset of the camera once it is known': Mechanism(
        {'core.plugins.sensors.wheel_odometry.KNOWN_M': np.inf}
    ),
    'begin again': Mechanism({'core.plugins.maps.session.HARDLY_BEGUN': -1}),
    'scene flow': Mechanism({'core.plugins.moving.scene_flow.SceneFlow._earlier': lambda *_: []}),
    'points seen through': Mechanism({'core.slam.sparse_map.PROOF': 1 << 30}),
    'search for what moves': Mechanism(settings={'detect_moving': False}),
}
"""What makes the path."""

FLOOR: dict[str, Mechanism] = {
    NOTHING: Mechanism(),
    'a bend needs a measurement': Mechanism({'core.floor.disparity.profile._LEAST_SUPPORT': 0.0}),
    'level expectation': Mechanism(
        {
            'core.floor.segmentation.expectations': lambda mount, _: np.array(
                [[mount.pitch_rad, mount.roll_rad, mount.height_m]]
            )
        }
    ),
    'swings over bumps': Mechanism({'core.floor.plane.plane.PROPOSALS': 0}),
    'guard at the right border': Mechanism({'core.floor.segmentation._BORDER_BLOCKS': 0}),
    'floor up to contacts': Mechanism(
        {'core.floor.mask.filling.fill_to_contact': lambda frame, mask, alike, _: _nowhere(alike)}
    ),
    'what the image cuts off looks like floor': Mechanism(
        {'core.floor.mask.filling.fill_to_contact': _begun_anywhere}
    ),
    'contacts with what has texture alone': Mechanism(
        {'core.floor.mask.pixel_evidence.FrameEvidence.upright_px': property(_above_anything)}
    ),
    'feet of blank faces': Mechanism(
        {'core.floor.segmentation.blank_feet': lambda *_: (np.zeros(0, np.float32), _no_rows())}
    ),
    'narrow gaps closed': Mechanism({'core.floor.scan._NARROW_M': 0.0}),
    'noise stands nowhere': Mechanism({'core.floor.segmentation._LEAST_SHARE': 0.0}),
    'boards count twice': Mechanism({'core.floor.segmentation._BOARD': 1}),
    'filling of regions': Mechanism(
        {'core.floor.segmentation.fill_regions': lambda frame, mask, *_: mask}
    ),
    'filling of gaps': Mechanism(
        {'core.floor.segmentation.fill_gaps': lambda view, profile, mask, *_: mask}
    ),
    'islands dropped': Mechanism({'core.floor.segmentation.drop_islands': _first}),
    'looks of the floor': Mechanism(
        {'core.floor.segmentation.unlike_floor': lambda image, floor: _nowhere(image)}
    ),
    'texture that is not of the floor': Mechanism(
        {'core.floor.mask.pixel_evidence._foreign': lambda left, *_: _nowhere(left)}
    ),
    'likelihood of floor': Mechanism(
        {
            'core.floor.segmentation.Likelihood.weighed': lambda self, mask, seen: (
                mask,
                _nowhere(mask),
            )
        }
    ),
    'floor beside the profile': Mechanism(
        {
            'core.floor.mask.pixel_evidence.lies_on_floor': lambda view, disparity, _: _nowhere(
                disparity
            )
        }
    ),
    'trimming to edges': Mechanism({'core.floor.segmentation.trim_to_edges': _first}),
    'what hangs at the height of the robot': Mechanism(
        {'core.floor.scan.OverheadMatcher.positions': lambda *_, **__: np.zeros((2, 0), np.float32)}
    ),
    'boards known by their ends': Mechanism(
        {'core.floor.scan._with_boards': lambda disparity, known, telling: telling}
    ),
}
"""What makes the masks and the floor scan."""

GRID: dict[str, Mechanism] = {
    'ray limit Q3 + 1.5 IQR': Mechanism(
        {'core.grid.keyframe_evidence.ray_length_limit': lambda _: 1e9}
    ),
    'rays shortened': Mechanism({'core.grid.keyframe_evidence._certain': _first}),
    'partly free edges': Mechanism(
        {'core.grid.keyframe_evidence.Fan.edges': lambda self: _nowhere(self.lengths)}
    ),
    'evidence ends where it is sure': Mechanism({'core.grid.mapper.MOST': 2.8}),
    'dilation of hits': Mechanism({'core.grid.mapper._AROUND': np.ones((1, 1), np.uint8)}),
    'slant': Mechanism(
        {'core.grid.keyframe_evidence.slant': lambda range_m, _: np.ones(len(range_m))}
    ),
    'nothing free right behind faces': Mechanism(
        {
            'core.grid.mapper.EvidenceFolder._draw_behind': lambda self, shape, placed: np.zeros(
                shape, np.uint8
            )
        }
    ),
    'shadows of what stands': Mechanism({'core.grid.keyframe_evidence.Fan.shadow': _none}),
}
"""What makes the map of masks, scans and points."""

RECORDED: dict[str, Mechanism] = {'deblocking': SLAM['deblocking']}
"""What changes the images or the mount, and so SLAM as well."""
