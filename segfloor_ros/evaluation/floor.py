"""The score of floor masks against the true ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError
from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE


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
    def coverage(self) -> float:
        """Share of the pixels for which the estimate has evidence either way."""
        return _ratio(self.with_evidence, self.pixels)

    def as_dict(self) -> dict[str, float]:
        """Return counts and shares as plain numbers."""
        shares = {name: getattr(self, name) for name in ('precision', 'recall', 'iou', 'coverage')}
        return {**shares, 'masks': self.masks, 'missing': self.missing, 'pixels': self.pixels}


def score_floor_folders(estimate: Path, truth: Path) -> FloorScore:
    """Score the masks of one folder against those of the same name in another.

    Folders of a run (with floor_masks/) and of a scene (with floor/) will do. Masks of the truth
    that the estimate lacks are counted as missing and not scored. Raises InputError when no name
    is in both folders, or when sizes differ.
    """
    estimates = _mask_files(estimate, 'floor_masks')
    truths = _mask_files(truth, 'floor')
    common = sorted(estimates.keys() & truths.keys())
    if not common:
        raise InputError(f'{estimate} and {truth} have no mask of the same name (%06d.png)')
    counts = np.sum([_count(estimates[name], truths[name]) for name in common], axis=0)
    return FloorScore(len(common), len(truths) - len(common), *(int(value) for value in counts))


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


def _count(estimate_file: Path, truth_file: Path) -> NDArray[np.int64]:
    estimate, truth = _read_mask(estimate_file), _read_mask(truth_file)
    if estimate.shape != truth.shape:
        raise InputError(
            f'{estimate_file}: is {estimate.shape[1]}x{estimate.shape[0]}, '
            f'the true mask {truth.shape[1]}x{truth.shape[0]}'
        )
    return count_pixels(estimate, truth)


def _mask_files(folder: Path, inner: str) -> dict[str, Path]:
    folder = folder / inner if (folder / inner).is_dir() else folder
    files = {file.name: file for file in sorted(folder.glob('*.png'))}
    if not files:
        raise InputError(f'{folder}: no floor masks (%06d.png) here')
    return files


def _read_mask(path: Path) -> NDArray[np.uint8]:
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise InputError(f'{path}: not a readable image')
    return mask.astype(np.uint8)


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else 0.0
