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
