"""`segfloor calibrate`: a stereo camera's calibration from pictures of a chessboard."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from segfloor_ros.camera.calibration.chessboard import CalibrationResult, calibrate_folder
from segfloor_ros.cli.options import within
from segfloor_ros.cli.output import console, progress_bar, value_table
from segfloor_ros.errors import SettingsError


def calibrate(
    folder: Annotated[
        Path, typer.Argument(help='Folder of pairs left01, right01, … or with left/ and right/.')
    ],
    square_m: Annotated[
        float,
        typer.Option('--square', callback=within(1e-6, 100), help='Side of a square in metres.'),
    ],
    board: Annotated[
        str, typer.Option(help='Inner corners along the long and the short side.')
    ] = '9x6',
    out: Annotated[
        Path | None,
        typer.Option('--out', help="Folder for left.yaml and right.yaml; else the pictures'."),
    ] = None,
) -> None:
    """Calibrate a stereo pair from chessboard pictures; writes ROS camera calibration files."""
    sides = re.fullmatch('([0-9]{1,2})x([0-9]{1,2})', board)
    if sides is None:
        raise SettingsError(f'--board {board}: expected e.g. 9x6')
    with progress_bar('searching boards', None) as progress:
        result = calibrate_folder(folder, square_m, (int(sides[1]), int(sides[2])), out, progress)
    _print_result(result, out or folder)


def _print_result(result: CalibrationResult, folder: Path) -> None:
    camera = result.calibration.camera
    rows = [
        ('pairs used', f'{result.pairs_used} of {result.pairs_total}'),
        ('reprojection error', f'{result.rms_px:.3f} px RMS'),
        ('row difference after rectification', f'{result.epipolar_rms_px:.3f} px RMS'),
        ('focal length, rectified', f'{camera.fx:.1f} px'),
        ('baseline', f'{camera.baseline_m:.4f} m'),
    ]
    console.print(value_table('calibration', rows, str(folder)))
    console.print(f'{folder / "left.yaml"}\n{folder / "right.yaml"}', highlight=False)
