"""A stereo pair in the forms that tracking works on.

Where pixels of the last image are in this one: Lucas-Kanade on a pyramid (Bouguet, Pyramidal
Implementation of the Lucas Kanade Feature Tracker, 2000, as in OpenCV).

Parts of an image that do not count, because they move or lie on the border of rectification.

Two sources say so: a segmentation network (`StereoFrame.excluded`) and `moving_regions`.

Images that cannot be tracked: black, white, only half delivered, or the same as before.

How far the camera turned since the last image, from the images alone.

On a thumbnail a rotation looks like a shift. It is found without features by phase
correlation, so that tracking survives a turn that its motion model did not foresee (the "small
blurry image" of Klein and Murray, Improving the Agility of Keyframe-Based SLAM, 2008).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from segfloor_ros.camera.images import Region, blank_border, union
from segfloor_ros.camera.model import StereoCamera, StereoFrame, is_disparity
from segfloor_ros.geometry import Array, make_transform, transform_points

SIDE_PX = 11
"""Of the patch around a pixel: small enough to be flat, large enough to be distinct."""

LEVELS = 3
SMALL_WIDTH_PX = 320
"""Width of a shrunk image: for optical flow; half of it shows what moves, a quarter turns."""
STEPS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.05)

SIGMA_FLOW_PX = 1.0
"""Error of a pixel that is followed."""

MIN_CONTRAST = 3.0
MIN_LIVE_ROWS = 0.7
MIN_EXPECTED_SHIFT = 0.004
"""Motion of the picture, in widths per frame, that cannot stop from one frame to the next."""

MIN_RESPONSE = 0.05


@dataclass(frozen=True)
class Images:
    """left, right: rectified grey images (H, W) float32, for patches; of a depth camera its
    disparity for the right one, and depth_scale: disparity times depth, 0 of a stereo pair. small:
    the left one as optical flow takes it. excluded: where something moves, in the left image, and
    the black border that rectification leaves.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]
    small: NDArray[np.uint8]
    excluded: Region | None = None
    depth_scale: float = 0.0

    @staticmethod
    def of(frame: StereoFrame, camera: StereoCamera, mask_dilation_px: int = 0) -> Images:
        """Prepare the images of a frame. mask_dilation_px: of the mask that came with it."""
        depth_scale = camera.disparity_times_depth if is_disparity(frame.right) else 0.0
        left, right = frame.left.astype(np.float32), frame.right.astype(np.float32)
        excluded = blank_border(frame.left)
        if frame.excluded is not None:
            excluded = union(excluded, dilate(frame.excluded, mask_dilation_px))
        return Images(left, right, shrink(frame.left), excluded, depth_scale)


