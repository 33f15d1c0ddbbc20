"""The pictures of docs/wrong_map.md: `python -m tools.symptoms FOLDER`.

Each fault is put into one drive of the simulator, or into the command that maps it; the map is laid
on the truth, and what the command said is printed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Optional

import cv2
import numpy as np
import typer
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import announcing
from segfloor_ros.apps.evaluation.map_score import compare, draw_overlay
from segfloor_ros.apps.evaluation.maps import load_truth
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.ply import read_ply
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import RecordingOptions, render_once
from segfloor_ros.apps.suite.job import ProgramError, run_segfloor
from segfloor_ros.core.contracts import POINT_FLOOR, POINT_OBSTACLE

SMALL = ('camera.width=480', 'camera.height=360')
WIDTH_PX = 640
TIMEOUT_S = 1800.0

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Symptom:
    """scene: its assignments in the simulator. words: for `segfloor run`. baseline_factor and
    focal_factor: the calibration's are multiplied by them. late_s: of the stamps of the wheels.
    from_the_side: the picture is of the cloud, height over x.
    """

    drive: str
    scene: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    baseline_factor: float = 1.0
    focal_factor: float = 1.0
    late_s: float = 0.0
    from_the_side: bool = False


def _mount(height_m: float, pitch_rad: float) -> tuple[str, ...]:
    values = {'height_m': height_m, 'pitch_rad': pitch_rad, 'roll_rad': 0.0}
    return tuple(
        word
        for item in values.items()
        for word in ('--set', 'stereo_slam.camera_{}={}'.format(*item))
    )


# The right wall of the corridor is a pane for two and a half metres, and behind it is a room.
PANE = (
    'walls=['
    '{points: [[-0.8, -0.9], [0.9, -0.9]], texture: rough_plaster, posters: 3}, '
    '{points: [[0.9, -0.9], [3.4, -0.9]], texture: glass, thickness_m: 0.02}, '
    '{points: [[3.4, -0.9], [5.6, -0.9], [5.6, 0.95], [-0.8, 0.95], [-0.8, -0.9]],'
    ' texture: rough_plaster, posters: 6}, '
    '{points: [[0, -0.95], [0, -2.6], [4.2, -2.6], [4.2, -0.95]], texture: bricks}]',
    'boxes=[{at: [5.38, 0.45], size: [0.34, 0.9, 1.9], texture: books}]',
)

SYMPTOMS = {
    'as_it_should_be': Symptom('corridor1'),
    'wrong_mount': Symptom('corridor1', words=_mount(0.21, 0.21)),
    'tilted': Symptom('corridor1', words=_mount(0.21, 0.21), from_the_side=True),
    'glass': Symptom('corridor1', PANE),
    'plain_floor': Symptom('hall', ('floor.texture=plain',)),
    'shiny_floor': Symptom('glossy_floor', words=_mount(0.3, 0.122)),
    'blur': Symptom('corridor1', ('camera.exposure_s=0.08', 'path.speed_m_s=1.2')),
    'lost_in_turns': Symptom('corridor1', ('camera.exposure_s=0.05', 'path.turn_rate_deg_s=200')),
    'late_stamps': Symptom('blind_corridor', late_s=0.3),
    'wrong_focal_length': Symptom('corridor1', focal_factor=0.9),
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
    if symptom.baseline_factor != 1.0 or symptom.focal_factor != 1.0:
        scale_calibration(recording / 'calib.txt', symptom.baseline_factor, symptom.focal_factor)
    if symptom.late_s:
        delay(recording / 'wheel_odometry.txt', symptom.late_s)
    log = out / f'{name}.txt'
    try:
        words = ['run', str(recording), '--out', str(result), *symptom.words]
        run_segfloor(words, log, TIMEOUT_S)
    except ProgramError as error:
        return str(error)
    picture = _side_view(result) if symptom.from_the_side else _on_the_truth(result, recording)
    scale = WIDTH_PX / picture.shape[1]
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    (out / f'{name}.png').write_bytes(cv2.imencode('.png', small)[1].tobytes())
    return log.read_text()


def _on_the_truth(result: Path, recording: Path) -> Picture:
    return draw_overlay(compare(load_map(result / 'map.yaml'), load_truth(recording)))


def _side_view(result: Path) -> Picture:
    """Draw the labelled cloud of a result from the side, up to 1 m above the floor."""
    cloud = read_ply(result / 'labelled_cloud.ply')
    figure = Figure(figsize=(8, 2.6), layout='constrained', dpi=160)
    axes = figure.subplots()
    for label, name, colour in (
        (POINT_FLOOR, 'floor', 'tab:green'),
        (POINT_OBSTACLE, 'obstacle', 'tab:red'),
    ):
        of_label = cloud.xyz_map[cloud.label == label]
        axes.scatter(of_label[:, 0], of_label[:, 2], s=1, color=colour, label=name)
    axes.axhline(0.0, color='black', linewidth=1, label='where the floor is')
    axes.set(xlabel='x [m]', ylabel='height [m]', ylim=(-0.7, 0.7))
    axes.legend(loc='upper left', markerscale=6)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)


def scale_calibration(calibration: Path, baseline: float, focal: float = 1.0) -> None:
    """Multiply the baseline and the focal length of a KITTI calibration by these factors."""
    lines = before(calibration).splitlines()
    for row, line in enumerate(lines):
        name, *words = line.split() or ['']
        if name in ('P0:', 'P1:'):
            matrix = np.array(words, float).reshape(3, 4)
            matrix[[0, 1], [0, 1]] *= focal
            matrix[0, 3] *= focal * baseline
            lines[row] = ' '.join([name, *(repr(float(value)) for value in matrix.ravel())])
    calibration.write_text('\n'.join(lines) + '\n')


def delay(poses: Path, late_s: float) -> None:
    """Add to the stamps of a file of TUM poses."""
    rows = [line.split() for line in before(poses).splitlines() if not line.startswith('#')]
    lines = [' '.join([f'{float(stamp) + late_s:.9f}', *rest]) for stamp, *rest in rows]
    poses.write_text('\n'.join(lines) + '\n')


def before(path: Path) -> str:
    """Return the text of a file before its fault was put in, which stays beside it."""
    whole = path.with_suffix('.before')
    if not whole.exists():
        whole.write_text(path.read_text())
    return whole.read_text()


if __name__ == '__main__':
    run_command(symptoms)
