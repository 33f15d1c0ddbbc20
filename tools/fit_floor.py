"""The weights of the likelihood of floor, from all drives of the floor bench whose floor is known.

    python -m tools.fit_floor

Fits a logistic regression on pixels of each drive, as many of floor as of anything else, prints
the weights as they stand in `mask/likelihood.py`, and how well those that are fitted without a
drive, and without its family of scenes, tell its floor.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Optional

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import PlainConsole, console
from segfloor_ros.apps.cli.terminal import announcing
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.floor.disparity.matching import SAME_PX
from segfloor_ros.core.floor.disparity.profile import STEP_PX
from segfloor_ros.core.floor.mask.likelihood import (
    LEAST_KNOWN,
    WEIGHTS,
    Likelihood,
    Seen,
    features,
    known_weight,
)
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.geometry import Array
from segfloor_ros.nodes.configuration import resolve
from tools.floor_bench import BENCH_CACHE, WIDTH, height_table, rows_by_name, segment, table_of
from tools.floor_inputs import OUTLINED, TRUE_FLOOR, UNKNOWN, FloorDrive, bench_drives, floor_drive
from tools.plain_pnp import DATA

PIXELS = 1500
"""Of each kind, of a frame."""
REAL = 2.0
"""So much more counts a drive that was outlined by hand than a rendered one."""
RIDGE, ROUNDS = 1e-3, 25


class Recorder(Likelihood):
    """Keeps what is seen in the last frame. rows: of its mask."""

    seen: Seen
    rows: int

    def weighed(
        self, mask: NDArray[np.uint8], seen: Seen
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return a mask (R, W) corrected, and what is climbed."""
        self.seen, self.rows = seen, len(mask)
        return super().weighed(mask, seen)


@dataclass(frozen=True)
class Pixels:
    """Some pixels: values (N, F), bool (N,) whether they are floor, and weights (N,)."""

    values: Array
    is_floor: NDArray[np.bool_]
    weight: Array

    @classmethod
    def joined(cls, parts: Sequence[Pixels]) -> Pixels:
        """Return those of several frames or drives as one."""
        columns = ([getattr(part, field.name) for part in parts] for field in fields(cls))
        return cls(*(np.concatenate(column) for column in columns))

    def weighing(self, weight: float) -> Pixels:
        """Return them such that all of floor weigh so much, and all of what is none."""
        own = self.weight.copy()
        for kind in (True, False):
            own[self.is_floor == kind] *= weight / max(own[self.is_floor == kind].sum(), 1e-9)
        return replace(self, weight=own)

    def fitted(self) -> Array:
        """Return the weights (F,) of a logistic regression, by Newton's method."""
        found = np.zeros(self.values.shape[1])
        keep = RIDGE * np.eye(len(found))
        weight = self.weight / self.weight.sum()
        for _ in range(ROUNDS):
            chance = 1 / (1 + np.exp(-np.clip(self.values @ found, -30, 30)))
            gradient = self.values.T @ (weight * (self.is_floor - chance)) - keep @ found
            hessian = (self.values.T * (weight * chance * (1 - chance))) @ self.values + keep
            found += np.linalg.solve(hessian, gradient)
        return found


def pixels_of(drive: FloorDrive, configuration: Configuration, rng: np.random.Generator) -> Pixels:
    """Return pixels of the scored frames of a drive that are measured, drawn by chance."""
    stage = FloorSegmentation(drive.camera, configuration.floor_segmentation)
    stage.likelihood = recorder = Recorder()
    found = []
    for frame, _ in drive.masks(stage):
        if frame.truth is None:
            continue
        seen = recorder.seen
        part = np.s_[-recorder.rows :: STEP_PX, ::STEP_PX]
        label, known = frame.truth.label[part], known_weight(seen)
        counts = (label != UNKNOWN) & (seen.floor_px > SAME_PX) & (known > LEAST_KNOWN)
        if frame.moving is not None:
            counts &= frame.moving[part] == 0
        parts, _ = features(seen, known)
        for kind in (True, False):
            at = np.flatnonzero(counts & ((label == TRUE_FLOOR) == kind))
            at = rng.choice(at, min(PIXELS, len(at)), replace=False) if len(at) else at
            values = parts.reshape(len(parts), -1)[:, at].T.astype(np.float64)
            weight = np.full(len(at), 1 / max(len(at), 1))
            found.append(Pixels(values, np.full(len(at), kind), weight))
    return Pixels.joined(found)


def fitted(drives: dict[str, Pixels], outlined: set[str]) -> Likelihood:
    """Return the likelihood that fits the pixels of drives; outlined: by hand, by name."""
    parts = [one.weighing(REAL if name in outlined else 1.0) for name, one in drives.items()]
    return Likelihood(Pixels.joined(parts).fitted())


def fit_floor(
    held_out: Annotated[
        bool, typer.Option('--held-out', help='Score masks by weights of other drives.')
    ] = False,
    json_file: Annotated[
        Optional[Path],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Option('--json', help='File for the figures, as of tools.floor_bench.'),
    ] = None,
    compare: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Figures of an earlier --json: they stand before the arrows.'),
    ] = None,
    data: Annotated[Path, typer.Option(help='Folder of the recordings.')] = DATA,
    cache: Annotated[Path, typer.Option(help='Folder of the bench.')] = BENCH_CACHE,
) -> None:
    """Fit the weights of the likelihood of floor and print them."""
    cv2.setNumThreads(1)
    configuration, rng = resolve(None, ()), np.random.default_rng(0)
    benches = bench_drives(data.resolve())
    outlined = {one.name for one in benches if one.group == OUTLINED}
    with announcing() as announce:
        drives = {
            one.name: floor_drive(one, cache.expanduser(), False, announce) for one in benches
        }
    pixels = {name: pixels_of(drive, configuration, rng) for name, drive in drives.items()}
    of_all = fitted(pixels, outlined)
    for name, weight in zip(WEIGHTS, of_all.weights, strict=True):
        console.print(f"    '{name}': {weight:.2f},", highlight=False)
    if not held_out:
        return
    rows = []
    for bench in benches:
        alike = {one.name for one in benches if one.group == bench.group} - outlined
        others = {n: p for n, p in pixels.items() if n != bench.name and n not in alike}
        likelihood = fitted(others, outlined)
        _, row = segment(bench, drives[bench.name], configuration, likelihood)
        rows.append(row)
    if json_file:
        json_file.write_text(json.dumps({'rows': [asdict(row) for row in rows]}) + '\n')
    before = rows_by_name(compare) if compare else {}
    wide = PlainConsole(width=max(console.width, WIDTH))
    wide.print(table_of(rows, before))
    wide.print(height_table(rows, before))


if __name__ == '__main__':
    run_command(fit_floor)