def shrink(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image (H, W) at half its size where it is large: a start for patch alignment
    need not be better than a pixel.
    """
    if image.shape[1] < 2 * SMALL_WIDTH_PX:
        return image
    half = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)


def follow_pixels(
    last: NDArray[np.uint8],
    now: NDArray[np.uint8],
    width_px: int,
    uv_last_px: Array,
    uv_guess_px: Array,
    window_px: int = SIDE_PX,
    steps: tuple[int, int, float] = STEPS,
) -> tuple[Array, NDArray[np.bool_]]:
    """Find pixels (N, 2) of one image in the next one, starting from a guess (N, 2).

    last, now: shrunk images; width_px: of the full ones, in whose pixels all positions are. steps:
    when the search ends, as OpenCV takes it.
    Returns positions (N, 2) and whether each was found (N,).
    """
    scale = last.shape[1] / width_px
    start, guess = (
        ((uv + 0.5) * scale - 0.5).astype(np.float32).reshape(-1, 1, 2)
        for uv in (uv_last_px, uv_guess_px)
    )
    found_uv, status, _ = cv2.calcOpticalFlowPyrLK(
        last,
        now,
        start,
        guess,
        winSize=(window_px, window_px),
        maxLevel=LEVELS,
        criteria=steps,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    uv = (np.asarray(found_uv, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
    return uv, np.asarray(status).ravel() > 0


def dilate(region: Region, radius_px: int) -> Region:
    """Return the region and everything within a radius of it."""
    if radius_px == 0:
        return region
    size = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.dilate(region, disc), np.uint8)


def is_inside(region: Region | None, uv_px: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which pixels (N, 2) lie in a region; none of them where there is no region."""
    if region is None:
        return np.zeros(len(uv_px), bool)
    height, width = region.shape
    u = np.clip(np.rint(uv_px[:, 0]), 0, width - 1).astype(np.intp)
    v = np.clip(np.rint(uv_px[:, 1]), 0, height - 1).astype(np.intp)
    return region[v, u] > 0


def image_fault(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> str:
    """Return what is wrong with a stereo pair of grey images (H, W), in words, or '' when it
    can be tracked.
    """
    for side, image in (('left', left), ('right', right)):
        sampled = image[::4, ::4]
        if float(sampled.std()) < MIN_CONTRAST:
            return f'{side} image without contrast (mean grey level {sampled.mean():.0f})'
        live = np.ptp(sampled, axis=1) > 0
        if live.mean() < MIN_LIVE_ROWS:
            return f'{side} image incomplete: {1 - live.mean():.0%} of its rows are empty'
    return ''


def expected_shift(camera: StereoCamera, points: Array, T_then: Array, T_now: Array) -> float:
    """Return how far the picture of points (N, 3) should have moved between two poses
    (T_camera_world, (4, 4)), in image widths; 0 without points.
    """
    if len(points) == 0:
        return 0.0
    then, now = (camera.project(transform_points(T, points))[:, :2] for T in (T_then, T_now))
    return float(np.median(np.linalg.norm(now - then, axis=1))) / camera.width


class RepeatCheck:
    """Distinguishes an image that a camera delivers twice, as a Kinect does, from a camera that is
    frozen: it delivers the same one again and again. A robot that stands still shows the same view,
    too, but then no motion was to be expected.

    is_repeated: whether the last image is the one before. is_carried: whether its view should have
    moved since, so that it shows nothing of this moment.
    """

    def __init__(self) -> None:
        self._last: NDArray[np.uint8] | None = None
        self.is_repeated = self.is_carried = self._is_frozen = False

    def is_frozen(self, left: NDArray[np.uint8], expected_shift: Callable[[], float]) -> bool:
        """Return whether the image (H, W) is the one before for a second time although it was to
        move by expected_shift(), a share of its width, which is asked for only then.
        """
        was_carried = self.is_carried
        self.is_repeated = self._last is not None and np.array_equal(left, self._last)
        self._last = left
        self._is_frozen &= self.is_repeated
        should_move = self.is_repeated and expected_shift() > MIN_EXPECTED_SHIFT
        self._is_frozen |= should_move and was_carried
        self.is_carried = should_move and not self._is_frozen
        return self._is_frozen


class ImageRotation:
    """Compares each image with the one before."""

    def __init__(self, camera: StereoCamera) -> None:
        self._scale = SMALL_WIDTH_PX / 4 / camera.width
        height = max(8, round(camera.height * self._scale))
        self._size = (SMALL_WIDTH_PX // 4, height)
        self._window = cv2.createHanningWindow(self._size, cv2.CV_32F)
        self._focal = (camera.fx * self._scale, camera.fy * height / camera.height)
        self._last: NDArray[np.float32] | None = None
        self._now: NDArray[np.float32] | None = None

    def see(self, image: NDArray[np.float32]) -> None:
        """Take in the next image (H, W)."""
        small = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        self._last, self._now = self._now, np.asarray(cv2.GaussianBlur(small, (0, 0), 0.75))

    def turn_since_last(self) -> Array:
        """Return T_now_last (4, 4) between the last two images, a rotation about the camera's
        centre.

        The identity where there was no image before, or where the two have too little in common.
        """
        if self._last is None or self._now is None:
            return np.eye(4)
        (du, dv), response = cv2.phaseCorrelate(self._last, self._now, self._window)
        if response < MIN_RESPONSE:
            return np.eye(4)
        # A scene point that moves right by du lies further to the right now: it turned about +y.
        angles = [-np.arctan2(dv, self._focal[1]), np.arctan2(du, self._focal[0]), 0.0]
        return make_transform(Rotation.from_euler('xyz', angles).as_matrix(), np.zeros(3))
