"""Settings of the SLAM stage."""

from __future__ import annotations

import math
from dataclasses import dataclass

from segfloor_ros.settings import StageSettings, setting

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
    camera_forward_m: float = setting(
        0.0,
        'Left camera ahead of the base.',
        within=(-10.0, 10.0),
    )
    camera_left_m: float = setting(
        0.0,
        'Left camera to the left of the middle of the base.',
        within=(-10.0, 10.0),
    )
    num_features: int = setting(1000, 'Features per image, spread over it.', within=(200, 10000))
    fast_threshold: int = setting(
        7,
        'Contrast of the weakest corner; low, so that plain floors get their share.',
        unit='grey levels',
        within=(2, 60),
    )
    tracked_points: int = setting(
        400,
        'Map points, spread over the image, that are measured in a frame between keyframes.',
        within=(50, 5000),
    )
    max_speed_mps: float = setting(
        40.0,
        'A motion faster than this is implausible and ends tracking.',
        within=(0.1, 100.0),
    )
    detect_moving: bool = setting(True, 'Leave out what moves, as far as the stereo pairs show it.')
    mask_dilation_px: int = setting(
        5,
        'A mask of moving things (`dynamic_mask`, `--masks`) is widened by this much.',
        within=(0, 100),
    )
    keyframe_max_frames: int = setting(
        30, 'A new keyframe is due after this many frames (condition A1).', within=(1, 1000)
    )
    keyframe_min_frames: int = setting(
        3,
        'Frames between keyframes while the mapper is idle (condition A2).',
        within=(1, 1000),
    )
    keyframe_motion_ratio: float = setting(
        0.04,
        'Motion since the last keyframe that makes a view new: as a fraction of the median depth.',
        within=(0.001, 1.0),
    )
    keyframe_turn_rad: float = setting(
        0.06,
        'Rotation since the last keyframe that makes a view new.',
        within=(0.005, 1.0),
    )
    disparity_offset_sigma_px: float = setting(
        0.1,
        'Error that all disparities may share where the rectification is imperfect; it is '
        'estimated while driving. 0: disparities are taken as they are.',
        within=(0.0, 1.0),
    )

    @property
    def has_mount(self) -> bool:
        """Whether height, pitch and roll of the camera are all given."""
        given = (self.camera_height_m, self.camera_pitch_rad, self.camera_roll_rad)
        return not any(math.isnan(value) for value in given)
