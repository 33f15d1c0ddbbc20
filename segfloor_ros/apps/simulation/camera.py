"""The simulated stereo camera: its calibration, and what it delivers of ideal pictures and depths.

A real camera is a list of effects, each off at its default; `cameras/` has those of some kinds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform
from scipy.spatial.transform import Rotation

from segfloor_ros import MAX_PIXELS
from segfloor_ros.apps.recordings.extrinsics import FISHEYE_RESOLUTION
from segfloor_ros.apps.simulation.scene import CameraRig, DepthSensor, Scene
from segfloor_ros.core.camera.calibration import EyeCalibration
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import SAME_SURFACE_SHARE
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import Array

RAW_CENTRE_OFFSET_PX = ((3.2, -2.7), (-4.1, 1.6))
"""Principal points of unrectified left and right images, off the middle as in real cameras."""

Picture = NDArray[np.float32]

UNDISTORT_ITERATIONS = 60

WHITE, MIDDLE_GREY = 255, 118
"""The latter is what 18 % of white, which automatic exposures aim at, is in sRGB."""

MAX_GAIN = 16
"""24 dB, as of usual sensors."""

BLUR_STEP_PX = 2
"""Of the fastest turn, between two moments at which a picture is rendered while it is exposed."""

HOLE_SIZE_PX = 12.0


def rectified_camera(rig: CameraRig) -> StereoCamera:
    """Return the ideal pair: square pixels, optical axis through the middle of the image."""
    focal_px = rig.width / 2 / float(np.tan(np.radians(rig.fov_x_deg) / 2))
    centre = ((rig.width - 1) / 2, (rig.height - 1) / 2)
    return StereoCamera(rig.width, rig.height, focal_px, focal_px, *centre, rig.baseline_m)


def raw_cameras(rig: CameraRig, seed: int) -> tuple[EyeCalibration, EyeCalibration]:
    """Return the calibrations of the left and the right camera that takes the images."""
    camera = rectified_camera(rig)
    rng = np.random.default_rng([seed, 2])
    sides = []
    for index, offset in enumerate(RAW_CENTRE_OFFSET_PX):
        P = np.column_stack([camera.K, [-camera.disparity_times_depth * index, 0.0, 0.0]])
        if rig.rectified:
            sides.append(EyeCalibration.of_rectified(rig.width, rig.height, P))
            continue
        axis = rng.normal(size=3)
        turn = axis / np.linalg.norm(axis) * np.radians(rig.misalignment_deg)
        K = camera.K + np.array([[0, 0, offset[0]], [0, 0, offset[1]], [0, 0, 0]])
        if rig.fisheye:
            K[:2, :2] /= FISHEYE_RESOLUTION
        D = np.array([*rig.distortion, *[0.0] * 5])[: 4 if rig.fisheye else 5]
        R = Rotation.from_rotvec(turn).as_matrix()
        model = 'equidistant' if rig.fisheye else 'plumb_bob'
        sides.append(EyeCalibration(rig.width, rig.height, K, D, R, P, model))
    return sides[0], sides[1]


@dataclass(frozen=True)
class ImagingPlan:
    """How pictures are taken: the size of the ideal picture, large enough for the lens, and for
    either camera where each of its pixels lies in it (H, W, 2), None where it is the picture.
    """

    width: int
    height: int
    focal_px: float
    raw: tuple[EyeCalibration, EyeCalibration]
    lookup: tuple[Picture, Picture] | None


def plan_imaging(scene: Scene) -> ImagingPlan:
    """Return the plan for a scene's camera."""
    camera, raw = rectified_camera(scene.camera), raw_cameras(scene.camera, scene.seed)
    if scene.camera.rectified:
        return ImagingPlan(camera.width, camera.height, camera.fx, raw, None)
    rays = [_rays(side, camera.width, camera.height) * camera.fx for side in raw]
    half = np.ceil(np.max([np.abs(side).max(axis=(0, 1)) for side in rays], axis=0)).astype(int) + 2
    if 4 * int(half.prod()) > MAX_PIXELS:
        raise InputError('the distortion folds the image over; the lens cannot be simulated')
    left, right = ((side + half - 0.5).astype(np.float32) for side in rays)
    return ImagingPlan(2 * int(half[0]), 2 * int(half[1]), camera.fx, raw, (left, right))


