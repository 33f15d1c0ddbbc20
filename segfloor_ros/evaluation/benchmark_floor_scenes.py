"""Floor masks of simulated drives against what is really there, pose and mount known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.configuration import Configuration
from segfloor_ros.floor.observation import FLOOR
from segfloor_ros.floor.segmentation import FloorSegmentation
from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.simulation.scene import Scene
from segfloor_ros.simulation.simulation import FrameTruth, Simulation

SCENES = (
    'lane',
    'rolled_left',
    'rolled_right',
    'ramp',
    'steep_ramp',
    'glossy_strip',
    'glossy_floor',
    'textureless_strip',
    'low_box',
    'door_sill',
    'kerb',
)
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


def mount_of(scene: Scene) -> Mount:
    """Return where the scene's camera sits on the base."""
    rig = scene.camera
    pitch, roll = np.radians([rig.pitch_deg, rig.roll_deg])
    return Mount(rig.height_m, float(pitch), float(roll), rig.forward_m)


def score_scene(
    name: str, scene: Scene, configuration: Configuration, on_progress: Callable[[int], None]
) -> SceneScore:
    """Render some stretches of a scene's drive and score the masks of their last frames. Raises
    RenderingError where nothing can be rendered.
    """
    counts = np.zeros(8, np.int64)
    with Simulation(scene) as simulation:
        mount = mount_of(scene)
        stage = FloorSegmentation(simulation.camera, configuration.floor_segmentation)
        T_left_base = np.linalg.inv(mount.T_base_left)
        step = max(1, round(KEYFRAME_S * scene.camera.rate_hz))
        indices = np.arange(0, simulation.frame_count, step)
        scored = set(indices[:: -(-len(indices) // MASKS)].tolist())
        for done, index in enumerate(indices.tolist(), start=1):
            frame = simulation.frame(index)
            T_map_base = frame.T_world_left @ T_left_base
            mask = stage.process(frame.left, frame.right, mount, T_map_base).mask
            if index in scored:
                truth = simulation.truth(index)
                counts += count(mask, truth, simulation.camera, mount.T_base_left)
            on_progress(done)
    shares = [_ratio(counts[i], counts[i + 1]) for i in range(0, 8, 2)]
    return SceneScore(name, len(scored), *shares)


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
