"""A recording as it is mapped, as a GIF: `python -m tools.moving_picture RECORDING OUT.gif`.

Left the image with the floor that was found in it, right the map so far with the path. README's
picture is that of the demo: `python -m tools.moving_picture
segfloor_ros/apps/simulation/demo/drive.mcap docs/images/demo.gif`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from rich.progress import track

from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, FloorObservation, Keyframe
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.occupancy import UNKNOWN, OccupancyGrid
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.nodes.configuration import resolve

Picture = NDArray[np.uint8]

TINTS = {FLOOR: (80, 190, 60), NO_EVIDENCE: (150, 150, 150)}
"""R, G, B; what is neither stays as it is."""


def moving_picture(
    recording: Annotated[str, typer.Argument(help='Recording, as `segfloor run` takes it.')],
    out: Annotated[Path, typer.Argument(help='GIF that is written.')],
    width: Annotated[int, typer.Option(min=200, help='Width in pixels.')] = 680,
    count: Annotated[int, typer.Option(min=2, help='Pictures, evenly over the drive.')] = 40,
    seconds: Annotated[float, typer.Option(min=1.0, help='How long it plays.')] = 12.0,
) -> None:
    """Map a recording and write what was seen and mapped at every keyframe."""
    configuration = resolve(assignments=[f'stereo_camera.input={recording}'])
    source = open_source(configuration.stereo_camera)
    views: list[tuple[Picture, OccupancyGrid, Array]] = []

    def take(keyframe: Keyframe, floor: FloorObservation) -> None:
        grid = pipeline.keyframe_stages.grid()
        if grid is not None:
            views.append((tinted(keyframe.left, floor.mask), grid, keyframe.path.T_map_base))

    pipeline = make_pipeline(source.camera, configuration, take)
    for frame in track(source.frames(), 'mapping', total=source.frame_count, console=console):
        pipeline.process(frame)
    pipeline.finish_tracking()
    pipeline.finish()
    if not views:
        raise InputError(f'{recording}: no keyframe reached the map; nothing is written')
    chosen = np.unique(np.linspace(0, len(views) - 1, count).round().astype(int))
    pictures = [drawn(views[i], views[-1][1], width) for i in chosen]
    first, *rest = (Image.fromarray(p).quantize(96, dither=Image.Dither.NONE) for p in pictures)
    every_ms = max(20, round(1000 * seconds / len(pictures)))
    durations = [every_ms] * len(rest) + [2000]
    first.save(out, save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
    console.print(f'{len(pictures)} pictures, {out.stat().st_size / 1e6:.1f} MB: {out}')


def tinted(image: Picture, mask: Picture) -> Picture:
    """Return a grey image (H, W) with its floor mask tinted, (H, W, 3) RGB."""
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB).astype(np.float32)
    for value, tint in TINTS.items():
        picture[mask == value] = 0.62 * picture[mask == value] + 0.38 * np.array(tint, np.float32)
    return picture.astype(np.uint8)


def drawn(view: tuple[Picture, OccupancyGrid, Array], last: OccupancyGrid, width: int) -> Picture:
    """Return one picture (H, W, 3) RGB: what a keyframe saw, and the map with the path up to it.
    last: the whole map, whose extent all pictures have.
    """
    image, grid, path = view
    figure = Figure(figsize=(width / 100, width / 230), dpi=100, layout='constrained')
    seen, mapped = figure.subplots(1, 2)
    seen.imshow(image)
    seen.set_axis_off()
    mapped.imshow(grid.picture, extent=grid.extent_m, cmap='gray', vmin=0, vmax=255,
                  interpolation='nearest')  # fmt: skip
    mapped.plot(*path[:, :2, 3].T, color='tab:blue', linewidth=2)
    mapped.plot(*path[-1, :2, 3], 'o', color='tab:orange', markersize=5)
    left, _, bottom, _ = last.extent_m
    rows, columns = np.nonzero(last.cells != UNKNOWN)
    across = left + last.resolution_m * np.array([columns.min() - 3, columns.max() + 4])
    along = bottom + last.resolution_m * np.array([rows.min() - 3, rows.max() + 4])
    mapped.set(xlim=across, ylim=along, facecolor=(205 / 255,) * 3)
    mapped.set(xticks=[], yticks=[], aspect='equal')
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


if __name__ == '__main__':
    run_command(moving_picture)
