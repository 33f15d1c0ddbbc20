"""The pictures of docs/wrong_map.md: `python -m tools.symptoms FOLDER`.

Each fault is put into one drive of the simulator, or into the command that maps it; the map is laid
on the truth, and what the command said is printed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Optional

import cv2
import typer

from segfloor_ros.cli.main import run_command
from segfloor_ros.cli.terminal import announcing, console
from segfloor_ros.evaluation.map_score import compare, draw_overlay
from segfloor_ros.evaluation.maps import load_truth
from segfloor_ros.files.results import write_file
from segfloor_ros.grid.map_file import load_map
from segfloor_ros.simulation.scene_file import open_scene
from segfloor_ros.simulation.simulation import RecordingOptions, render_once
from segfloor_ros.suite.job import ProgramError, run_segfloor

SMALL = ('camera.width=480', 'camera.height=360')
WIDTH_PX = 640
TIMEOUT_S = 1800.0


@dataclass(frozen=True)
class Symptom:
    """scene: its assignments in the simulator. words: for `segfloor run`. baseline_factor: the
    calibration's baseline is multiplied by it.
    """

    drive: str
    scene: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    baseline_factor: float = 1.0


def _mount(height_m: float, pitch_rad: float) -> tuple[str, ...]:
    values = {'height_m': height_m, 'pitch_rad': pitch_rad, 'roll_rad': 0.0}
    return tuple(
        word
        for item in values.items()
        for word in ('--set', 'stereo_slam.camera_{}={}'.format(*item))
    )


SYMPTOMS = {
    'as_it_should_be': Symptom('corridor1'),
    'wrong_mount': Symptom('corridor1', words=_mount(0.21, 0.21)),
    'plain_floor': Symptom('corridor1', ('floor.texture=plain',)),
    'shiny_floor': Symptom('glossy_floor'),
    'blur': Symptom('corridor1', ('camera.exposure_s=0.08', 'path.speed_m_s=1.2')),
    'eyes_not_simultaneous': Symptom('corridor1', ('camera.lag_s=0.08',)),
    'rows_off': Symptom('corridor1', ('camera.row_offset_px=3',)),
    'wrong_baseline': Symptom('corridor1', baseline_factor=1.15),
    'people': Symptom('person_leaving', words=('--set', 'stereo_slam.detect_moving=false')),
}


def symptoms(
    out: Annotated[Path, typer.Argument(help='Folder for drives, results and pictures.')],
    only: Annotated[Optional[str], typer.Option(help='One of them.')] = None,  # noqa: UP045
) -> None:
    """Render, map and draw every symptom; what is rendered already is used again."""
    out.mkdir(parents=True, exist_ok=True)
    for name, symptom in SYMPTOMS.items():
        if only in (None, name):
            console.rule(name)
            console.print(_drawn(symptom, name, out), markup=False, highlight=False)


def _drawn(symptom: Symptom, name: str, out: Path) -> str:
    """Write the picture of a symptom. Returns what the command said."""
    recording, result = out / f'{name}_drive', out / f'{name}_result'
    with announcing() as announce:
        scene = open_scene(symptom.drive, (*SMALL, *symptom.scene))
        render_once(scene, recording, RecordingOptions(floor_every=0),
                    lambda total: announce(f'rendering {name}', total))  # fmt: skip
    if symptom.baseline_factor != 1.0:
        scale_baseline(recording / 'calib.txt', symptom.baseline_factor)
    log = out / f'{name}.txt'
    try:
        words = ['run', str(recording), '--out', str(result), *symptom.words]
        run_segfloor(words, log, TIMEOUT_S)
    except ProgramError as error:
        return str(error)
    maps = compare(load_map(result / 'map.yaml'), load_truth(recording))
    picture = draw_overlay(maps)
    scale = WIDTH_PX / picture.shape[1]
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    write_file(out / f'{name}.png', cv2.imencode('.png', small)[1].tobytes())
    return log.read_text()


def scale_baseline(calibration: Path, factor: float) -> None:
    """Multiply the baseline of a KITTI calibration, once: what it was stays beside it."""
    before = calibration.with_suffix('.before')
    if not before.exists():
        before.write_text(calibration.read_text())
    lines = before.read_text().splitlines()
    for row, line in enumerate(lines):
        words = line.split()
        if words and words[0] == 'P1:':
            words[4] = repr(float(words[4]) * factor)
            lines[row] = ' '.join(words)
    calibration.write_text('\n'.join(lines) + '\n')


if __name__ == '__main__':
    run_command(symptoms)
