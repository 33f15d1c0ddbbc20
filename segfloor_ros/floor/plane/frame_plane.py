"""The plane of the floor in one frame: as the camera is mounted, level in the map, or a slope that
is all there is to see.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.disparity.profile import (
    HEIGHT_SIGMA,
    PITCH_SIGMA_RAD,
    FloorLine,
    pixels_where,
)
from segfloor_ros.floor.disparity.view import column_step, rising
from segfloor_ros.floor.plane.plane_fit import (
    HEIGHT_RANGE_M,
    PlaneFit,
    Samples,
    angles_height_of,
    propose,
    refine,
    scores,
)
from segfloor_ros.geometry import Array

_SAMPLES = 4000
_SCALES_PX = (2.0, 1.5, 1.0, 0.7, 0.5, 0.5)
_FAITH = 2.0
"""So much more must speak for the second expectation than for the first."""
_NOISE_SHARE = 0.01
"""What so little of all that is seen speaks for is noise: the camera is as it is mounted."""
_SWING_RAD = math.radians(3.0)
"""So far robots swing on their wheels; what the map says beyond that is drift."""
_MAX_SLOPE_RAD = math.radians(18.0)
_SLOPE_HEIGHT = 0.35
"""By how much the camera's height above a slope ahead may differ from that above the floor."""
_SLOPE_EVERY = 4
_SLOPE_PROPOSALS = 100
_SLOPE_SIGMA = np.array([math.radians(5.0), math.radians(1.0), 0.1])
_PLAIN_SHARE = 0.4
"""So much of all that is seen must lie on a slope that nobody expects."""
_TEXTURED_SHARE = 0.1
"""So much of what is matched must have texture for a slope to be told from noise."""
_FLAT_WEIGHT = 0.1
"""Of samples whose disparity does not rise down the image as a floor's does."""


def expectations(mount: Mount, T_map_base: Array | None) -> Array:
    """Return what pitch, roll and height to expect, (P, 3), the likeliest first.

    As the camera is mounted; or, should the robot pitch or roll on its wheels, level in the map;
    or, of a camera in a hand, as high as it is in the map.
    """
    mounted = np.array([mount.pitch_rad, mount.roll_rad, mount.height_m])
    if T_map_base is None:
        return mounted[None]
    T_map_left = T_map_base @ mount.T_base_left
    # A height that nothing can have is none.
    heights_m = np.maximum((mount.height_m, T_map_left[2, 3]), HEIGHT_RANGE_M[0])
    return np.stack([mounted, *angles_height_of(T_map_left[2, :3] / heights_m[:, None])])


def plane_of_frame(
    camera: StereoCamera,
    first_row: int,
    disparity: NDArray[np.float32],
    texture: NDArray[np.float32],
    enough: float,
    expected: Array,
) -> PlaneFit:
    """Return the plane of the floor in a frame, in its own camera's axes.

    disparity, texture: (R, W) from `first_row` on, every `column_step` columns. enough: texture
    that is no noise. expected: (P, 3), as of `expectations`.
    """
    step = max(2, round(math.sqrt(disparity.size / _SAMPLES)))
    part = disparity[::step, ::step]
    rows, columns = pixels_where(part > 0)
    across = step * column_step(camera)
    grey = texture[::step, ::step][rows, columns].astype(np.float64) / (4 * enough)
    grey *= grey
    grey *= grey
    slope = FloorLine.of(camera, Mount(height_m=expected[0, 2], pitch_rad=expected[0, 0])).slope
    inclined = rising(disparity[:, ::step], slope)[::step][rows, columns]
    found = part[rows, columns].astype(np.float64)
    uv = np.stack([columns * across, rows * step + first_row], axis=1).astype(np.float64)
    samples = Samples(
        rays=camera.back_project(uv, np.ones(len(uv))),
        position_m=np.zeros(3),
        disparity_px=found,
        weight=grey / (grey + 1) * np.where(inclined, 1.0, _FLAT_WEIGHT),
        disparity_m=camera.disparity_times_depth,
    )
    likelihood = scores(samples, expected)
    slope_start = _slope_ahead(samples, likelihood.max(), expected[0])
    start = expected[likeliest(likelihood / max(samples.weight.sum(), 1e-9), expected)]
    sigma = np.array([*2 * [PITCH_SIGMA_RAD], HEIGHT_SIGMA * start[2]])
    if slope_start is not None:
        start, sigma = slope_start, _SLOPE_SIGMA
    unknown, no_travel = np.full(3, np.nan), np.zeros((0, 3))
    return refine([samples], start, unknown, no_travel, sigma, _SCALES_PX)


def likeliest(share: Array, expected: Array) -> int:
    """Return which expectation, of pitch, roll and height (P, 3), to start from, by the share (P,)
    of all that is seen that speaks for each, less what speaks against it.
    """
    swing = np.hypot(*(expected - expected[0])[:, :2].T)
    likelihood = share * np.exp(-0.5 * (swing / _SWING_RAD) ** 2)
    likelihood[0] = max(_FAITH * share[0], _NOISE_SHARE)
    return int(np.argmax(likelihood))


def _slope_ahead(samples: Samples, known_score: float, mounted: Array) -> Array | None:
    """Return pitch, roll and height (3,) above a slope that is all there is to see, as it is
    right before a ramp; None where it is not so.

    known_score: of the best expectation.
    """
    few = samples.every(_SLOPE_EVERY)
    total = few.weight.sum()
    if known_score > _PLAIN_SHARE / _FAITH * total or len(few.weight) < _SLOPE_PROPOSALS:
        return None
    if total < _TEXTURED_SHARE * len(samples.weight):
        return None
    known = np.array([math.nan, mounted[1], math.nan])
    rng = np.random.default_rng(len(few.weight))
    found = propose(few, _SLOPE_PROPOSALS, rng, known)
    ratio = found[:, 2] / mounted[2]
    near = np.abs(found[:, 0] - mounted[0]) < _MAX_SLOPE_RAD
    found = found[near & (ratio > 1 - _SLOPE_HEIGHT) & (ratio < 1 + _SLOPE_HEIGHT)]
    if len(found) == 0:
        return None
    score = scores(few, found)
    best = int(np.argmax(score))
    plain = score[best] > max(_PLAIN_SHARE * total, _FAITH * known_score)
    return found[best] if plain else None
