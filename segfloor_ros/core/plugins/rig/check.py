"""What is wrong with a stereo rig, by its images alone.

Points of the left image are found in the right one and in the left one before. In images that are
rectified and taken together, both eyes have a point in one row. Row differences that depend on the
place in the image are those of a wrong rectification: offset, roll, focal length. Those that grow
with the motion of the points along the columns are those of a lag between the eyes. Those that
scatter more than they differ are those of points that look alike, as on a chessboard: nothing is
said. How wide the sharpest edges are, how bright the images and how bright a point is in both of
them is seen at once; it counts where all of the last looks show it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera, is_disparity
from segfloor_ros.core.contracts import InputFault, StereoFrame
from segfloor_ros.core.gauss_newton import gauss_newton
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.plugins.rig.estimates import (
    MAX_HAMMING,
    MIN_MATCHES,
    MIN_TURN_RAD,
    ROWS_PX,
    SURE,
    WINDOW_PX,
    CalibrationCheck,
    DepthCheck,
    Matches,
    follow,
    spread_px,
)
from segfloor_ros.core.timing import timed

EVERY, RECENT = 10, 5
"""Every tenth frame is looked at, and five looks are judged together: what is seen in 50 frames."""

SETTLED_FRAMES = EVERY * RECENT

BURST = 2 + EVERY // 2
"""Frames after a jump: one before the look, the look, and those up to the next view of a turn."""

SKIPPED, USUAL = 1.5, 0.2
"""Frames are missing before one that comes after so many times the usual time, below which one step
in five stays."""

FEATURES, LEVELS = 500, 2
REACH_SHARE = 0.4, 0.15
"""Of width and height: a point is no further from its place in the other eye."""

FOUND_SHARE = 0.05
"""Two eyes of one scene find four to six of ten points again, in strong noise one; of two scenes
one of thirty."""

LAG_FRAMES = 0.15
"""A lag counts where it is more than this share of a frame: what rectification leaves of two real
cameras, which were triggered together, looked like half of it."""

EDGE_PX = 4.0
"""Sharp images have edges of 2.2 to 3.2 px, also those of a moving camera, whose blur leaves the
edges along it; features and disparities come from the scale of the pixel."""

DARK_GREY, WHITE_GREY = 32, 250
"""Below the one, three of eight bits are unused, and a step is no edge; above the other, a pixel is
no measurement."""

WHITE_SHARE = 1 / 3
"""Lamps, windows and the sky whiten less."""

NO_RIG_PX, MOST_LAG_FRAMES = 5.0, 5.0
"""Rows between both eyes change by less while a rig is driven, however badly it is rectified; a
longer lag is no way to explain them, since points no longer move along a line meanwhile."""

NEAREST_M, NEAREST_PERCENT = (0.08, 12.0), 95
"""The nearest twentieth of what a depth camera of a robot measures is farther than it reaches down
to, and no farther than the floor or the walls around it; other figures have another unit."""

SAME_EYES, EYES_RATIO = 1.07, 1.25
"""Two good cameras with exposures of their own differ by up to the one; the other is a fault."""


FAULTS = {
    'rows_apart': (
        'px',
        'are not rectified: the same points stand {value:.1f} rows apart, which is taken off the '
        'right image as far as an offset, a roll and another size explain it',
        'give the raw images (image_raw) with the calibration of this camera, or calibrate again '
        '(segfloor calibrate)',
    ),
    'eyes_swapped': (
        '%',
        'are exchanged: {value:.0f}% of the disparities are negative',
        'exchange the two, and their calibrations if these are exchanged, too; or turn the images '
        'of a camera that hangs upside down',
    ),
    'same_image': (
        '%',
        'are one and the same: {value:.0f}% of their pixels are equal',
        'give the images of the right camera: its topic, folder or device',
    ),
    'different_views': (
        '%',
        'show different things: {value:.0f}% of the points of one are found in the other',
        'check that both are of one camera, none of them turned, mirrored or of another time',
    ),
    'no_rig': (
        'px',
        'are of no stereo camera: the same points are {value:.0f} rows further apart in one pair '
        'than in another',
        'take two cameras on one rigid mount that are triggered together; two phones or webcams '
        'side by side are none',
    ),
    'depth_unaligned': (
        'px',
        'are not aligned: the edges of depth fit those of the image best moved by {value:.0f} px '
        'and {scale:.2f} times as large',
        'give depth that is registered to the image (aligned_depth_to_color, depth_registered)',
    ),
    'depth_scale': (
        'm',
        'do not fit: the nearest depths are {value:.2g} m, those of a robot are '
        f'{NEAREST_M[0]:g} to {NEAREST_M[1]:g} m',
        'set stereo_camera.depth_scale to the metres of one unit of depth (0.001 for mm, 0.0002 in '
        'the TUM RGB-D benchmark), or let the driver publish 16UC1 in mm or 32FC1 in m',
    ),
    'not_simultaneous': (
        'ms',
        'are not taken at the same time: the {late} one lags {lag_ms:.0f} ms ({frames:.1f} frames) '
        'behind the {early} one',
        'take both at once, and pair them by the time of exposure',
    ),
    'focal_length': (
        '%',
        'have another focal length than their calibration: turns show {seen_px:.0f} px, '
        '{given_px:.0f} px is {value:+.0f} %',
        'take the calibration of this lens at this resolution, or calibrate again '
        '(segfloor calibrate)',
    ),
    'principal_points': (
        'px',
        'have other principal points than their calibration: motion shows that all disparities are '
        '{value:+.1f} px off',
        'take the calibration of this camera, the right eye of which has a principal point of its '
        'own, or calibrate again (segfloor calibrate); the baseline goes with it',
    ),
    'blurred': (
        'px',
        'are blurred: their sharpest edges are {value:.1f} px wide',
        'focus and clean the lenses, expose for a shorter time, or take smaller images',
    ),
    'dark': (
        'grey levels',
        'are too dark: all but a hundredth of them is below {value:.0f} of 255',
        'expose for longer, raise the gain, or switch on a lamp',
    ),
    'saturated': (
        '%',
        'are overexposed: {value:.0f} % of them is white',
        'expose for a shorter time, or lower the gain',
    ),
    'eyes_differ': (
        'times',
        'are exposed differently: the same points are {value:.2f} times as bright in one of them',
        'set exposure and gain of both to the same values, or let one control both',
    ),
}
"""Of each fault its unit, what was found, and what to do."""

BENT = {'no_rig', 'rows_apart', 'eyes_swapped', 'same_image', 'different_views', 'not_simultaneous'}
"""Images with these faults show a world that is bent, whatever the calibration."""


class RigCheck:
    """Looks at some frames of a stereo camera; `faults` is what was found so far, by name. Within
    `SETTLED_FRAMES` a moving camera has shown one fault from another.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self.faults: dict[str, InputFault] = {}
        self.frames = 0
        self.rows_px = float('nan')
        """By how much the same points stand in other rows, in the last looks."""
        self._camera = camera
        self._mend: Array | None = None
        self._looks: deque[Array] = deque(maxlen=RECENT)
        self._pictures: deque[Array] = deque(maxlen=RECENT)
        self._before: tuple[NDArray[np.uint8], int] | None = None
        self._points: deque[int] = deque(maxlen=RECENT)
        self._point_count = 0
        self._orb = cv2.ORB_create(FEATURES, nlevels=LEVELS)
        self._frame_s = 0.0
        self._images = InputFault.images
        self._moving_looks = self._watched = 0
        self._has_gap = False
        self._last_ns = 0
        self._steps_ns: deque[int] = deque(maxlen=SETTLED_FRAMES)
        self._depth = DepthCheck()
        self._nearest_px: deque[float] = deque(maxlen=RECENT)
        self._calibration = CalibrationCheck(camera)

    @timed
    def watch(self, frame: StereoFrame, turn_rad: float = 0.0) -> None:
        """Take in a frame of a drive: each one until nothing was found in motion, then one burst in
        fifty frames, and turns until the calibration is known. turn_rad: since the frame before.
        """
        self._watched += 1
        if self._is_after_gap(frame.stamp_ns):
            self._before = None
            self._calibration.reset_view()
        is_seen = self._moving_looks >= RECENT or self._depth.is_done
        is_settled = is_seen and not self.faults
        is_turn = turn_rad * (EVERY // 2) > MIN_TURN_RAD and not self._calibration.is_done
        if is_settled and not is_turn and self._watched % SETTLED_FRAMES >= BURST:
            self._has_gap = True
            return
        if self._has_gap:
            self.jump()
        self._has_gap = False
        self.see(frame)

    def _is_after_gap(self, stamp_ns: int) -> bool:
        """Whether frames are missing before one: the motion between the two is not small."""
        step_ns, self._last_ns = stamp_ns - self._last_ns, stamp_ns
        self._steps_ns.append(step_ns)
        return bool(step_ns > SKIPPED * np.quantile(self._steps_ns, USUAL))

    def see(self, frame: StereoFrame) -> None:
        """Take in a frame that shows something."""
        is_look = self.frames % EVERY == 0
        if is_disparity(frame.right):
            self._images = 'image and depth'
            if is_look:
                self._pictures.append(_picture([frame.left]))
                self._judge_scale(frame.right)
                self._judge_depth(frame)
                self._judge_pictures()
        elif is_look or (self.frames % EVERY == EVERY // 2 and not self._calibration.is_done):
            matches = self._match(frame.left, frame.right)
            self._calibration.look(frame.left, matches)
            if is_look:
                self._looks.append(self._look(frame, matches))
                self._points.append(self._point_count)
                if self._point_count and np.array_equal(frame.left, frame.right):
                    self._found('same_image', 100.0)
                self._pictures.append(_picture([frame.left, frame.right]))
                self._judge()
                self._judge_pictures()
        self.frames += 1
        self._before = (frame.left, frame.stamp_ns) if self.frames % EVERY == 0 else None

    def jump(self) -> None:
        """Take the next frames, which are of another part of the recording: one, one that is looked
        at, and what follows until the next jump.
        """
        self.frames += EVERY - 1 - self.frames % EVERY
        self._calibration.reset_view()

    def corrected(self, frame: StereoFrame) -> StereoFrame:
        """Return a frame whose right image has the same points in the same rows: moved along the
        columns or, where it is far off, rolled and scaled as a whole.
        """
        if self._mend is None:
            return frame
        right = cv2.warpAffine(frame.right, self._mend, frame.right.shape[::-1])
        return replace(frame, right=right)

    def as_dicts(self) -> list[dict[str, Any]]:
        """Return fault, value, unit and remedy of all that was found, for summary.json."""
        names = 'fault', 'value', 'unit', 'remedy'
        return [{name: getattr(fault, name) for name in names} for fault in self.faults.values()]

    def _found(self, fault: str, value: float, **figures: Any) -> None:
        unit, finding, remedy = FAULTS[fault]
        words = finding.format(value=value, **figures)
        self.faults[fault] = InputFault(fault, round(value, 2), unit, words, remedy, self._images)

    def _found_lag(self, lag_s: float, frame_s: float, late: str, early: str) -> None:
        """Note that one kind of image is late, or early where the lag is negative."""
        if 'not_simultaneous' in self.faults:  # it is said once, and with one figure
            return
        late, early = (late, early) if lag_s > 0 else (early, late)
        lag_ms, frames = 1e3 * abs(lag_s), abs(lag_s) / frame_s
        self._found(
            'not_simultaneous', 1e3 * lag_s, lag_ms=lag_ms, frames=frames, late=late, early=early
        )

    def _look(self, frame: StereoFrame, matches: Matches) -> Array:
        """Return (N, 7): where points are in the left image, by how much in the right one (column,
        row), px, how they move in the left one, px/s, NaN where that is not known, and by how much
        they are brighter in one of them, a logarithm.
        """
        left_px = matches.left_px
        seen = np.full((len(left_px), 7), np.nan)
        seen[:, :2], seen[:, 2:4] = left_px, left_px - matches.right_px
        seen[:, 6] = np.abs(_contrast(frame.left, left_px, frame.right, matches.right_px))
        if self._before is not None and len(left_px):
            before, stamp_ns = self._before
            self._frame_s = 1e-9 * (frame.stamp_ns - stamp_ns)
            before_px, found = follow(frame.left, before, left_px, left_px, levels=3)
            moved_px = (left_px - before_px)[found]
            seen[found, 4:6] = moved_px / self._frame_s
            is_moving = found.any() and np.median(np.hypot(*moved_px.T)) > ROWS_PX
            self._moving_looks += int(is_moving)
        return seen

    def _match(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> Matches:
        """Return the points of a left image (H, W) that are found in the right one."""
        none = np.zeros((0, 2), np.float32)
        nothing = Matches(none, none, np.zeros((0, 32), np.uint8))
        (left_points, left_words), (right_points, right_words) = (
            self._orb.detectAndCompute(image, None) for image in (left, right)
        )
        self._point_count = min(len(left_points), len(right_points))
        if left_words is None or right_words is None:
            return nothing
        matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left_words, right_words)
        matches = [match for match in matches if match.distance <= MAX_HAMMING]
        if not matches:
            return nothing
        guess = Matches(
            np.array([left_points[m.queryIdx].pt for m in matches], np.float32),
            np.array([right_points[m.trainIdx].pt for m in matches], np.float32),
            np.asarray(left_words[[m.queryIdx for m in matches]], np.uint8),
        )
        most = np.array(REACH_SHARE) * left.shape[::-1]
        guess = guess.those((np.abs(guess.left_px - guess.right_px) < most).all(axis=1))
        if not len(guess.words):
            return nothing
        right_px, found = follow(left, right, guess.left_px, guess.right_px, levels=0)
        if np.count_nonzero(found):
            gain = _contrast(left, guess.left_px[found], right, right_px[found])
            if abs(np.median(gain)) > np.log(SAME_EYES):  # optical flow takes them for equal
                right = np.asarray(
                    cv2.convertScaleAbs(right, alpha=float(np.exp(np.median(gain)))), np.uint8
                )
                right_px, found = follow(left, right, guess.left_px, guess.right_px, levels=0)
        return guess._replace(right_px=np.asarray(right_px, np.float32)).those(found)

    def _judge(self) -> None:
        self.faults.pop('no_rig', None)
        seen = np.concatenate(self._looks)
        points = sum(self._points)
        if len(seen) < max(MIN_MATCHES, FOUND_SHARE * points):
            if len(self._looks) == RECENT and min(self._points) >= MIN_MATCHES:
                self._found('different_views', 100 * len(seen) / points)
            return
        if len(self._looks) == RECENT and (change_px := self._change_px()) > NO_RIG_PX:
            self._mend = None
            for bent in BENT & self.faults.keys():
                del self.faults[bent]
            self._found('no_rig', change_px)
            return
        followed = seen[np.isfinite(seen).all(axis=1)]
        lag_s = self._lag_s(followed)
        seen = followed if lag_s else seen
        apart = seen[:, 2:4] - lag_s * np.nan_to_num(seen[:, 4:6])
        offset_px = self._calibration.offset_px()
        negative = float(np.mean(apart[:, 0] - (offset_px or 0.0) < -ROWS_PX))
        centre = np.array([self._camera.cx, self._camera.cy])
        right_px = seen[:, :2] - seen[:, 2:4] - centre
        A = np.column_stack([np.ones(len(seen)), right_px])
        (rows, roll, size), covariance, noise_px = _fit(A, apart[:, 1])
        sigma = noise_px * np.sqrt(np.diag(covariance))
        bent_px = abs(rows) - SURE * sigma[0]
        bent_px += (np.hypot(roll, size) - SURE * sigma[1:].max()) * centre.min()
        rows_px = float(np.median(np.abs(apart[:, 1])))
        if noise_px > max(rows_px, ROWS_PX):  # things that look alike are taken for each other
            self.rows_px = float('nan')
            return
        rows_px = self.rows_px = max(rows_px, float(bent_px))
        if lag_s:
            self.faults.pop('rows_apart', None)  # it may have been the lag
            rows_px = abs(float(np.median(apart[:, 1])))  # its rest, where speeds vary, has no sign
            self._found_lag(lag_s, self._frame_s, 'right', 'left')
        self.faults.pop('eyes_swapped', None)
        if negative > 0.5:
            self._found('eyes_swapped', 100 * negative)
        is_apart = rows_px > ROWS_PX and bool(lag_s or 'not_simultaneous' not in self.faults)
        if is_apart:
            self._found('rows_apart', rows_px)
        # Roll and size move the columns as well; how small ones do, motion shows better.
        M = np.array([[size * is_apart, -roll * is_apart], [roll, size]])
        mend = np.column_stack([np.eye(2) + M, (0, rows) - M @ centre])
        self._mend = mend if is_apart or (bent_px > 0 and not lag_s) else None
        if len(self._looks) < RECENT:
            return
        ratio = float(np.exp(np.median(seen[:, 6])))
        if ratio > EYES_RATIO:
            self._found('eyes_differ', ratio)
        factor, fx = self._calibration.factor(), self._camera.fx
        if self.faults.keys() & BENT:
            self.faults.pop('focal_length', None)
            self.faults.pop('principal_points', None)
            return
        if factor is not None:
            too_long = 100 / factor - 100
            self._found('focal_length', too_long, seen_px=factor * fx, given_px=fx)
        if offset_px is not None:
            self._found('principal_points', offset_px)

    def _change_px(self) -> float:
        """Return by how many rows the distance between both eyes changes from look to look, as far
        as points of one look agree, without what one lag explains: that needs their motion.
        """
        moved = [look[np.isfinite(look).all(axis=1)] for look in self._looks]
        moved = [look for look in moved if len(look) >= MIN_MATCHES]
        if len(moved) < RECENT - 1:
            return 0.0
        apart = []
        lag = self._lag_s(np.concatenate(moved))
        if abs(lag) > MOST_LAG_FRAMES * self._frame_s:
            lag = 0.0
        for look in moved:
            speed_px = look[:, 5]
            rows_px = look[:, 3] - lag * speed_px
            middle_px = float(np.median(rows_px))
            small_px = 0.0 if lag else LAG_FRAMES * self._frame_s * abs(float(np.median(speed_px)))
            apart.append((middle_px, spread_px(rows_px - middle_px), small_px))
        middles, spreads, small = np.array(apart).T
        # One look may be of images that do not belong together.
        off = np.sort(np.maximum(np.abs(middles - np.median(middles)) - small, 0.0))[:-1]
        change_px = float(np.ptp(middles))
        is_sure = 2 * off[-1] > max(NO_RIG_PX, SURE * float(np.median(spreads)))
        return change_px if is_sure else 0.0

    def _judge_pictures(self) -> None:
        if len(self._pictures) < RECENT:
            return
        pictures = np.array(self._pictures)
        edge_px, white_share = float(pictures[:, 0].min()), float(pictures[:, 2].min())
        bright_grey = float(pictures[:, 1].max())
        if bright_grey < DARK_GREY:
            self._found('dark', bright_grey)
        elif edge_px > EDGE_PX:
            self._found('blurred', edge_px)
        if white_share > WHITE_SHARE:
            self._found('saturated', 100 * white_share)

    def _judge_scale(self, disparity: NDArray[np.float32]) -> None:
        measured = disparity[::4, ::4][disparity[::4, ::4] > 0]
        if len(measured) < MIN_MATCHES:
            return
        self._nearest_px.append(float(np.percentile(measured, NEAREST_PERCENT)))
        nearest_m = self._camera.disparity_times_depth / float(np.median(self._nearest_px))
        self.faults.pop('depth_scale', None)
        if not NEAREST_M[0] <= nearest_m <= NEAREST_M[1]:
            self._found('depth_scale', nearest_m)

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
            self._found_lag(misfit.lag * frame_s, frame_s, 'depth', 'colour')
        else:
            self._found('depth_unaligned', misfit.shift_px, scale=misfit.scale)

    def _lag_s(self, seen: Array) -> float:
        """Return by how much the right images are late, in seconds, by points (N, 7); 0 where that
        is not sure, or no more than what rectification leaves: a single look cannot tell that from
        a lag, for points move as they lie in the image.
        """
        if len(self._looks) < RECENT or len(seen) < MIN_MATCHES:
            return 0.0
        rows_px, moved_px = seen[:, 3], seen[:, 5] * self._frame_s
        right_px = seen[:, :2] - seen[:, 2:4]
        A = np.column_stack([np.ones(len(seen)), 1e-3 * right_px, moved_px])
        x, covariance, noise_px = _fit(A, rows_px)
        lag, sigma = float(x[3]), noise_px * float(np.sqrt(covariance[3, 3]))
        is_sure = sigma > 0 and abs(lag) - SURE * sigma > LAG_FRAMES
        return lag * self._frame_s if is_sure else 0.0


def _fit(A: Array, measured: Array) -> tuple[Array, Array, float]:
    """Return what fits A (N, K) to what was measured (N,) without outliers, its covariance (K, K)
    for a noise of 1, and the noise.
    """

    def linearise(x: Array, _: int) -> tuple[Array, Array, None]:
        error = measured - A @ x
        weighted = A.T / (1.0 + (error / (2 * spread_px(error))) ** 2)
        return weighted @ A, weighted @ error, None

    plain = np.linalg.lstsq(A, measured, rcond=None)[0]
    x, information, _ = gauss_newton(plain, linearise, range(9), np.add)
    return x, np.linalg.pinv(information), spread_px(measured - A @ x)


def _contrast(
    left: NDArray[np.uint8], left_px: Array, right: NDArray[np.uint8], right_px: Array
) -> Array:
    """Return by how much the surroundings of points (N, 2) are brighter in the left image (H, W)
    than in the right one, (N,), as a logarithm.
    """
    seen = []
    for image, px in ((left, left_px), (right, right_px)):
        mean = cv2.blur(image, (WINDOW_PX, WINDOW_PX))
        u, v = np.clip(np.rint(px).astype(np.intp).T, 0, np.array([image.shape[::-1]]).T - 1)
        seen.append(mean[v, u] + 1.0)
    return np.asarray(np.log(seen[0] / seen[1]))


def _picture(images: Sequence[NDArray[np.uint8]]) -> Array:
    """Return (3,): how wide the sharpest edges of one or two images (H, W) are, px, the grey level
    of their brightest hundredth, and the share of white; of the worse one.
    """
    return np.array(
        [
            max(_edge_px(image) for image in images),
            min(float(np.percentile(image[::2, ::2], 99)) for image in images),
            max(float(np.mean(image[::2, ::2] >= WHITE_GREY)) for image in images),
        ]
    )


def _edge_px(image: NDArray[np.uint8]) -> float:
    """Return how wide the sharpest edges in the middle rows of an image (H, W) are: how much larger
    the grey step around the steepest pixels is than that from pixel to pixel; 0 without edges.
    """
    quarter = len(image) // 4
    smooth = cv2.GaussianBlur(image[quarter:-quarter], (0, 0), 0.8)
    across, along = (cv2.Sobel(smooth, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    slope = np.sqrt(across * across + along * along)  # as in `image_slope`
    patch = np.ones((WINDOW_PX, WINDOW_PX), np.uint8)
    step = cv2.morphologyEx(smooth, cv2.MORPH_GRADIENT, patch)
    is_edge = (slope >= np.percentile(slope[::2, ::2], 95)) & (step > DARK_GREY)
    if np.count_nonzero(is_edge) < MIN_MATCHES:
        return 0.0
    return float(np.percentile(step[is_edge] / cv2.dilate(slope, patch)[is_edge], 10))
