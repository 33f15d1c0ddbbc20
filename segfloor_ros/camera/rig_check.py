"""What is wrong with a stereo rig, told from its images alone.

Points of the left image are found in the right one and in the left one before. In images that are
rectified and taken together, both eyes have a point in one row. Row differences that depend on the
place in the image are those of a wrong rectification: offset, roll, focal length. Those that grow
with the motion of the points along the columns are those of a lag between the eyes. Measured depth
has edges where the image has them.

Whether measured depth belongs to its image is seen by edges: things end in the depth where they
end in the image. The edges of the depth are laid over those of
the image, shifted, larger or smaller, and moved as the image moved within a lag: where they fit
best is how depth and image lie to each other, in space and in time.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.images import is_disparity
from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.geometry import Array

EVERY = 10
RECENT = 5
"""Every tenth frame is looked at, and five looks are judged together: what is seen in 50 frames."""

SETTLED_FRAMES = EVERY * RECENT

FEATURES, LEVELS = 500, 2
MAX_HAMMING = 64
WINDOW_PX = 15
MAX_DISPARITY_SHARE = 0.4
MAX_ROWS_SHARE = 0.15
MIN_MATCHES = 40

RETURN_PX = 0.5
"""A point that is followed to another image and back comes back as near as this."""

ROWS_PX = 1.5
"""Matching along rows bears no more; nor are disparities wrong by more because they are noisy."""

LAG_FRAMES, SURE = 0.15, 4.0
"""A lag counts where it is more than this share of a frame, by so many standard deviations: what
rectification leaves of two real cameras, which were triggered together, looked like half of it."""

LEAST_NOISE_PX = 0.1
"""Positions of points are not known better."""

WIDTH_PX = 320
"""Images are shrunk to about this width."""

REACH_PX = 16
SCALES = (0.92, 0.96, 1.0, 1.04, 1.08)
LAGS = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""What is tried: shifts of shrunk pixels, sizes, and lags in frames."""

BESIDE_PX = 2
"""Edges of depth are off by so much in a camera that is aligned: holes lie beside them."""

STEP_RATIO = 1.15
"""Two disparities of one surface differ by less from pixel to pixel."""

NOWHERE_PX = 1e6
"""Disparity that nothing has."""

MIN_EDGE_PX = 200
MIN_LOOKS, MAX_LOOKS = 4, 15

SURE_MISFIT, BETTER = 3.0, 1.15
"""Something else than "aligned" must fit better by this factor, and by so many standard
deviations of what the looks differ by."""


@dataclass(frozen=True)
class InputFault:
    """What is wrong with the images: `fault` in a word, a figure with its unit, what was found in
    words that go on after the name of the images, and what to do.
    """

    fault: str
    value: float
    unit: str
    finding: str
    remedy: str

    def line(self, images: str = 'left and right images') -> str:
        """Return the fault in one line. images: their name."""
        return f'{images} {self.finding}; {self.remedy}'


def _rows_apart(rows_px: float) -> InputFault:
    return InputFault(
        'rows_apart',
        round(rows_px, 2),
        'px',
        f'are not rectified: the same points stand {rows_px:.1f} rows apart (median), which is '
        'taken off the right image as far as it is the same everywhere',
        'give the raw images (image_raw) with the calibration of this camera, or calibrate again '
        '(segfloor calibrate)',
    )


def _eyes_swapped(share: float) -> InputFault:
    return InputFault(
        'eyes_swapped',
        round(100 * share, 1),
        '%',
        f'are exchanged: {share:.0%} of the disparities are negative',
        'exchange the two, and their calibrations if these are exchanged, too',
    )


def _depth_unaligned(shift_px: float, scale: float) -> InputFault:
    return InputFault(
        'depth_unaligned',
        round(shift_px, 1),
        'px',
        f'are not aligned: the edges of depth lie {shift_px:.0f} px beside those of the image, '
        f'which is {scale:.2f} times as large',
        'give depth that is registered to the image (aligned_depth_to_color, depth_registered)',
    )


