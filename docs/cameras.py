"""Draws what each camera of docs/cameras.md sees: MUJOCO_GL=egl python -m docs.cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import Simulation
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.nodes.configuration import resolve
from tools.moving_picture import tinted

FOLDER = Path(__file__).parent / 'images' / 'cameras'
DEMO = Path(__file__).parents[1] / 'segfloor_ros' / 'apps' / 'simulation' / 'demo' / 'drive.mcap'
WIDTH, GAP, QUALITY = 300, 4, 80
FAR_M = 5.0
RENDERED = {
    'realsense': ('hall', 'realsense', 0.3),
    'zed': ('complex_room', 'zed', 0.1),
    'oak': ('corridor1', 'oak', 0.2),
    'orbbec': ('complex_room', 'kinect', 0.45),
    'webcams': ('hall', 'webcam', 0.6),
    'kitti': ('town', '', 0.1),
}
"""Scene, kind of camera, and how far along the drive."""


def rendered(scene: str, kind: str, along: float) -> NDArray[np.uint8]:
    """Return the left and the right image of a frame, or image and depth, side by side."""
    with Simulation(open_scene(scene, [f'camera.kind={kind}'] if kind else [])) as simulation:
        frame = simulation.frame(int(along * simulation.frame_count))
    if frame.depth_mm is None:
        return beside(frame.left, frame.right)
    shade = np.clip(255 - frame.depth_mm / (FAR_M * 1000) * 255, 0, 255).astype(np.uint8)
    coloured = cv2.applyColorMap(shade, cv2.COLORMAP_VIRIDIS)
    coloured[frame.depth_mm == 0] = 0
    return beside(frame.left, coloured)


def mapped() -> NDArray[np.uint8]:
    """Return a keyframe of the demo's bag, and the floor in it."""
    source = open_source(resolve(assignments=[f'stereo_camera.input={DEMO}']).stereo_camera)
    views: list[NDArray[np.uint8]] = []
    pipeline = make_pipeline(
        source.camera,
        resolve(),
        lambda keyframe, floor: views.append(
            beside(keyframe.left, tinted(keyframe.left, floor.mask)[:, :, ::-1])
        ),
    )
    for frame in source.frames():
        pipeline.process(frame)
        if len(views) > 3:
            break
    pipeline.finish_tracking()
    pipeline.finish()
    return views[3]


def beside(*panels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return pictures (H, W) or (H, W, 3) as one, in colour."""
    drawn: list[NDArray[np.uint8]] = []
    for panel in panels:
        size = (WIDTH, round(WIDTH * panel.shape[0] / panel.shape[1]))
        small = cv2.resize(panel, size, interpolation=cv2.INTER_AREA)
        small = small if small.ndim == 3 else cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
        drawn += [small, np.full((size[1], GAP, 3), 255, np.uint8)]
    return np.hstack(drawn[:-1])


def main() -> None:
    """Write all pictures."""
    FOLDER.mkdir(exist_ok=True)
    pictures = {name: rendered(*what) for name, what in RENDERED.items()} | {'bag': mapped()}
    for name, picture in pictures.items():
        cv2.imwrite(str(FOLDER / f'{name}.jpg'), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == '__main__':
    main()