def _rays(side: EyeCalibration, width: int, height: int) -> Array:
    """Return x/z and y/z (H, W, 2), in the rectified frame, of every pixel of a raw camera."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    x, y = (u - side.K[0, 2]) / side.K[0, 0], (v - side.K[1, 2]) / side.K[1, 1]
    if side.distortion_model == 'equidistant':
        distorted = np.stack([x.ravel(), y.ravel()], axis=-1)[None]
        ideal = cv2.fisheye.undistortPoints(distorted, np.eye(3), side.D)
        x, y = ideal.reshape(height, width, 2).transpose(2, 0, 1)
    else:
        x, y = undistort(x, y, side.D)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ side.R.T
    return rays[..., :2] / rays[..., 2:]


def undistort(x: Array, y: Array, distortion: Array) -> tuple[Array, Array]:
    """Return ideal for distorted normalised coordinates, by fixed-point iteration of the plumb_bob
    model (Brown 1966; k1 k2 p1 p2 k3 as in OpenCV).
    """
    k1, k2, p1, p2, k3 = distortion
    ideal_x, ideal_y = x, y
    for _ in range(UNDISTORT_ITERATIONS):
        r2 = ideal_x**2 + ideal_y**2
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        shift_x = 2 * p1 * ideal_x * ideal_y + p2 * (r2 + 2 * ideal_x**2)
        shift_y = p1 * (r2 + 2 * ideal_y**2) + 2 * p2 * ideal_x * ideal_y
        ideal_x, ideal_y = (x - shift_x) / radial, (y - shift_y) / radial
    return ideal_x, ideal_y


def ideal_image(ideal: Picture, plan: ImagingPlan, side: int) -> Picture:
    """Return the image (H, W) of camera `side`, without noise, of an ideal picture."""
    picture = ideal
    if picture.shape != (plan.height, plan.width):
        picture = cv2.resize(picture, (plan.width, plan.height), interpolation=cv2.INTER_AREA)
    if plan.lookup is not None:
        picture = cv2.remap(picture, plan.lookup[side], None, cv2.INTER_CUBIC)
    return picture


def brightness(scene: Scene, time_s: float) -> float:
    """Return the brightness of what the lenses let through at a time."""
    if any(start <= time_s < end for start, end in scene.camera.covered):
        return 0.0
    levels = np.array(scene.lighting.levels)
    return float(np.interp(time_s, levels[:, 0], levels[:, 1])) if len(levels) else 1.0


def moments_s(scene: Scene, side: int) -> tuple[Array, Picture]:
    """Return when the scene is to be seen for a picture of camera `side`, (M,) in seconds from its
    stamp, and how much each row takes of each moment (H, M): what falls into its exposure.
    """
    rig = scene.camera
    taken_s = rig.exposure_s + rig.rolling_s
    turned_px = np.radians(scene.path.turn_rate_deg_s) * taken_s * rectified_camera(rig).fx
    rows = ((np.arange(rig.height) + 0.5) / rig.height - 0.5) * rig.rolling_s
    if not taken_s:
        return np.array([rig.lag_s * side]), np.ones((rig.height, 1), np.float32)
    count = max(2, int(np.ceil(turned_px / BLUR_STEP_PX)))
    # An exposure shorter than the time between two moments is interpolated between them.
    cell_s = max(taken_s / count, rig.rolling_s / (count - 1))
    moments = (np.arange(count) - (count - 1) / 2) * cell_s
    reach_s = (max(rig.exposure_s, cell_s) + cell_s) / 2
    overlap = np.clip(reach_s - np.abs(rows[:, None] - moments), 0.0, cell_s)
    weights = overlap / overlap.sum(axis=1, keepdims=True)
    return moments + rig.lag_s * side, weights.astype(np.float32)


def drift(rig: CameraRig, time_s: float) -> float:
    """Return how far the eyes differ at a time, from 1 as at the start to -1, the opposite."""
    return float(np.cos(2 * np.pi * time_s / rig.drift_s)) if rig.drift_s else 1.0


@dataclass(frozen=True)
class Shot:
    """A picture in the making, of camera `side` (0 left, 1 right). light: of the scene, over that
    of its textures.
    """

    rig: CameraRig
    side: int
    time_s: float
    light: float
    rng: np.random.Generator

    @property
    def differs(self) -> float:
        """How far this eye differs from the left one."""
        return drift(self.rig, self.time_s) * self.side


def _off_its_rows(picture: Picture, shot: Shot) -> Picture:
    """Rows, roll about the middle and focal length of a right image that is not quite rectified."""
    rig, middle = shot.rig, (np.array(picture.shape) - 1) / 2
    if not shot.side or not (rig.row_offset_px or rig.pair_roll_deg or rig.pair_focal):
        return picture
    # Rows and columns of the picture for those of the image.
    turn = Rotation.from_euler('Z', rig.pair_roll_deg * shot.differs, degrees=True)
    matrix = turn.as_matrix()[:2, :2] / (1 + rig.pair_focal * shot.differs)
    lower = np.array([rig.row_offset_px * shot.differs, 0.0])
    offset = middle - matrix @ (middle + lower)
    # Exact to a hundredth of a pixel, which OpenCV's warps are not.
    return np.asarray(affine_transform(picture, matrix, offset, mode='nearest'), np.float32)


def _soft(picture: Picture, shot: Shot) -> Picture:
    """The lens spreads a point."""
    if not shot.rig.softness_px:
        return picture
    return cv2.GaussianBlur(picture, (0, 0), shot.rig.softness_px)


def _vignetted(picture: Picture, shot: Shot) -> Picture:
    """Less light reaches the corners."""
    if not shot.rig.vignetting:
        return picture
    v, u = (np.linspace(-1.0, 1.0, size, dtype=np.float32) ** 2 for size in picture.shape)
    lost = np.float32(shot.rig.vignetting) * (v[:, None] + u) / 2
    return np.asarray(picture * (1 - lost), np.float32)


def _lit(picture: Picture, shot: Shot) -> Picture:
    """The scene's light, and an eye that takes less of it."""
    return picture * np.float32(shot.light * shot.rig.right_gain**shot.differs)


