"""What each pixel says: floor, not floor, or nothing.

A pixel is judged by its own disparity: its height above the floor that has the same disparity.
Where there is no texture, how bright a surface is tells it from the floor around it: a black tyre,
the shade below a car. What looks like no more than a few of the floor's own pixels is floor only if
that was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.images import measured_sigma_px
from segfloor_ros.floor.disparity.matching import BLOCK_PX, MEAN_NOISE, NOISE_PX, SIGMAS, SUBPIXEL
from segfloor_ros.floor.disparity.profile import FloorLine, FloorProfile
from segfloor_ros.floor.disparity.view import FloorView
from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE, NOT_FLOOR, FloorSegmentationSettings

_MIN_DISPARITY_PX = 2.5
"""Farther floor is not judged."""
_SURE_SHARE = 1.5
"""Disparities tell a step from floor while their noise widens it by no more than this."""
_CONTACT_HEIGHT_M = 0.12
"""Up to this height an upright surface is taken to stand on the floor below it."""


_NEIGHBOURS_PX = 9
"""Heights are averaged over so wide a square; ones that are matched err together."""
_MOST_SIGMAS = np.float32(10)
_LEAST_KNOWN = 0.2

_WINDOW_SHARE = 0.25
"""Of the image's width: floor so near looks alike. A sun, a lamp and dust change it slowly."""
_FEW = 0.1
"""Where floor covers less than this share of the window, all floor of the image counts."""
_SHRINK = 4
_STEP_GREY = 1.0
"""Grey levels are whole: no surface is known better."""


@dataclass(frozen=True)
class Comparison:
    """What the images say of each pixel of a view, (R, W) bool where not said otherwise.

    floor_px: (R / 2, W') float32, the floor's disparity at half the resolution of the image.
    against: clearly more like the matched disparity than like floor. denied: the same of the
    surroundings taken together. unlike: unlike floor, whatever it is. consistent: may be floor.
    """

    floor_px: NDArray[np.float32]
    against: NDArray[np.bool_]
    denied: NDArray[np.bool_]
    unlike: NDArray[np.bool_]
    consistent: NDArray[np.bool_]


@dataclass(frozen=True)
class HeightTable:
    """Per disparity step: row: the de-rolled row of the floor. Height above the floor is
    `offset - scale * derolled row`, in metres; up, down: how much of it is still floor; noise: its
    error, one sigma. All (B,) float32, NaN at disparity 0.
    """

    row: NDArray[np.float32]
    offset: NDArray[np.float32]
    scale: NDArray[np.float32]
    up: NDArray[np.float32]
    down: NDArray[np.float32]
    noise: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        line: FloorLine,
        profile: FloorProfile,
        num_disparities: int,
        settings: FloorSegmentationSettings,
        measured: float | None = None,
    ) -> HeightTable:
        """Return the table of a profile. measured: disparity times depth of a depth camera."""
        disparity = np.arange(num_disparities * SUBPIXEL + 1) / SUBPIXEL
        disparity[0] = np.nan
        scale = line.metres_per_row / disparity
        noise_px = NOISE_PX if measured is None else measured_sigma_px(measured, disparity)
        # One pixel of disparity is this much height: the camera's height over the disparity.
        noise_m = noise_px * line.metres_per_row / line.slope / disparity
        row = profile.row_of_disparity(disparity)
        tables = (
            row,
            scale * row,
            scale,
            np.hypot(settings.step_height_m, noise_m),
            settings.drop_height_m + SIGMAS * noise_m,
            noise_m,
        )
        return cls(*(table.astype(np.float32) for table in tables))


@dataclass(frozen=True)
class Evidence:
    """mask: (R, W) uint8. Others, (R, W) bool: above: what is matched above the floor; off: what is
    matched off it, in the mean of its neighbours, farther than noise explains; odd: what does not
    look like floor.
    """

    mask: NDArray[np.uint8]
    above: NDArray[np.bool_]
    off: NDArray[np.bool_]
    odd: NDArray[np.bool_]


