"""Rendered drives that are kept for the next time."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

from segfloor_ros import __version__
from segfloor_ros.simulation.drive_files import RecordingOptions, record
from segfloor_ros.simulation.scene import Scene
from segfloor_ros.simulation.simulation import Simulation

Progress = Callable[[int], None]
STAMP = 'rendered_from.txt'


def render_once(
    scene: Scene,
    recording: Path,
    options: RecordingOptions = RecordingOptions(floor_every=0),  # noqa: B008  it is frozen
    on_start: Callable[[int], Progress] = lambda total: lambda done: None,
) -> None:
    """Render a drive into the folder `recording`, unless it holds this drive already.

    on_start: told the number of frames; returns whom to tell how many are done. Raises
    RenderingError where nothing can be rendered.
    """
    stamp = recording / STAMP
    wanted = hashlib.sha256(repr((__version__, scene, options)).encode()).hexdigest() + '\n'
    if stamp.is_file() and stamp.read_text() == wanted:
        return
    with Simulation(scene) as simulation:
        if recording.is_dir():
            shutil.rmtree(recording)
        record(simulation, recording, options, on_start(simulation.frame_count))
    stamp.write_text(wanted)
