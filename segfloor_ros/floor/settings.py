"""Settings of the floor segmentation stage."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.robot import RobotSettings
from segfloor_ros.settings import setting


@dataclass(frozen=True)
class FloorSegmentationSettings(RobotSettings):
    """Disparity, floor profile, mask and scan."""

    disparity_noise_px: float = setting(
        0.5,
        'Error of a disparity; widens the height tolerance of far floor.',
        unit='px',
        minimum=0.05,
        maximum=4.0,
        live=True,
    )
    min_disparity_px: float = setting(
        2.5,
        'Floor farther than where it has this disparity is not judged.',
        unit='px',
        minimum=0.5,
        maximum=32.0,
        live=True,
    )
    num_disparities: int = setting(
        0,
        'Disparities searched, a multiple of 16; 0 derives it from camera and mount.',
        unit='px',
        minimum=0,
        maximum=512,
    )
    coarse_above_px: float = setting(
        32.0,
        'Where the floor has a larger disparity, images are matched at half the resolution.',
        unit='px',
        minimum=8.0,
        maximum=512.0,
    )
    block_size_px: int = setting(
        5, 'Side of the block that is matched, odd.', unit='px', minimum=3, maximum=15
    )
    smoothness_small: int = setting(
        8, 'Penalty P1 of a disparity step of one, per pixel of the block.', minimum=1, maximum=200
    )
    smoothness_large: int = setting(
        32, 'Penalty P2 of a larger disparity step, per pixel of the block.', minimum=2, maximum=800
    )
    uniqueness_percent: int = setting(
        5, 'How much better than the second the best match must be.', minimum=0, maximum=50
    )
    left_right_tolerance_px: int = setting(
        1, 'Largest left-right difference of a disparity.', unit='px', minimum=1, maximum=8
    )
    speckle_size_px: int = setting(
        60, 'Islands of fewer pixels are dropped.', unit='px', minimum=0, maximum=2000
    )
    min_texture_grey: float = setting(
        0.2,
        'Slope of the image along a row below which a disparity says nothing.',
        unit='grey levels per px',
        minimum=0.0,
        maximum=20.0,
        live=True,
    )
    against_grey: float = setting(
        1.0,
        'By how much the images must contradict the floor to deny it, beyond their noise.',
        unit='grey levels',
        minimum=0.0,
        maximum=20.0,
        live=True,
    )
    likeness_grey: float = setting(
        3.0,
        'How much left and right may differ on the floor, beyond their noise.',
        unit='grey levels',
        minimum=0.0,
        maximum=50.0,
        live=True,
    )
    disparity_above_horizon: bool = setting(
        False, 'Match the rows above the horizon too; the floor does not need them.'
    )
    obstacle_height_m: float = setting(
        0.2,
        'An upright surface of this height is taken out before the profile is fitted.',
        unit='m',
        minimum=0.02,
        maximum=2.0,
        live=True,
    )
    profile_scale_px: float = setting(
        0.6,
        'Scale of the M-estimator of the profile.',
        unit='px',
        minimum=0.1,
        maximum=8.0,
        live=True,
    )
    pitch_sigma_rad: float = setting(
        0.006,
        'How far the pitch may swing about the mount, one sigma.',
        unit='rad',
        minimum=0.0001,
        maximum=0.2,
        live=True,
    )
    height_sigma: float = setting(
        0.01,
        'How far the camera height may swing about the mount, one sigma, as a share of it.',
        minimum=0.0001,
        maximum=0.2,
        live=True,
    )
    profile_stiffness: float = setting(
        0.02,
        'How strongly the spline resists bending.',
        minimum=0.0,
        maximum=100.0,
        live=True,
    )
    fill_gap_m: float = setting(
        0.5,
        'Gaps of this size between floor pixels are filled where nothing speaks against it.',
        unit='m',
        minimum=0.0,
        maximum=3.0,
        live=True,
    )
    fill_support: float = setting(
        0.3,
        'Part of the columns of a weakly textured region that must show floor to fill it.',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    island_share: float = setting(
        0.05,
        'Patches of floor smaller than this share of the largest are dropped.',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    scan_increment_rad: float = setting(
        0.0087266,
        'Angle between two bearings of the floor scan.',
        unit='rad',
        minimum=0.001,
        maximum=0.1,
    )
    scan_range_m: float = setting(
        0.0,
        'Longest range of the floor scan; 0 derives it from focal length and baseline.',
        unit='m',
        minimum=0.0,
        maximum=60.0,
    )
    scan_gap_m: float = setting(
        0.15,
        'A gap in the floor longer than this ends the scan.',
        unit='m',
        minimum=0.02,
        maximum=2.0,
        live=True,
    )
