"""Recordings as nobody tuned on them: `python -m tools.variants DATA WORK`.

Recordings with outlined floors, played backwards, at half their rate, darker, noisier, with
other contrast or compressed, are mapped and scored by the same outlines.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.evaluation.floor import (
    FloorScore,
    count_pixels,
    draw_outline,
    read_mask,
    read_outlines,
)
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.suite.job import ProgramError, run_segfloor
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.nodes.configuration import resolve
from tools.figures import OUTLINES, TIMEOUT_S

Image = NDArray[np.uint8]
NOISE = np.random.default_rng(0)


def noisy(image: NDArray[Any], sigma_grey: float) -> Image:
    """Return an image (H, W) with noise."""
    return np.clip(np.rint(image + NOISE.normal(0, sigma_grey, image.shape)), 0, 255).astype(
        np.uint8
    )


def compressed(image: Image) -> Image:
    """Return an image (H, W) as a JPEG of quality 50 shows it."""
    return np.asarray(
        cv2.imdecode(cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 50])[1], 0)
    )


VARIANTS: dict[str, tuple[slice, Callable[[Image], Image]]] = {
    'as it is': (np.s_[:], lambda image: image),
    'backwards': (np.s_[::-1], lambda image: image),
    'every second': (np.s_[::2], lambda image: image),
    'dark': (np.s_[:], lambda image: noisy(0.45 * image, 1.5)),
    'noise of 4 grey levels': (np.s_[:], lambda image: noisy(image, 4.0)),
    'gamma 0.6': (np.s_[:], lambda image: noisy(255 * (image / 255) ** 0.6, 0.0)),
    'JPEG 50': (np.s_[:], compressed),
}
"""Which frames, and what becomes of each image."""


def write_variant(recording: Path, name: str, folder: Path) -> list[int]:
    """Write a variant of a stereo recording as KITTI odometry; returns the frames it is made of."""
    frames_of, change = VARIANTS[name]
    source = open_source(resolve(stereo_camera={'input': str(recording)}).stereo_camera)
    camera, frames = source.camera, list(source.frames())[frames_of]
    for eye in ('image_0', 'image_1'):
        (folder / eye).mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / 'image_0' / f'{i:06d}.png'), change(frame.left))
        cv2.imwrite(str(folder / 'image_1' / f'{i:06d}.png'), change(frame.right))
    times = [abs(frame.stamp_ns - frames[0].stamp_ns) * 1e-9 for frame in frames]
    (folder / 'times.txt').write_text(''.join(f'{t:.6f}\n' for t in times))
    rows = []
    for name_, shift in (('P0', 0.0), ('P1', -camera.disparity_times_depth)):
        P = np.hstack([camera.K, np.array([[shift], [0.0], [0.0]])])
        rows.append(f'{name_}: ' + ' '.join(f'{value:.12e}' for value in P.ravel()))
    (folder / 'calib.txt').write_text('\n'.join(rows) + '\n')
    return [frame.index for frame in frames]


def score_variant(out: Path, outlines: Path, indices: Sequence[int]) -> FloorScore:
    """Score the masks of a run by the outlines of the frames it was made of."""
    counts, scored = np.zeros(5, np.int64), 0
    for index, outline in read_outlines(outlines).items():
        path = out / 'floor_masks' / f'{indices.index(index):06d}.png' if index in indices else out
        if path.is_file():
            mask = read_mask(path)
            counts += count_pixels(mask, draw_outline(outline, mask.shape))
            scored += 1
    return FloorScore(scored, 0, *(int(value) for value in counts))


def variants(
    data: Annotated[Path, typer.Argument(help='Folder of the recordings.')],
    work: Annotated[Path, typer.Argument(help='Folder for variants and results.')],
    names: Annotated[str, typer.Option(help='Recordings, with commas.')] = 'kitti06,library,rover',
) -> None:
    """Map variants of recordings and score their floors."""
    table = Table(
        'recording',
        'variant',
        'tracked',
        'height m',
        'precision',
        'recall',
        'false floor',
        'moving',
    )
    for name in names.split(','):
        for variant in VARIANTS:
            folder = work / f'{name}_{variant.replace(" ", "_")}'
            console.print(f'{name}, {variant}')
            indices = write_variant(data / name, variant, folder)
            out = folder.with_name(f'{folder.name}_out')
            words = ['run', str(folder), '--out', str(out), '--save-masks', 'all']
            with contextlib.suppress(ProgramError):  # without a map there is a summary, too
                run_segfloor(words, folder.with_name(f'{folder.name}.txt'), TIMEOUT_S)
            summary = read_json(out / 'summary.json', 'a summary')
            score = score_variant(out, OUTLINES / f'{name}_floor_outlines.yaml', indices)
            height_m = summary.get('camera_height_m')
            table.add_row(
                name,
                variant,
                f'{summary["tracked_frames"]}/{summary["frames"]}',
                '–' if height_m is None else f'{height_m:.3f}',
                *(
                    f'{100 * v:.1f}'
                    for v in (score.precision, score.recall, score.false_floor_share)
                ),
                str(summary['moving_frames']),
            )
    console.print(table)


if __name__ == '__main__':
    run_command(variants)
