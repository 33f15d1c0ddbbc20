"""When a frame becomes a keyframe: B and (A1 or A2 or A3) of the ORB-SLAM2 / OpenVSLAM design."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from segfloor_ros.geometry import Array, rotation_angle
from segfloor_ros.slam.settings import StereoSlamSettings

SEEN_BY_SEVERAL = 2
"""Keyframes that must observe a point for it to count as reliable."""

MUCH_NEW = 2.5
"""Novelty at which condition A2 does not count frames any more."""


@dataclass(frozen=True)
class View:
    """What the policy looks at.

    frames_since: frames since the last keyframe. num_tracked: points tracked now. num_reliable:
    points of the reference keyframe that several keyframes see. T_last_now: motion (4, 4) since
    the last keyframe. median_depth_m: of the reference keyframe's points, seen from here.
    mapper_idle: whether the mapper could take a keyframe at once.
    """

    frames_since: int
    num_tracked: int
    num_reliable: int
    T_last_now: Array
    median_depth_m: float
    mapper_idle: bool = True


def is_keyframe(view: View, settings: StereoSlamSettings) -> bool:
    """Decide by the published conditions; A1 and A2 also ask for a view that is new, so that a
    robot that stands still adds nothing.
    """
    novelty = _novelty(view, settings)
    new_view = novelty > 1
    due = view.frames_since >= settings.keyframe_min_frames or novelty > MUCH_NEW
    a1 = view.frames_since >= settings.keyframe_max_frames and new_view
    a2 = view.mapper_idle and due and new_view
    a3 = view.num_tracked < settings.keyframe_tracked_ratio * view.num_reliable
    b = view.num_tracked > settings.keyframe_min_tracked
    return b and (a1 or a2 or a3)


def _novelty(view: View, settings: StereoSlamSettings) -> float:
    """Return the motion since the last keyframe, in units of what makes a view new."""
    moved = float(np.linalg.norm(view.T_last_now[:3, 3]))
    turned = rotation_angle(view.T_last_now[:3, :3])
    near = settings.keyframe_motion_ratio * view.median_depth_m
    return max(moved / near, turned / settings.keyframe_turn_rad)
