"""Recordings that a benchmark renders, kept for the next time."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

from segfloor_ros.evaluation.benchmark import Announce
from segfloor_ros.simulation.recording import RecordingOptions, record
from segfloor_ros.simulation.scene import Scene
from segfloor_ros.simulation.simulation import Simulation


def render_once(name: str, scene: Scene, recording: Path, stamp: Path, announce: Announce) -> None:
    """Render a drive into the folder `recording` unless it holds this very scene already, as the
    file `stamp` says. Raises RenderingError where nothing can be rendered.
    """
    wanted = hashlib.sha256(repr(scene).encode()).hexdigest() + '\n'
    if recording.is_dir() and stamp.is_file() and stamp.read_text() == wanted:
        return
    with Simulation(scene) as simulation:
        stamp.unlink(missing_ok=True)
        if recording.is_dir():
            shutil.rmtree(recording)
        report = announce(f'rendering {name}', simulation.frame_count)
        record(simulation, recording, RecordingOptions(floor_every=0), report)
    stamp.write_text(wanted)
