"""Floor masks of simulated drives against what is really there, pose and mount known."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.cli.terminal import Announce
from segfloor_ros.apps.simulation.scene import Scene
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import (
    DISPARITY_SCALE,
    FrameTruth,
    RecordingOptions,
    render_once,
)
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import FLOOR, Mount
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.geometry import Array, invert, transform_points
from tools.driving import open_recording

SUN = ('ceiling.height_m=0', 'lighting.ambient=0.45', 'lighting.sun=0.9')
SCENES: dict[str, tuple[str, ...]] = {
    'lane': (),
    'rolled_left': (),
    'rolled_right': (),
    'ramp': (),
    'steep_ramp': (),
    'glossy_strip': (),
    'glossy_floor': (),
    'textureless_strip': (),
    'low_box': (),
    'door_sill': (),
    'kerb': (),
    'asphalt': ('floor.texture=asphalt',),
    'carpet': ('floor.texture=carpet',),
    'parquet': ('floor.texture=parquet',),
    'glossy_stone': ('floor.texture=marble', 'floor.reflectance=0.2'),
    'grass': ('floor.texture=grass',),
    'plain': ('floor.texture=plain',),
    'sun_on_asphalt': ('floor.texture=asphalt', *SUN),
    'sun_on_tiles': SUN,
    'sun_on_plain': ('floor.texture=plain', *SUN),
}
"""By name, what is changed of `lane` where no scene of that name is shipped."""
MASKS = 12
KEYFRAME_S = 0.4
NEAREST_M, FARTHEST_M, LOW_FARTHEST_M = 0.5, 6.0, 2.0
SILL_M, LOW_M = (0.01, 0.03), (0.03, 0.10)


@dataclass(frozen=True)
class SceneScore:
    """precision: of all pixels called floor. recall: of the floor at a depth from 0.5 to 6 m. Up
    to 2 m ahead: low_called_floor, of what stands 3 to 10 cm high and is not floor, the feet of
    walls included; sill_called_floor, of floor that lies 1 to 3 cm high. NaN where there is none.
    """

    name: str
    masks: int
    precision: float
    recall: float
    low_called_floor: float
    sill_called_floor: float


def floor_scene(name: str) -> Scene:
    """Return one of `SCENES`, or any other scene by name or file. Raises InputError."""
    changes = SCENES.get(name, ())
    return open_scene('lane' if changes else name, changes)


def mount_of(scene: Scene) -> Mount:
    """Return where the scene's camera sits on the base."""
    rig = scene.camera
    pitch, roll = np.radians([rig.pitch_deg, rig.roll_deg])
    return Mount(rig.height_m, float(pitch), float(roll), rig.forward_m)


def render_floor(name: str, scene: Scene, folder: Path, announce: Announce) -> Path:
    """Render a scene's drive, one frame for each keyframe of a robot, each with its true mask and
    disparity, and return its folder. Raises RenderingError where nothing can be rendered.
    """
    camera = dataclasses.replace(scene.camera, rate_hz=1 / KEYFRAME_S)
    recording = folder / name
    render_once(
        dataclasses.replace(scene, camera=camera),
        recording,
        RecordingOptions(floor_every=1, disparity=True),
        lambda frames: announce(f'rendering {name}', frames),
    )
    return recording


def score_recording(
    name: str, recording: Path, mount: Mount, configuration: Configuration
) -> SceneScore:
    """Segment all frames of a rendered drive, pose and mount known, and score some of the masks."""
    counts = np.zeros(8, np.int64)
    source = open_recording(recording, configuration)
    stage = FloorSegmentation(source.camera, configuration.floor_segmentation)
    poses = read_trajectory(recording / 'poses.txt')[1]
    T_map_base = mount.T_base_left @ poses @ invert(mount.T_base_left)
    scored = range(0, len(poses), -(-len(poses) // MASKS))
    for frame, T in zip(source.frames(), T_map_base, strict=True):
        mask = stage.process(frame.left, frame.right, mount, T).mask
        if frame.index in scored:
            truth = read_truth(recording, frame.index, source.camera)
            counts += count(mask, truth, source.camera, mount.T_base_left)
    shares = [_ratio(counts[i], counts[i + 1]) for i in range(0, 8, 2)]
    return SceneScore(name, len(scored), *shares)


def read_truth(recording: Path, index: int, camera: StereoCamera) -> FrameTruth:
    """Read the true mask and disparity of a frame; where nothing is seen the depth is infinite."""
    floor, scaled = (
        cv2.imread(str(recording / what / f'{index:06d}.png'), cv2.IMREAD_UNCHANGED)
        for what in ('floor', 'disparity')
    )
    disparity_px = (scaled / DISPARITY_SCALE).astype(np.float32)
    with np.errstate(divide='ignore'):
        depth_m = (camera.disparity_times_depth / disparity_px).astype(np.float32)
    return FrameTruth(floor, depth_m, disparity_px)


def count(
    mask: NDArray[np.uint8], truth: FrameTruth, camera: StereoCamera, T_base_left: Array
) -> NDArray[np.int64]:
    """Return numbers of pixels (8,): floor called so and all called floor; the same and all of
    the floor within range; low obstacles called floor and all of them; sill likewise.
    """
    called, is_floor, depth_m = mask == FLOOR, truth.floor > 0, truth.depth_m
    v, u = np.indices(mask.shape, np.float64)
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    points = camera.back_project(uv, np.minimum(depth_m.ravel(), 1e3))
    height_m = transform_points(T_base_left, points)[:, 2].reshape(mask.shape)
    ahead = (depth_m > NEAREST_M) & (depth_m < LOW_FARTHEST_M)
    wanted = is_floor & (depth_m > NEAREST_M) & (depth_m < FARTHEST_M)
    low = ~is_floor & ahead & (height_m > LOW_M[0]) & (height_m < LOW_M[1])
    sill = is_floor & ahead & (height_m > SILL_M[0]) & (height_m < SILL_M[1])
    parts = ((is_floor, called), (called, wanted), (called, low), (called, sill))
    return np.array([[np.sum(a & b), np.sum(b)] for a, b in parts], np.int64).reshape(-1)


def _ratio(part: int, whole: int) -> float:
    return float(part / whole) if whole else float('nan')
