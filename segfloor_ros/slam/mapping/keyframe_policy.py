"""When a frame becomes a keyframe: B and (A1 or A2 or A3) of the ORB-SLAM2 / OpenVSLAM design."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from segfloor_ros.geometry import Array, rotation_angle
from segfloor_ros.slam.settings import StereoSlamSettings

SEEN_BY_SEVERAL = 2
"""Keyframes that must observe a point for it to count as reliable."""

TRACKED_RATIO = 0.25
"""Condition A3 as published: a keyframe is due when fewer of the reliable points are tracked."""

MIN_TRACKED = 15
"""Condition B as published: with fewer points the pose is too poor to make points from."""

MUCH_NEW, FEW_FOUND = 2.5, 0.5
"""Novelty, and share of the points that are found again, at which condition A2 does not count
frames any more: the next frame finds fewer still.
"""


@dataclass(frozen=True)
class View:
    """What the policy looks at.

    frames_since: frames since the last keyframe. num_tracked: points tracked now. num_reliable:
    points that several keyframes see, of the keyframe that shares most with this view. novelty: how
    far the view is from known ones, in units of what makes it new. mapper_idle: whether the mapper
    could take a keyframe at once. found_share: of the points that were looked for.
    """

    frames_since: int
    num_tracked: int
    num_reliable: int
    novelty: float
    mapper_idle: bool = True
    found_share: float = 1.0


def is_keyframe(view: View, settings: StereoSlamSettings) -> bool:
    """Decide by the published conditions; A1 and A2 also ask for a view that is new, so that a
    robot that stands still adds nothing.
    """
    new_view = view.novelty > 1
    due = view.frames_since >= settings.keyframe_min_frames
    due |= view.novelty > MUCH_NEW or view.found_share < FEW_FOUND
    a1 = view.frames_since >= settings.keyframe_max_frames and new_view
    a2 = view.mapper_idle and due and new_view
    a3 = view.num_tracked < TRACKED_RATIO * view.num_reliable
    b = view.num_tracked > MIN_TRACKED
    return b and (a1 or a2 or a3)


def novelty(T_known_now: Array, median_depth_m: float, settings: StereoSlamSettings) -> float:
    """Return the motion (4, 4) from a known view in units of what makes a view new.
    median_depth_m: of what is seen.
    """
    moved = float(np.linalg.norm(T_known_now[:3, 3]))
    turned = rotation_angle(T_known_now[:3, :3])
    return max(
        moved / (settings.keyframe_motion_ratio * median_depth_m),
        turned / settings.keyframe_turn_rad,
    )
