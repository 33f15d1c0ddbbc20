"""The settings of stereo SLAM."""

from __future__ import annotations

import math
from dataclasses import dataclass

from segfloor_ros.core.settings import StageSettings, setting

NAN = float('nan')


@dataclass(frozen=True)
class StereoSlamSettings(StageSettings):
    """Features, tracking, keyframes, bundle adjustment and the camera's mount."""

    camera_height_m: float = setting(
        NAN,
        'Height of the left camera above the floor; not a number: measured from the floor seen.',
        within=(0.02, 10.0),
    )
    camera_pitch_rad: float = setting(
        NAN,
        'Pitch of the camera, positive looks down; not a number: measured from the floor seen.',
        within=(-1.4, 1.4),
    )
    camera_roll_rad: float = setting(
        NAN,
        'Roll of the camera, positive to its right; not a number: measured from the floor seen.',
        within=(-0.8, 0.8),
    )
    camera_forward_m: float = setting(0.0, 'Left camera ahead of the base.', within=(-10.0, 10.0))
    camera_left_m: float = setting(
        0.0, 'Left camera to the left of the middle of the base.', within=(-10.0, 10.0)
    )
    num_features: int = setting(1000, 'Features per image, spread over it.', within=(200, 10000))
    fast_threshold: int = setting(
        7,
        'Contrast of the weakest corner; low, so that plain floors get their share.',
        unit='grey levels',
        within=(2, 60),
    )
    max_speed_mps: float = setting(
        40.0, 'A motion faster than this is implausible and ends tracking.', within=(0.1, 100.0)
    )
    detect_moving: bool = setting(True, 'Leave out what moves, by the stereo pairs alone.')
    keyframe_max_frames: int = setting(
        30, 'A new keyframe is due after this many frames (condition A1).', within=(1, 1000)
    )
    keyframe_novelty: float = setting(
        1.0,
        'Motion that makes a view new, 1 being 4 % of the distance of what is seen, or 3.4 deg; '
        'smaller makes more keyframes.',
        within=(0.01, 10.0),
    )

    @property
    def has_mount(self) -> bool:
        """Whether height, pitch and roll of the camera are all given."""
        given = (self.camera_height_m, self.camera_pitch_rad, self.camera_roll_rad)
        return not any(math.isnan(value) for value in given)
