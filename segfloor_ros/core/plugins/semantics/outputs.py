"""What networks return, as an image of class numbers: semantic segmentation, the YOLO-seg family
and Mask R-CNN.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

UNLABELLED = 255
"""The number of no class."""

OVERLAP = 0.5
"""Two boxes of one class that share more of their union than this show one thing (intersection
over union, as in the evaluation of PASCAL VOC)."""

BOX = 4
"""Numbers of a box."""


@dataclass(frozen=True)
class Segments:
    """labels: (H, W) uint8, numbers of classes, `UNLABELLED` elsewhere. instances: (H, W) uint8,
    from 1 on, 0 where there is none; of networks that tell no instances it is 0 everywhere.
    """

    labels: NDArray[np.uint8]
    instances: NDArray[np.uint8]


class Described(Protocol):
    """What is to be known of a network to read its output."""

    @property
    def classes(self) -> Sequence[str]:
        """Names of the classes."""

    @property
    def input(self) -> Sequence[int]:
        """Width and height of the input."""

    @property
    def score(self) -> float:
        """Of the least certain instance."""


Size = tuple[int, int]
"""Width and height of an image."""


def semantic(outputs: list[NDArray[Any]], network: Described, size: Size) -> Segments:
    """Read scores (1, C, h, w), or numbers of classes (1, h, w) or (1, 1, h, w)."""
    scores = outputs[0]
    scores = scores.reshape(-1, *scores.shape[-2:])
    count = len(network.classes)
    if len(scores) not in (1, count):
        raise ValueError('another number of classes')
    numbers = scores.argmax(axis=0) if len(scores) == count else scores[0]
    labels = np.where((numbers >= 0) & (numbers < count), numbers, UNLABELLED).astype(np.uint8)
    labels = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    return Segments(labels, np.zeros_like(labels))


def yolo_seg(outputs: list[NDArray[Any]], network: Described, size: Size) -> Segments:
    """Read boxes with scores of classes and coefficients of masks, (1, 4 + C + M, N), and
    prototypes of masks (1, M, h, w), as Ultralytics exports them; with the certainty of an object
    before the scores, (1, N, 5 + C + M), of the fifth version.
    """
    prototypes = next(o for o in outputs if o.ndim == 4)[0]
    found = next(o for o in outputs if o.ndim == 3)[0]
    count, num_masks = len(network.classes), len(prototypes)
    rows = BOX + count + num_masks
    if found.shape[0] == rows:
        found = found.T
    has_object = found.shape[1] == rows + 1
    if not has_object and found.shape[1] != rows:
        raise ValueError('another number of classes')
    scores = found[:, -count - num_masks : -num_masks]
    scores = scores * found[:, BOX : BOX + 1] if has_object else scores
    best, number = scores.max(axis=1), scores.argmax(axis=1)
    low = found[:, :2] - found[:, 2:BOX] / 2
    boxes = np.hstack([low, low + found[:, 2:BOX]])
    kept = _without_overlaps(boxes, best, number, network.score)
    weights = found[kept, -num_masks:] @ prototypes.reshape(num_masks, -1)
    masks = weights.reshape(-1, *prototypes.shape[1:]) > 0  # a probability above one half
    scale = np.array(size * 2) / np.array([*network.input, *network.input])
    instances = [
        (number[k], _within(cv2.resize(mask.astype(np.float32), size), boxes[k] * scale))
        for k, mask in zip(kept, masks, strict=True)
    ]
    return _painted(instances, size)


def mask_rcnn(outputs: list[NDArray[Any]], network: Described, size: Size) -> Segments:
    """Read boxes (N, 4) as corners, classes (N,), scores (N,) and masks (N, 1, h, w), of each box
    or of the whole image (He et al., Mask R-CNN, 2017, as torchvision exports it).
    """
    boxes, numbers, scores, masks = (np.squeeze(output) for output in outputs)
    count = scores.size
    boxes, masks = boxes.reshape(count, BOX), outputs[3].reshape(count, *outputs[3].shape[-2:])
    scale = np.array(size * 2) / np.array([*network.input, *network.input])
    is_whole = masks.shape[1:] == (network.input[1], network.input[0])
    scores, numbers = scores.reshape(count), numbers.reshape(count).astype(np.intp)
    if count and not 0 <= numbers.min() <= numbers.max() < len(network.classes):
        raise ValueError('another number of classes')
    kept = [k for k in np.argsort(-scores, kind='stable') if scores[k] >= network.score]
    place = _resized if is_whole else _in_box
    return _painted([(numbers[k], place(masks[k], boxes[k] * scale, size)) for k in kept], size)


Reader = Callable[[list[NDArray[Any]], Described, Size], Segments]

KINDS: dict[str, Reader] = {'semantic': semantic, 'yolo_seg': yolo_seg, 'mask_rcnn': mask_rcnn}
"""Reads the outputs of each kind of network, for an image of a size. Raises ValueError, IndexError
or StopIteration for outputs of another kind."""


def _without_overlaps(
    boxes: NDArray[Any], scores: NDArray[Any], numbers: NDArray[np.intp], least: float
) -> list[int]:
    """Return the boxes (N, 4), as corners, that are certain enough, the surest of those that
    overlap, the surest first.
    """
    kept: list[int] = []
    area = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    for k in np.argsort(-scores, kind='stable'):
        if scores[k] < least:
            break
        low = np.maximum(boxes[kept, :2], boxes[k, :2])
        high = np.minimum(boxes[kept, 2:], boxes[k, 2:])
        shared = np.prod(np.maximum(high - low, 0), axis=1)
        same = (shared > OVERLAP * (area[kept] + area[k] - shared)) & (numbers[kept] == numbers[k])
        if not same.any():
            kept.append(int(k))
    return kept


def _within(mask: NDArray[np.float32], box: NDArray[Any]) -> NDArray[np.bool_]:
    """Return where a mask (H, W) is above one half, inside of a box."""
    inside = np.zeros(mask.shape, np.bool_)
    left, top, right, bottom = np.rint(np.maximum(box, 0)).astype(int)
    part = np.s_[top:bottom, left:right]
    inside[part] = mask[part] > 0.5
    return inside


def _resized(mask: NDArray[Any], box: NDArray[Any], size: Size) -> NDArray[np.bool_]:
    return _within(cv2.resize(mask.astype(np.float32), size), box)


def _in_box(mask: NDArray[Any], box: NDArray[Any], size: Size) -> NDArray[np.bool_]:
    """Return a mask of a box (h, w) in an image."""
    left, top, right, bottom = box
    height, width = mask.shape
    # Pixels of the image for those of the mask; both count from their middles.
    sx, sy = (right - left) / width, (bottom - top) / height
    to_image = np.array([[sx, 0, left + (sx - 1) / 2], [0, sy, top + (sy - 1) / 2]])
    return np.asarray(cv2.warpAffine(mask.astype(np.float32), to_image, size) > 0.5)


def _painted(instances: list[tuple[Any, NDArray[np.bool_]]], size: Size) -> Segments:
    """Return instances, the surest first, which hide those behind them."""
    labels = np.full(size[::-1], UNLABELLED, np.uint8)
    numbers = np.zeros_like(labels)
    for k, (label, mask) in reversed(list(enumerate(instances[: UNLABELLED - 1], 1))):
        labels[mask], numbers[mask] = label, k
    return Segments(labels, numbers)
