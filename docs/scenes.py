"""Draws what the shipped scenes look like: MUJOCO_GL=egl python docs/scenes.py."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from segfloor_ros.apps.simulation.scene_file import open_scene, shipped
from segfloor_ros.apps.simulation.simulation import Simulation

PICTURE = Path(__file__).parent / 'images' / 'scenes.jpg'
COLUMNS, SIZE, TITLE_PX, QUALITY = 5, (240, 180), 22, 82
FAR_ALONG = 0.3
"""Of a drive: past the start, and before the way back."""


def thumbnail(name: str) -> np.ndarray:
    """Return what the left camera sees in a scene, below its name."""
    with Simulation(open_scene(name)) as simulation:
        frame = simulation.frame(int(FAR_ALONG * simulation.frame_count))
    picture = cv2.resize(frame.left, SIZE, interpolation=cv2.INTER_AREA)
    title = np.full((TITLE_PX, SIZE[0]), 255, np.uint8)
    cv2.putText(title, name, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, 0, 1, cv2.LINE_AA)
    return np.vstack([title, picture])


def main() -> None:
    """Write the picture of all scenes."""
    drawn = [thumbnail(name) for name in shipped()]
    drawn += [np.full_like(drawn[0], 255)] * (-len(drawn) % COLUMNS)
    rows = [np.hstack(drawn[i : i + COLUMNS]) for i in range(0, len(drawn), COLUMNS)]
    cv2.imwrite(str(PICTURE), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == '__main__':
    main()
