"""Settings of the SLAM stage."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.settings import StageSettings, setting

NAN = float('nan')


@dataclass(frozen=True)
class StereoSlamSettings(StageSettings):
    """Features, tracking, keyframes, bundle adjustment and the camera's mount."""

    camera_height_m: float = setting(
        NAN,
        'Height of the left camera above the floor; not a number: measured from the floor seen.',
        unit='m',
        minimum=0.02,
        maximum=10.0,
    )
    camera_pitch_rad: float = setting(
        NAN,
        'Pitch of the camera, positive looks down; not a number: measured from the floor seen.',
        unit='rad',
        minimum=-1.4,
        maximum=1.4,
    )
    camera_roll_rad: float = setting(
        NAN,
        'Roll of the camera, positive to its right; not a number: measured from the floor seen.',
        unit='rad',
        minimum=-0.8,
        maximum=0.8,
    )
    camera_forward_m: float = setting(
        0.0,
        'Left camera ahead of the base.',
        unit='m',
        minimum=-10.0,
        maximum=10.0,
    )
    camera_left_m: float = setting(
        0.0,
        'Left camera to the left of the middle of the base.',
        unit='m',
        minimum=-10.0,
        maximum=10.0,
    )
    num_features: int = setting(
        1000, 'Features per image, spread over it.', minimum=200, maximum=10000
    )
    cell_size_px: int = setting(
        16,
        'Side of the image cells over which features are spread.',
        unit='px',
        minimum=8,
        maximum=128,
    )
    fast_threshold: int = setting(
        7,
        'Contrast of the weakest corner; low, so that plain floors get their share.',
        unit='grey levels',
        minimum=2,
        maximum=60,
    )
    pyramid_levels: int = setting(8, 'Levels of the image pyramid.', minimum=1, maximum=12)
    pyramid_scale: float = setting(
        1.2, 'Scale between two pyramid levels.', minimum=1.05, maximum=2.0
    )
    match_radius_px: float = setting(
        15.0,
        'Search radius around a predicted pixel, at the finest pyramid level.',
        unit='px',
        minimum=2.0,
        maximum=100.0,
    )
    max_hamming: int = setting(
        80,
        'Largest Hamming distance of a match, of 256 bits.',
        unit='bits',
        minimum=20,
        maximum=128,
    )
    min_tracked: int = setting(
        20, 'Fewest inlier matches for a pose to be believed.', minimum=6, maximum=500
    )
    recovery_ratio: float = setting(
        0.15,
        'After tracking was lost, share of the points expected in view that must be found.',
        minimum=0.0,
        maximum=1.0,
    )
    tracked_points: int = setting(
        400,
        'Map points, spread over the image, that are measured in a frame between keyframes.',
        minimum=50,
        maximum=5000,
    )
    max_speed_mps: float = setting(
        40.0,
        'A motion faster than this is implausible and ends tracking.',
        unit='m/s',
        minimum=0.1,
        maximum=100.0,
    )
    max_turn_radps: float = setting(
        6.0,
        'A rotation faster than this is implausible and ends tracking.',
        unit='rad/s',
        minimum=0.1,
        maximum=50.0,
    )
    keyframe_max_frames: int = setting(
        30, 'A new keyframe is due after this many frames (condition A1).', minimum=1, maximum=1000
    )
    keyframe_min_frames: int = setting(
        3,
        'Frames between keyframes while the mapper is idle (condition A2).',
        minimum=1,
        maximum=1000,
    )
    keyframe_tracked_ratio: float = setting(
        0.25,
        'A keyframe is due when fewer of the reliable points are tracked (condition A3).',
        minimum=0.0,
        maximum=1.0,
    )
    keyframe_min_tracked: int = setting(
        15, 'No keyframe with fewer tracked points (condition B).', minimum=6, maximum=500
    )
    keyframe_motion_ratio: float = setting(
        0.04,
        'Motion since the last keyframe that makes a view new: as a fraction of the median depth.',
        minimum=0.001,
        maximum=1.0,
    )
    keyframe_turn_rad: float = setting(
        0.06,
        'Rotation since the last keyframe that makes a view new.',
        unit='rad',
        minimum=0.005,
        maximum=1.0,
    )
    disparity_offset_sigma_px: float = setting(
        0.1,
        'Error that all disparities may share where the rectification is imperfect; it is '
        'estimated while driving. 0: disparities are taken as they are.',
        unit='px',
        minimum=0.0,
        maximum=1.0,
    )
    local_keyframes: int = setting(
        10, 'Keyframes that move in a local bundle adjustment.', minimum=2, maximum=50
    )
    fixed_keyframes: int = setting(
        10, 'Keyframes held fixed around a local bundle adjustment.', minimum=1, maximum=50
    )
    bundle_iterations: int = setting(
        5, 'Steps of a local bundle adjustment.', minimum=1, maximum=50
    )
