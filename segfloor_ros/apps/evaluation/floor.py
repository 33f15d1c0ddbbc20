"""The score of floor masks against the true ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.images import check_same_size, read_mask
from segfloor_ros.nodes.yaml_files import read_yaml

OUTLINES = ('floor', 'obstacle', 'unsure')
FAR_PX = np.iinfo(np.int16).max
UNSURE_PX = 2
"""How far the outlines of floor that are drawn by hand may be off."""


@dataclass(frozen=True)
class FloorScore:
    """Pixel counts over all masks that both sides have, and the shares that follow from them.
    Pixels without evidence in the truth do not count; in the estimate they are not called floor.
    """

    masks: int
    missing: int
    true_floor: int
    false_floor: int
    missed_floor: int
    with_evidence: int
    pixels: int

    @property
    def precision(self) -> float:
        """Share of the pixels called floor that are."""
        return _ratio(self.true_floor, self.true_floor + self.false_floor)

    @property
    def recall(self) -> float:
        """Share of the true floor that is called floor."""
        return _ratio(self.true_floor, self.true_floor + self.missed_floor)

    @property
    def iou(self) -> float:
        """Intersection over union of the called and the true floor."""
        return _ratio(self.true_floor, self.true_floor + self.false_floor + self.missed_floor)

    @property
    def false_floor_share(self) -> float:
        """Share of what is not floor that is called floor."""
        return _ratio(self.false_floor, self.pixels - self.true_floor - self.missed_floor)

    @property
    def coverage(self) -> float:
        """Share of the pixels for which the estimate has evidence either way."""
        return _ratio(self.with_evidence, self.pixels)

    def as_dict(self) -> dict[str, float]:
        """Return counts and shares as plain numbers."""
        names = ('precision', 'recall', 'false_floor_share', 'iou', 'coverage')
        shares = {name: getattr(self, name) for name in names}
        return {**shares, 'masks': self.masks, 'missing': self.missing, 'pixels': self.pixels}


def score_floor_folders(estimate: Path, truth: Path) -> FloorScore:
    """Score the masks of one folder against those of the same name in another.

    Folders of a run (with floor_masks/) and of a scene (with floor/) will do, and for the truth a
    file of outlines (see `read_outlines`). Masks of the truth that the estimate lacks are counted
    as missing and not scored. Raises InputError when no name is in both, or when sizes differ.
    """
    estimates = _mask_files(estimate, 'floor_masks')
    outlines = read_outlines(truth) if truth.suffix == '.yaml' else {}
    drawn = {f'{index:06d}.png': outline for index, outline in outlines.items()}
    files = {} if drawn else _mask_files(truth, 'floor')
    truths = drawn.keys() | files.keys()
    common = sorted(estimates.keys() & truths)
    if not common:
        raise InputError(f'{estimate} and {truth} have no mask of the same name (%06d.png)')
    counts = np.zeros(5, np.int64)
    for name in common:
        mask = read_mask(estimates[name])
        true = draw_outline(drawn[name], mask.shape) if drawn else read_mask(files[name])
        check_same_size(mask, true.shape, estimates[name])
        counts += count_pixels(mask, true)
    return FloorScore(len(common), len(truths) - len(common), *(int(value) for value in counts))


def read_outlines(path: Path) -> dict[int, dict[str, Any]]:
    """Return, by frame, the polygons [u, v, u, v, …] that a YAML file has under `frames`: `floor`,
    `obstacle`, `unsure`. Raises InputError where it has none.
    """
    frames: Any = read_yaml(path, 'frames with outlines').get('frames')
    try:
        found = {int(index): dict(outline) for index, outline in frames.items()}
        for outline in found.values():
            for polygon in [p for kind in OUTLINES for p in outline.get(kind, [])]:
                points = np.array(polygon, np.float64).reshape(-1, 2)
                if len(points) < 3 or not (np.abs(points) < FAR_PX).all():
                    raise ValueError(f'{polygon} is no polygon')
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f'{path}: no outlines of floor by frame ({error})') from None
    return found


def draw_outline(outline: dict[str, Any], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return the mask (H, W) of polygons drawn by hand. Where obstacles are drawn, only what is
    drawn counts; else all that is not floor. Borders do not count, nor what is unsure.
    """
    mask = np.full(shape, NO_EVIDENCE if 'obstacle' in outline else NOT_FLOOR, np.uint8)
    for kind, value, border_px in (('floor', FLOOR, UNSURE_PX), ('obstacle', NOT_FLOOR, 1)):
        drawn = _filled(outline.get(kind, []), shape)
        around = np.ones((2 * border_px + 1, 2 * border_px + 1), np.uint8)
        mask[cv2.dilate(drawn, around) > 0] = NO_EVIDENCE
        mask[cv2.erode(drawn, around) > 0] = value
    mask[_filled(outline.get('unsure', []), shape) > 0] = NO_EVIDENCE
    return mask


def _filled(polygons: list[list[int]], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    picture = np.zeros(shape, np.uint8)
    for polygon in polygons:
        cv2.fillPoly(picture, [np.array(polygon, np.int32).reshape(-1, 2)], 1)
    return picture


def count_pixels(estimate: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return true floor, false floor, missed floor, evidence and all pixels (5,) of one mask."""
    counted = truth != NO_EVIDENCE
    called, is_floor = (estimate == FLOOR) & counted, truth == FLOOR
    return np.array(
        [
            (called & is_floor).sum(),
            (called & ~is_floor).sum(),
            (is_floor & ~called).sum(),
            ((estimate != NO_EVIDENCE) & counted).sum(),
            counted.sum(),
        ],
        np.int64,
    )


def _mask_files(folder: Path, inner: str) -> dict[str, Path]:
    folder = folder / inner if (folder / inner).is_dir() else folder
    files = {file.name: file for file in sorted(folder.glob('*.png'))}
    if not files:
        raise InputError(f'{folder}: no floor masks (%06d.png) here')
    return files


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else 0.0