def _not_simultaneous(
    lag_s: float, frame_s: float, names: tuple[str, str] = ('right', 'left')
) -> InputFault:
    late, early = names if lag_s > 0 else names[::-1]
    return InputFault(
        'not_simultaneous',
        round(1e3 * lag_s, 1),
        'ms',
        f'are not taken at the same time: the {late} one lags {1e3 * abs(lag_s):.0f} ms '
        f'({abs(lag_s) / frame_s:.1f} frames) behind the {early} one',
        'take both at once, and pair them by the time of exposure',
    )


class RigCheck:
    """Looks at some frames of a stereo camera; `faults` is what was found so far, by name. Within
    `SETTLED_FRAMES` a moving camera has told one fault from another.
    """

    def __init__(self) -> None:
        self.faults: dict[str, InputFault] = {}
        self.frames = 0
        self._rows_px = 0.0
        self._looks: deque[Array] = deque(maxlen=RECENT)
        self._before: tuple[NDArray[np.uint8], int] | None = None
        self._orb = cv2.ORB_create(FEATURES, nlevels=LEVELS)
        self._frame_s = 0.0
        self._depth = DepthCheck()

    def see(self, frame: StereoFrame) -> None:
        """Take in a frame that shows something."""
        if self.frames % EVERY == 0 and is_disparity(frame.right):
            self._judge_depth(frame)
        elif self.frames % EVERY == 0:
            self._looks.append(self._look(frame))
            self._judge()
        self.frames += 1
        self._before = (frame.left, frame.stamp_ns) if self.frames % EVERY == 0 else None

    def corrected(self, frame: StereoFrame) -> StereoFrame:
        """Return a frame with its right image moved by the rows that it was found to be off."""
        if not self._rows_px:
            return frame
        shift = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, self._rows_px]])
        right = cv2.warpAffine(frame.right, shift, frame.right.shape[::-1])
        return replace(frame, right=right)

    def as_dicts(self) -> list[dict[str, Any]]:
        """Return fault, value, unit and remedy of all that was found, for summary.json."""
        names = 'fault', 'value', 'unit', 'remedy'
        return [{name: getattr(fault, name) for name in names} for fault in self.faults.values()]

    def _look(self, frame: StereoFrame) -> Array:
        """Return (N, 6): where points are in the left image, by how much in the right one (column,
        row), px, and how they move in the left one, px/s, NaN where that is not known.
        """
        left_px, right_px = self._match(frame.left, frame.right)
        seen = np.full((len(left_px), 6), np.nan)
        seen[:, :2], seen[:, 2:4] = left_px, left_px - right_px
        if self._before is not None and len(left_px):
            before, stamp_ns = self._before
            self._frame_s = 1e-9 * (frame.stamp_ns - stamp_ns)
            before_px, found = _follow(frame.left, before, left_px, left_px, levels=3)
            seen[found, 4:] = (left_px - before_px)[found] / self._frame_s
        return seen

    def _match(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Return pixels (N, 2) of a grey image (H, W) and where they are in the other one."""
        nothing = np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
        (left_points, left_words), (right_points, right_words) = (
            self._orb.detectAndCompute(image, None) for image in (left, right)
        )
        if left_words is None or right_words is None:
            return nothing
        matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left_words, right_words)
        matches = [match for match in matches if match.distance <= MAX_HAMMING]
        if not matches:
            return nothing
        left_px = np.array([left_points[m.queryIdx].pt for m in matches], np.float32)
        guess_px = np.array([right_points[m.trainIdx].pt for m in matches], np.float32)
        most = np.array([MAX_DISPARITY_SHARE, MAX_ROWS_SHARE]) * left.shape[::-1]
        possible = (np.abs(left_px - guess_px) < most).all(axis=1)
        left_px, guess_px = left_px[possible], guess_px[possible]
        if not possible.any():
            return nothing
        right_px, found = _follow(left, right, left_px, guess_px, levels=0)
        return left_px[found], right_px[found]

    def _judge(self) -> None:
        seen = np.concatenate(self._looks)
        if len(seen) < MIN_MATCHES:
            return
        followed = seen[np.isfinite(seen).all(axis=1)]
        lag_s = self._lag_s(followed)
        seen = followed if lag_s else seen
        apart = seen[:, 2:4] - lag_s * np.nan_to_num(seen[:, 4:])
        negative = float(np.mean(apart[:, 0] < -ROWS_PX))
        rows_px = float(np.median(np.abs(apart[:, 1])))
        found = []
        if lag_s:
            self.faults.pop('rows_apart', None)  # it may have been the lag
            self._rows_px = 0.0
            rows_px = abs(float(np.median(apart[:, 1])))  # its rest, where speeds vary, has no sign
            found.append(_not_simultaneous(lag_s, self._frame_s))
        if negative > 0.5:
            found.append(_eyes_swapped(negative))
        if rows_px > ROWS_PX and (lag_s or 'not_simultaneous' not in self.faults):
            found.append(_rows_apart(rows_px))
            self._rows_px = float(np.median(apart[:, 1]))
        self.faults.update({fault.fault: fault for fault in found})

    def _judge_depth(self, frame: StereoFrame) -> None:
        if self._before is None:
            return
        before, stamp_ns = self._before
        self._depth.look(frame.left, before, frame.right)
        misfit = self._depth.misfit()
        if misfit is None:
            return
        frame_s = 1e-9 * (frame.stamp_ns - stamp_ns)
        if misfit.lag and misfit.scale == 1.0:
            fault = _not_simultaneous(misfit.lag * frame_s, frame_s, ('depth', 'colour'))
        else:
            fault = _depth_unaligned(misfit.shift_px, misfit.scale)
        self.faults[fault.fault] = fault

    def _lag_s(self, seen: Array) -> float:
        """Return by how much the right images are late, in seconds, by points (N, 6); 0 where that
        is not sure, or no more than what rectification leaves: a single look cannot tell that from
        a lag, for points move as they lie in the image.
        """
        if len(self._looks) < RECENT or len(seen) < MIN_MATCHES:
            return 0.0
        rows_px, moved_px = seen[:, 3], seen[:, 5] * self._frame_s
        A = np.column_stack([np.ones(len(seen)), 1e-3 * seen[:, :2], moved_px])
        weight = np.ones(len(seen))
        for _ in range(10):
            W = A * weight[:, None]
            covariance = np.linalg.pinv(W.T @ A)
            x = covariance @ W.T @ rows_px
            error = rows_px - A @ x
            noise_px = max(1.4826 * float(np.median(np.abs(error))), LEAST_NOISE_PX)
            weight = 1.0 / (1.0 + (error / (2 * noise_px)) ** 2)
        lag, sigma = float(x[3]), noise_px * float(np.sqrt(covariance[3, 3]))
        is_sure = sigma > 0 and abs(lag) - SURE * sigma > LAG_FRAMES
        return lag * self._frame_s if is_sure else 0.0


def _follow(
    image: NDArray[np.uint8], other: NDArray[np.uint8], uv_px: Array, guess_px: Array, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Return where pixels (N, 2) of an image (H, W) are in another one, near a guess (N, 2), and
    which of them were found, there and back.
    """
    how: dict[str, Any] = {
        'winSize': (WINDOW_PX, WINDOW_PX),
        'maxLevel': levels,
        'flags': cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    there, found = cv2.calcOpticalFlowPyrLK(image, other, uv_px, guess_px.copy(), **how)[:2]
    back, returned = cv2.calcOpticalFlowPyrLK(other, image, there, uv_px.copy(), **how)[:2]
    is_same = np.linalg.norm(back - uv_px, axis=1) < RETURN_PX
    return there, (np.asarray(found).ravel() > 0) & (np.asarray(returned).ravel() > 0) & is_same


@dataclass(frozen=True)
class DepthFit:
    """How depth lies to its image: lag in frames, positive where the depth is late; shift_px from
    its edges to those of the image, and how much larger (1: not at all) it must be to fit.
    """

    lag: float
    shift_px: float
    scale: float


class DepthCheck:
    """Collects how image and depth fit, one look after the other."""

    def __init__(self) -> None:
        self._looks: deque[tuple[Array, Array]] = deque(maxlen=MAX_LOOKS)
        self._factor = 1

    def look(
        self, image: NDArray[np.uint8], before: NDArray[np.uint8], disparity: NDArray[np.float32]
    ) -> None:
        """Take in a grey image (H, W), the one a frame before, and the disparity (H, W) that is
        measured with it, 0 where there is none.
        """
        self._factor = factor = max(1, round(image.shape[1] / WIDTH_PX))
        size = image.shape[1] // factor, image.shape[0] // factor
        small, earlier = (
            cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (image, before)
        )
        edges = cv2.resize(_steps(disparity), size, interpolation=cv2.INTER_AREA)
        corners = cv2.goodFeaturesToTrack(small, 200, 0.01, 5)
        if edges.sum() < MIN_EDGE_PX / factor or corners is None:
            return
        then, found, _ = cv2.calcOpticalFlowPyrLK(small, earlier, corners, np.empty(0))
        moved = (corners - then)[np.asarray(found).ravel() > 0, 0]
        if len(moved):
            contours = _contours(small)
            fits = np.stack([_fit(contours, _zoomed(edges, scale)) for scale in SCALES])
            self._looks.append((np.median(moved, axis=0), fits))

    def misfit(self) -> DepthFit | None:
        """Return how depth lies to its image, where it is sure that it does not belong there."""
        if len(self._looks) < MIN_LOOKS:
            return None
        near = np.s_[REACH_PX - BESIDE_PX : REACH_PX + BESIDE_PX + 1]
        aligned, _, _ = _best(self._fits(SCALES.index(1.0), 0.0)[:, near, near])
        tried = ((s, lag, *_best(self._fits(s, lag))) for s in range(len(SCALES)) for lag in LAGS)
        s, lag, best, row, column = max(tried, key=lambda one: one[2].mean())
        gain = best - aligned
        sigma = gain.std(ddof=1) / np.sqrt(len(gain))
        if best.mean() < BETTER * aligned.mean() or gain.mean() <= SURE_MISFIT * sigma:
            return None
        shift_px = self._factor * float(np.hypot(row - REACH_PX, column - REACH_PX))
        return DepthFit(lag, shift_px, SCALES[s])

    def _fits(self, scale: int, lag: float) -> Array:
        """Return the fit (L, 2 R + 1, 2 R + 1) of all looks for all shifts of depth that is late by
        `lag` frames.
        """
        return np.stack([_moved(fits[scale], -lag * moved) for moved, fits in self._looks])


def _best(fits: Array) -> tuple[Array, int, int]:
    """Return the fit (L,) of all looks at the shift that is best for all, its row and column."""
    mean = fits.mean(axis=0)
    row, column = np.unravel_index(mean.argmax(), mean.shape)
    return fits[:, row, column], int(row), int(column)


def _steps(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return where things end in depth, 0 or 1 (H, W)."""
    known = np.isfinite(disparity) & (disparity > 0)
    square = np.ones((3, 3), np.uint8)
    near = cv2.dilate(np.where(known, disparity, 0).astype(np.float32), square)
    far = cv2.erode(np.where(known, disparity, NOWHERE_PX).astype(np.float32), square)
    is_known = (near > 0) & (far < NOWHERE_PX)
    return (is_known & (near > STEP_RATIO * far + 0.5)).astype(np.float32)


def _contours(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how much of an edge each pixel of an image (H, W) is, against its neighbourhood."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    edge = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    edge = np.minimum(edge, np.percentile(edge, 95)).astype(np.float32)
    edge -= cv2.blur(edge, (2 * REACH_PX - 1, 2 * REACH_PX - 1))
    return np.asarray(edge / max(float(edge.std()), 1e-3), np.float32)


def _zoomed(edges: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    height, width = edges.shape
    zoom = np.array([[scale, 0, (1 - scale) * width / 2], [0, scale, (1 - scale) * height / 2]])
    return np.asarray(cv2.warpAffine(edges, zoom, (width, height), flags=cv2.INTER_NEAREST))


def _fit(contours: NDArray[np.float32], edges: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean contour below edges for all shifts up to `REACH_PX`, (2 R + 1, 2 R + 1)."""
    inner = edges[REACH_PX:-REACH_PX, REACH_PX:-REACH_PX]
    fit = cv2.matchTemplate(contours, inner, cv2.TM_CCORR) / max(float(inner.sum()), 1.0)
    return np.asarray(fit, np.float32)


def _moved(fit: NDArray[np.float32], by_px: Array) -> NDArray[np.float32]:
    shift = np.column_stack([np.eye(2), by_px])
    moved = cv2.warpAffine(fit, shift, fit.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved)