def _noisy(picture: Picture, shot: Shot) -> Picture:
    """Noise of the readout, and of the light: its variance grows with the grey level."""
    of_light = np.float32(shot.rig.shot_noise**2 / WHITE) * np.maximum(picture, 0)
    deviation = np.sqrt(np.float32(shot.rig.noise_sigma**2) + of_light)
    return picture + shot.rng.standard_normal(picture.shape, np.float32) * deviation


def _automatic(picture: Picture, shot: Shot) -> Picture:
    """Each eye amplifies by what it sees; the noise grows with it."""
    gain = (MIDDLE_GREY / max(1.0, float(picture.mean()))) ** shot.rig.auto_exposure
    return picture * np.float32(min(gain, MAX_GAIN))


def _curved(picture: Picture, shot: Shot) -> Picture:
    """Grey levels that do not grow in proportion to the light."""
    if shot.rig.gamma == 1:
        return picture
    return np.asarray(WHITE * (np.maximum(picture, 0) / WHITE) ** shot.rig.gamma, np.float32)


def _in_steps(picture: Picture, shot: Shot) -> NDArray[np.uint8]:
    """Whole grey levels."""
    return np.clip(np.round(picture), 0, WHITE).astype(np.uint8)


def _mosaic(picture: NDArray[np.uint8], shot: Shot) -> NDArray[np.uint8]:
    """One colour per pixel, the others interpolated."""
    if not shot.rig.bayer:
        return picture
    # In 16 bits: some versions of OpenCV round each pixel down.
    fine = cv2.cvtColor(picture.astype(np.uint16) * 256, cv2.COLOR_BayerBG2GRAY)
    return np.asarray(np.round(fine / 256), np.uint8)


def _compressed(picture: NDArray[np.uint8], shot: Shot) -> NDArray[np.uint8]:
    if not shot.rig.jpeg:
        return picture
    encoded = cv2.imencode('.jpg', picture, [cv2.IMWRITE_JPEG_QUALITY, shot.rig.jpeg])[1]
    return cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)


EFFECTS: tuple[Callable[[Any, Shot], Any], ...] = (
    _off_its_rows, _soft, _vignetted, _lit, _noisy, _automatic, _curved, _in_steps, _mosaic,
    _compressed,
)  # fmt: skip
"""What happens to a picture on its way from the lens, in this order."""


def develop(
    ideal: Picture, plan: ImagingPlan, scene: Scene, side: int, frame: int, time_s: float
) -> NDArray[np.uint8]:
    """Return the image (H, W) uint8 that camera `side` (0 left, 1 right) delivers of an ideal
    picture. The noise depends on the scene's seed, the frame and the side alone.
    """
    picture: Any = ideal_image(ideal, plan, side)
    rng = np.random.default_rng([scene.seed, 4, frame, side])
    shot = Shot(scene.camera, side, time_s, brightness(scene, time_s), rng)
    for effect in EFFECTS:
        picture = effect(picture, shot)
    return np.asarray(picture)


def depth_reading_mm(
    scene: Scene,
    focal_px: float,
    true_m: NDArray[np.float32],
    grey: Picture,
    frame: int,
    time_s: float,
) -> NDArray[np.uint16]:
    """Return the depth image (H, W) in mm, 0 where nothing is measured, of true depths (H, W) and
    the grey levels (H, W) of what is there.
    """
    sensor: DepthSensor = scene.sensors.depth
    if any(start <= time_s < end for start, end in scene.camera.covered):
        return np.zeros(true_m.shape, np.uint16)
    rng = np.random.default_rng([scene.seed, 7, frame])
    scale = focal_px * sensor.baseline_m
    noise = cv2.GaussianBlur(rng.standard_normal(true_m.shape, np.float32), (0, 0), 1.0)
    noise *= np.float32(sensor.noise_px / noise.std())
    disparity_px = np.round((scale / true_m + noise) / sensor.step_px) * sensor.step_px
    depth_m = scale / np.maximum(disparity_px, sensor.step_px)
    patches = cv2.GaussianBlur(rng.standard_normal(true_m.shape, np.float32), (0, 0), HOLE_SIZE_PX)
    hole = patches < np.quantile(patches, sensor.hole_share)
    kernel = np.ones((3, 3), np.uint8)
    near_m, far_m = cv2.erode(true_m, kernel), cv2.dilate(true_m, kernel)
    edge = far_m > near_m * (1 + SAME_SURFACE_SHARE)
    flying = edge & (rng.random(true_m.shape) < sensor.flying_share)
    between_m = near_m + (far_m - near_m) * rng.random(true_m.shape)
    depth_m = np.where(flying, between_m, depth_m)
    hole |= (edge & ~flying) | (grey < sensor.dark_grey) | (grey > sensor.shiny_grey)
    hole |= (depth_m < sensor.min_m) | (depth_m > sensor.max_m)
    return np.where(hole, 0, np.round(depth_m * 1000)).astype(np.uint16)
