"""The share of each step of floor segmentation, what the choices of the disparity bring, and masks
of simulated drives against the truth: `python -m tools.benchmark_floor`.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Annotated, Optional

import cv2
import typer
from rich.table import Table

from segfloor_ros.apps.cli import terminal as options
from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import announcing, figure_table
from segfloor_ros.nodes.configuration import resolve
from tools.disparity_choices import DisparityScore, choices, read_pairs, score
from tools.floor_masks import (
    SCENES,
    SceneScore,
    floor_scene,
    mount_of,
    render_floor,
    score_recording,
)
from tools.floor_steps import (
    WITHOUT_DISPARITY,
    FloorTimes,
    generated_keyframes,
    keyframes_of,
    time_steps,
)


def benchmark_floor(
    recordings: Annotated[
        Optional[list[str]],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Argument(help='Recordings whose keyframes to segment. [default: generated images]'),
    ] = None,
    frames: Annotated[int, typer.Option(min=3, help='Generated image pairs.')] = 60,
    seed: Annotated[int, typer.Option(help='Of the generated images.')] = 0,
    threads: Annotated[
        int, typer.Option(min=1, help='Threads of OpenCV; 1: time computed, whatever else goes on.')
    ] = 2,
    middlebury: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Folder with cones/ and teddy/: score the choices of the disparity too.'),
    ] = None,
    simulated: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help='Scenes to simulate and score, with commas; all: those made for floor.'),
    ] = None,
    workdir: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Keep renderings here; what is there is used again.'),
    ] = None,
    params: options.Params = None,
    assignments: options.Set = None,
) -> None:
    """Time each step of floor segmentation; with --middlebury, score the disparity; with
    --simulated, score the masks.
    """
    configuration = resolve(params, assignments or ())
    if simulated is not None:
        names = [*SCENES] if simulated == 'all' else simulated.split(',')
        scenes = {name: floor_scene(name) for name in names}
        with tempfile.TemporaryDirectory(prefix='segfloor-') as temporary, announcing() as announce:
            found = []
            for name, scene in scenes.items():
                recording = render_floor(name, scene, workdir or Path(temporary), announce)
                found.append(score_recording(name, recording, mount_of(scene), configuration))
        console.print(scenes_table(found))
        return
    pairs = read_pairs(middlebury) if middlebury is not None else []
    with announcing() as announce:
        announce('segmenting generated images', 0)
        for name in recordings or ['generated']:
            camera, keyframes = (
                keyframes_of(name, configuration, announce)
                if recordings
                else generated_keyframes(frames, seed)
            )
            title = f'{Path(name).name}, {camera.width}x{camera.height}'
            console.print(steps_table(time_steps(title, camera, keyframes, configuration, threads)))
        cv2.setNumThreads(threads)
        scores = []
        for choice, match in choices(configuration.floor_segmentation).items() if pairs else ():
            announce(choice, 0)
            scores += [score(choice, match, pair) for pair in pairs]
    if scores:
        console.print(disparity_table(scores))


def scenes_table(scores: list[SceneScore]) -> Table:
    """Return a row for each scene."""
    names = ('precision %', 'recall %', 'low as floor %', 'sill as floor %')
    table = figure_table('scene', 'masks', *names)
    for one in scores:
        shares = (one.precision, one.recall, one.low_called_floor, one.sill_called_floor)
        cells = ('-' if math.isnan(share) else f'{100 * share:.1f}' for share in shares)
        table.add_row(one.name, str(one.masks), *cells)
    table.caption = (
        'recall: floor from 0.5 to 6 m; low: what stands 3 to 10 cm high up to 2 m ahead, feet of '
        'walls included; sill: floor that lies 1 to 3 cm high'
    )
    return table


def steps_table(times: FloorTimes) -> Table:
    """Return a row for each step: its time per keyframe and its share."""
    table = figure_table('step', 'median ms', 'p95 ms', 'share %')
    table.title = times.name
    for name, step in times.steps.items():
        if name == WITHOUT_DISPARITY:
            table.add_section()
        share = f'{100 * step["share"]:.1f}'
        table.add_row(name, f'{step["p50_ms"]:.2f}', f'{step["p95_ms"]:.2f}', share)
    table.caption = f'{times.keyframes} keyframes; shares of the time of all'
    return table


def disparity_table(scores: list[DisparityScore]) -> Table:
    """Return a row for each choice and pair."""
    names = ('bad-0.5', 'bad-1.0', 'bad-2.0', 'wrong', 'matched', 'median ms')
    table = figure_table('disparity', 'pair', *names)
    for one in scores:
        shares = (one.bad_half, one.bad_1, one.bad_2, one.wrong_2, one.matched)
        table.add_row(
            one.choice, one.pair, *(f'{100 * s:.1f}' for s in shares), f'{one.time_ms:.1f}'
        )
    table.caption = (
        'bad: off by more, or no match, in % of the pixels that both cameras see; '
        'wrong: off by more than 2 px, in % of those matched'
    )
    return table


if __name__ == '__main__':
    run_command(benchmark_floor)