def judge(
    view: FloorView,
    profile: FloorProfile,
    disparity: NDArray[np.float32],
    textured: NDArray[np.bool_],
    compared: Comparison,
    table: HeightTable,
    settings: FloorSegmentationSettings,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return what the pixels (R, W) of the view say by themselves: mask, above, off of `Evidence`.

    textured: where a disparity means something; compared: what the images say of the floor. A
    disparity makes floor only where the images agree, and denies it only where they do.
    """
    # What is nearer than the table goes is no lower than what is as near as that.
    last = np.float32(len(table.row) - 1)
    index = np.minimum(disparity * np.float32(SUBPIXEL), last).astype(np.int32)
    height = table.offset.take(index) - table.scale.take(index) * view.derolled
    up = table.up.take(index)
    above = height > up
    off = above | (height < -table.down.take(index))
    # What seems to lie below the floor may be what the floor mirrors.
    sure = (textured & compared.against) | (compared.denied & above)
    near = disparity >= np.float32(_MIN_DISPARITY_PX)
    # On a sill the images contradict the floor, and show that it is a sill.
    sill = compared.against & (np.abs(height) <= np.float32(settings.step_height_m))
    sill &= up < np.float32(_SURE_SHARE * settings.step_height_m)
    floor = textured & near & ~off & (sill | ~(compared.against | compared.unlike))
    mask = np.full(disparity.shape, NO_EVIDENCE, np.uint8)
    mask[floor] = FLOOR
    mask[off & sure] = NOT_FLOOR
    low = above & sure & (height < up + np.float32(_CONTACT_HEIGHT_M))
    mask[_below_contact(view, table.row, index, low)] = NOT_FLOOR
    mask[view.derolled <= view.line.horizon] = NOT_FLOOR
    return mask, height > 0, _off_floor(height / table.noise.take(index))


def _off_floor(sigmas: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell where heights (R, W), in sigmas, are off the floor in the mean of their neighbours."""
    window = (_NEIGHBOURS_PX, _NEIGHBOURS_PX)
    known = np.isfinite(sigmas)
    share = cv2.blur(known.astype(np.float32), window)
    # One that is far off speaks for no more than a few.
    bounded = np.clip(np.where(known, sigmas, np.float32(0)), -_MOST_SIGMAS, _MOST_SIGMAS)
    mean = cv2.blur(bounded, window)
    return (np.abs(mean) > np.float32(SIGMAS * MEAN_NOISE) * share) & (share > _LEAST_KNOWN)


def _below_contact(
    view: FloorView,
    floor_row: NDArray[np.float32],
    index: NDArray[np.int32],
    low: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return the pixels between the foot of an upright surface and where it meets the floor.

    They are lower than a step but belong to the same surface: its disparity says at which row
    the floor is. floor_row: by disparity step. index: (R, W) disparity steps.
    """
    height, width = low.shape
    at = np.flatnonzero(low)
    foot = floor_row.take(index.reshape(-1).take(at))
    rows, columns = np.divmod(at.astype(np.int32), np.int32(width))
    foot -= view.shear_px.take(columns) + np.float32(view.first_row)
    end = np.clip(foot.astype(np.int32), rows, height - 1) + 1
    size = (height + 1) * width
    covered = np.zeros((height + 1, width), np.int16)
    covered[:height] = low
    ends = np.bincount(end * np.int32(width) + columns, minlength=size)
    covered -= ends.reshape(-1, width).astype(np.int16)
    return np.cumsum(covered, axis=0, dtype=np.int16)[:height] >= 2


def unlike_floor(image: NDArray[np.uint8], floor: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which pixels of an image (R, W) are darker or brighter than nearly all of the floor
    (R, W) around them.

    What is measured as floor may be a thing that is hardly higher: the mean is taken twice, the
    second time without what stood out.
    """
    grey = cv2.blur(image, (BLOCK_PX, BLOCK_PX)).astype(np.float32)
    odd: NDArray[np.bool_] = np.zeros(image.shape, np.bool_)
    for _ in range(2):
        counted = (floor & ~odd).astype(np.float32)
        if not counted.any():
            return odd
        mean, variance = _around(grey, counted)
        odd = (grey - mean) ** 2 > SIGMAS**2 * (variance + _STEP_GREY**2)
    return odd


def _around(
    grey: NDArray[np.float32], counted: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return mean and variance (R, W) of what counts around each pixel. Both change slowly: they
    are computed at a quarter of the resolution.
    """
    width, height = grey.shape[1], grey.shape[0]
    small = (max(1, width // _SHRINK), max(1, height // _SHRINK))
    side = int(_WINDOW_SHARE * small[0]) | 1
    sums = []
    for value in (counted, counted * grey, counted * grey**2):
        shrunk = cv2.resize(value, small, interpolation=cv2.INTER_AREA)
        share = cv2.blur(shrunk, (side, side), borderType=cv2.BORDER_CONSTANT)
        sums.append(share + np.float32(_FEW / counted.mean() * value.mean()))
    mean = sums[1] / sums[0]
    variance = np.maximum(sums[2] / sums[0] - mean**2, 0)
    return (
        cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR),
        cv2.resize(variance, (width, height), interpolation=cv2.INTER_LINEAR),
    )
