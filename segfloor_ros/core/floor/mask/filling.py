"""Floor where the image alone cannot tell: between floor, where the picture goes on alike, and up
to the base of what stands on it.

Plain floor shows nothing that both cameras see alike, but what stands behind it does: an upright
surface has the disparity of the floor on which it stands. Where a plain stretch that begins with
floor, or at the lower edge of the image with what mostly looks like it, ends at such a surface, and
at the row where that surface meets the floor, all of it is floor.

How far what a network calls floor can be believed: as often as geometry agreed so far.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.floor.disparity.matching import SAME_PX, SIGMAS
from segfloor_ros.core.floor.disparity.profile import (
    STEP_PX,
    FloorProfile,
    FloorView,
    histogram,
    pixels_where,
)
from segfloor_ros.core.floor.mask.painting import enlarged, with_floor, without_floor
from segfloor_ros.core.floor.mask.pixel_evidence import FrameEvidence, below_floor, last_evidence
from segfloor_ros.core.floor.pair import EDGE_SLOPE, TEXTURE_WINDOW_PX

_MIN_REGION_PX = 15
_MIN_COLUMNS = 0.3
"""Part of the columns of a region that must show floor for it to be filled."""
_GAP_M = 0.5
"""Gaps of this size between floor pixels are filled where nothing speaks against it."""
_ISLAND_SHARE = 0.05
"""Patches of floor smaller than this share of the largest are dropped."""
_MIN_SLOPE = 1.5
"""Grey levels per pixel at half resolution; weaker edges bound no region."""
_STRONG_SLOPE = 10.0
"""Stronger edges than this are the border of something."""

_BEHIND = 0.6
"""The wall behind may show this share of the disparity: the ground may dip, the pitch err."""
_EDGE_ROWS = 4
"""So near to the end of the floor is the edge at which it ends."""
_SETTLED_ROWS = 9
"""So far above an edge, what is measured over a window does not know of it."""
_LEAST_BLANK_ROWS = 3

TRUSTED = 0.9
"""Probability that what a network calls floor is floor, from which on it counts where nothing is
measured."""


def fill_regions(
    frame: FrameEvidence, mask: NDArray[np.uint8], odd: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Return the mask with NO_EVIDENCE turned to floor in regions that look alike and continue
    floor.

    odd: (R, W), what does not look like floor: there no region goes on. A region is bounded by
    edges of the image stronger than most of the floor's own; floor by evidence must be in a share
    of its columns. In it a pixel becomes floor below floor, the next evidence up its column; or
    between floor on its left and right; or, if it is not blank and not measured above the floor,
    nearer than any of its floor.
    """
    half, slope = frame.view.half, frame.pair.picture_slope
    small = mask[half]
    floor = small == FLOOR
    if np.count_nonzero(floor) < _MIN_REGION_PX:
        return mask
    own = slope.take(np.flatnonzero(floor)[::7])
    limit = max(_MIN_SLOPE, float(np.percentile(own, 90)))
    agreed = frame.compared.consistent[half]
    alike = (small != NOT_FLOOR) & agreed & (slope < limit)
    core = cv2.erode(alike.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, region = cv2.connectedComponents(core, connectivity=4)
    top = _top_of_supported(region, count, floor)
    highest = -cv2.dilate(-top[region].astype(np.float32), np.ones((3, 3), np.uint8))
    margin = np.ones(2 * (TEXTURE_WINDOW_PX // STEP_PX + 2,), np.uint8)
    not_blank = cv2.erode(frame.pair.textured[half].astype(np.uint8), margin)
    rows = np.arange(small.shape[0], dtype=np.float32)[:, None]
    inside = (highest < small.shape[0]) & alike & (small == NO_EVIDENCE)
    nearer = (rows >= highest) & (not_blank > 0) & ~(frame.heights.mean_sigmas[half] > SIGMAS)
    left, right = last_evidence(small, 1)[1], last_evidence(small[:, ::-1], 1)[1][:, ::-1]
    next_to_floor = left & right | below_floor(small)
    fill = inside & (nearer | next_to_floor) & ~odd[half]
    mask = with_floor(mask, enlarged(fill, mask))
    # Light on the floor is no border, where both ends of a stretch are known.
    no_border = agreed & (slope < _STRONG_SLOPE)
    to_contact = fill_to_contact(frame, mask, no_border, ~odd[half])
    return with_floor(mask, enlarged(to_contact, mask))


def _top_of_supported(
    region: NDArray[np.int32], count: int, floor: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Return the topmost row (count,) with floor of each region, the number of rows where it has
    too little.
    """
    rows, columns = pixels_where(floor)
    owner = region[rows, columns]
    first = np.full(count, len(region), np.intp)
    first[owner[::-1]] = rows[::-1]  # the topmost comes last
    shape = count, region.shape[1]
    counts = histogram(owner, columns, shape), histogram(region, np.arange(shape[1]), shape)
    with_floor, wide = (np.count_nonzero(part, axis=1) for part in counts)
    is_wide = with_floor >= _MIN_COLUMNS * wide
    is_large = np.bincount(owner, minlength=count) >= _MIN_REGION_PX
    is_large[0] = False
    return np.where(is_large & is_wide, first, len(region))


def fill_gaps(
    view: FloorView, profile: FloorProfile, mask: NDArray[np.uint8], consistent: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Return the mask with NO_EVIDENCE turned to floor along rows, between two floor pixels that
    are near enough to each other, where the images do not contradict the floor (`consistent`).
    """
    disparity = np.nan_to_num(profile.at_rows(np.arange(len(mask)) + view.first_row))
    longest = _GAP_M * view.camera.fx / view.camera.disparity_times_depth * disparity / view.step
    # All rows in turn, each between two columns that are no floor.
    bordered = np.pad(mask, ((0, 0), (1, 1)), constant_values=NOT_FLOOR)
    known = np.flatnonzero(bordered != NO_EVIDENCE)
    gaps = np.flatnonzero(np.diff(known) > 1)
    before, behind = known[gaps], known[gaps + 1]
    across = behind - before
    fill = (bordered.take(behind) == FLOOR) & (bordered.take(before) == FLOOR)
    fill &= across <= longest[before // bordered.shape[1]]
    steps = np.zeros(bordered.size, np.int8)
    steps[before[fill] + 1], steps[behind[fill]] = 1, -1
    filled = np.cumsum(steps, dtype=np.int8).reshape(bordered.shape)[:, 1:-1] > 0
    return with_floor(mask, filled & consistent)


def drop_islands(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the mask without patches of floor smaller than a share of the largest."""
    small = (mask[::STEP_PX, ::STEP_PX] == FLOOR).astype(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(small, connectivity=8)
    area = stats[1:, cv2.CC_STAT_AREA]
    is_small = np.append(False, area < _ISLAND_SHARE * area.max(initial=0))
    return without_floor(mask, enlarged(is_small[label], mask))


def trim_to_edges(mask: NDArray[np.uint8], slope: NDArray[np.int16]) -> NDArray[np.uint8]:
    """Return the mask (R, W) without floor that only borrowed its texture from the floor below it.
    slope: `row_slope` of the image (R, W).

    Texture is measured over a window, so below a blank wall floor reaches some rows too high. There
    it is cut off at the strongest edge between the two, and where there is none, where the texture
    is its own.
    """
    reach_px = TEXTURE_WINDOW_PX // 2 + 3
    floor = (mask == FLOOR).astype(np.uint8)
    nothing = (mask == NO_EVIDENCE).astype(np.uint8)
    upward = np.ones((reach_px + 1, 1), np.uint8)
    below_blank = cv2.dilate(nothing, upward, anchor=(0, reach_px)) & floor
    if not below_blank.any():
        return mask
    slope = np.where(below_blank > 0, slope, np.int16(0))
    strongest = cv2.dilate(slope, np.ones((2 * reach_px + 1, 1), np.uint8))
    edge = ((slope == strongest) & (slope >= EDGE_SLOPE)).astype(np.uint8)
    under_edge = cv2.dilate(edge, upward, anchor=(0, reach_px))
    return without_floor(mask, (below_blank > 0) & (under_edge == 0))


def fill_to_contact(
    frame: FrameEvidence,
    mask: NDArray[np.uint8],
    alike: NDArray[np.bool_],
    may_begin: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return where plain floor goes on up to the foot of something upright.

    mask: (R, W). alike, may_begin: where nothing borders, and what most of a stretch must be if no
    floor is seen nearer, at half the resolution in both directions of the image, the shape of the
    result.
    """
    small = mask[frame.view.half]
    open_ = alike & (small == NO_EVIDENCE)
    if not open_.any():
        return open_
    upright_px, floor_px = frame.upright_px, frame.compared.floor_px
    nearest, farthest = floor_px + np.float32(SAME_PX), np.float32(_BEHIND) * floor_px
    contact = (upright_px < nearest) & (upright_px > farthest - np.float32(SAME_PX))
    bounds = np.where(open_, np.uint8(NO_EVIDENCE), np.where(small == FLOOR, small, NOT_FLOOR))
    above = np.maximum(last_evidence(bounds)[0], 0)
    below, starts = (part[::-1] for part in last_evidence(bounds[::-1]))
    cut_off = open_ & (below < 0)
    columns = 2 * (cut_off & may_begin).sum(axis=0) > cut_off.sum(axis=0)
    return open_ & (starts | (cut_off & columns)) & np.take_along_axis(contact, above, axis=0)


def blank_feet(
    frame: FrameEvidence, mask: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return rows and columns (N,) of the view where blank faces stand on the floor of a mask
    (R, W).

    Such a face shows nothing but where it begins: up a column the floor ends at an edge of the
    image, and from there to the horizon there is no texture, and no other edge. Beyond a shadow or
    a blank patch the floor goes on, and ends at another edge.
    """
    height, width = mask.shape
    view, slope, columns = frame.view, frame.pair.slope, np.arange(width)
    top = (mask == FLOOR).argmax(axis=0)
    near = np.clip(top + np.arange(-_EDGE_ROWS, _EDGE_ROWS + 1)[:, None], 1, height - 2)
    edge = np.take_along_axis(near, slope[near, columns].argmax(axis=0)[None], axis=0)[0]
    # Weaker edges, too, show that more than one face is seen.
    seen = (frame.pair.textured | (slope >= EDGE_SLOPE * 2 // 3)).cumsum(axis=0, dtype=np.int16)
    horizon = np.clip(np.rint(view.line.horizon - view.shear_px - view.first_row), 0, height - 1)
    end = edge - _SETTLED_ROWS
    begin = horizon.astype(np.intp)
    blank = (end - begin >= _LEAST_BLANK_ROWS) & (mask[top, columns] == FLOOR)
    blank &= seen[np.maximum(end, 0), columns] == seen[begin, columns]
    found = np.flatnonzero(blank & (slope[edge, columns] >= EDGE_SLOPE))
    rows = edge[found]
    before, at, after = (slope[rows + i, found].astype(np.float32) for i in (-1, 0, 1))
    bend = np.maximum(2 * at - before - after, 1)
    return rows + np.clip((after - before) / (2 * bend), -0.5, 0.5), found


class NetworkFloor:
    """Compares what a network calls floor with what is measured, keyframe by keyframe."""

    def __init__(self) -> None:
        self._agreed = 0.0
        self._keyframes = 0

    @property
    def probability(self) -> float:
        """That what the network calls floor is floor, by the rule of succession (Laplace): one
        half before anything is known.
        """
        return (self._agreed + 1) / (self._keyframes + 2)

    @property
    def is_trusted(self) -> bool:
        """Whether it counts."""
        return self.probability > TRUSTED

    @property
    def remark(self) -> str:
        """What is wrong with the network, in words, once that is certain."""
        if self.is_trusted or self._keyframes * (1 - TRUSTED) < 1:
            return ''
        share = self._agreed / self._keyframes
        return f'of what the network calls floor {100 * share:.0f} % is: it is not used as floor'

    def note(self, said: NDArray[np.uint8], measured: NDArray[np.uint8]) -> None:
        """Compare what is said (R, W) of a keyframe with its mask (R, W) without the network."""
        decided = measured[(said == FLOOR) & (measured != NO_EVIDENCE)]
        if len(decided):
            self._agreed += float((decided == FLOOR).mean())
            self._keyframes += 1
