"""A segmentation network in an ONNX file, and beside a drive, where it looks at each image once, on
a thread of its own.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.pixels import union
from segfloor_ros.core.contracts import FLOOR, MOVING, NO_EVIDENCE, NOT_FLOOR, StereoFrame
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.plugins.moving.scene_flow import MAX_MOVING_SHARE
from segfloor_ros.core.plugins.semantics.outputs import KINDS, UNLABELLED, Segments
from segfloor_ros.core.standard_error import silent_libraries
from segfloor_ros.core.timing import StageTimes

Run = Callable[[NDArray[np.float32]], list[NDArray[Any]]]
"""Gets the input (1, C, h, w) and returns the outputs in the order of the file."""

logger = logging.getLogger(__name__)

OR_ELSE = '; export it with dynamo=False, or set runtime: onnxruntime in its YAML file'

KEPT = 32
"""Images whose labels are kept: as many frames as lie between an image and its keyframe's turn."""


@dataclass(frozen=True)
class NetworkSettings:
    """How a network is used, as its YAML file says.

    classes: names, by number. moves: those that are left out of tracking and map; floor: those
    that may be driven on; barrier: those that stand in the way whatever their depth, as glass
    does. input: width and height. The input is (image - mean) * scale, from images of 0 to 255;
    one mean: grey, three: red, green, blue. score: of the least certain instance. every: each so
    many frames are looked at; 0: keyframes alone. runtime: what runs it.
    """

    kind: str
    input: list[int]
    classes: list[str]
    mean: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    scale: list[float] = dataclasses.field(default_factory=lambda: [1 / 255])
    moves: list[str] = dataclasses.field(default_factory=list)
    floor: list[str] = dataclasses.field(default_factory=list)
    barrier: list[str] = dataclasses.field(default_factory=list)
    score: float = 0.5
    every: int = 1
    runtime: str = 'opencv'

    def check(self, path: Path) -> None:
        """Raise InputError, by the file's name, for values that do not fit together."""
        roles = [*self.moves, *self.floor, *self.barrier]
        unknown = next((name for name in roles if name not in self.classes), '')
        problems = {
            f'kind {self.kind!r} is none of {", ".join(KINDS)}': self.kind not in KINDS,
            f'runtime {self.runtime!r} is none of {", ".join(RUNTIMES)}': (
                self.runtime not in RUNTIMES
            ),
            'input: expected width and height': len(self.input) != 2 or min(self.input) < 1,
            'mean: expected one number (grey) or three': len(self.mean) not in (1, 3),
            'scale: expected one number, or as many as mean': (
                len(self.scale) not in (1, len(self.mean))
            ),
            'score: expected 0 to 1': not 0 <= self.score <= 1,
            'every: expected 0 or more': self.every < 0,
            f'classes: expected 1 to {UNLABELLED} names': (not 0 < len(self.classes) <= UNLABELLED),
            f'{unknown!r} is not among the classes': bool(unknown),
        }
        for words, is_wrong in problems.items():
            if is_wrong:
                raise InputError(f'{path}: {words}')

    def is_of(self, names: list[str]) -> NDArray[np.bool_]:
        """Return which of the 256 numbers of a label image belong to classes of these names."""
        chosen = np.zeros(UNLABELLED + 1, np.bool_)
        chosen[: len(self.classes)] = [name in names for name in self.classes]
        return chosen

    def as_json(self) -> str:
        """Return the names of the classes by number, and what they stand for."""
        names = dict(enumerate(self.classes))
        roles = {'moves': self.moves, 'floor': self.floor, 'barrier': self.barrier}
        return json.dumps({'names': names, 'unlabelled': UNLABELLED, **roles})


class Network:
    """Runs a network. Raises InputError, in one line, for a file that is damaged or not understood,
    and for one whose output is not what its settings say.
    """

    def __init__(self, path: Path, settings: NetworkSettings) -> None:
        self.name = str(path)
        self.settings = settings
        self._run = RUNTIMES[self.settings.runtime](path)
        self._says = np.full(UNLABELLED + 1, NO_EVIDENCE, np.uint8)
        for names, value in (
            (self.settings.floor, FLOOR),
            (self.settings.barrier, NOT_FLOOR),
            (self.settings.moves, MOVING),
        ):
            self._says[self.settings.is_of(names)] = value
        width, height = self.settings.input
        self.infer(np.zeros((height, width), np.uint8))

    def infer(self, image: NDArray[np.uint8]) -> Segments:
        """Return what is in an image, grey (H, W) or BGR (H, W, 3)."""
        own = self.settings
        channels = len(own.mean)
        if image.ndim == 2 and channels == 3:
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
        elif image.ndim == 3:
            code = cv2.COLOR_BGR2RGB if channels == 3 else cv2.COLOR_BGR2GRAY
            image = cv2.cvtColor(image, code)
        height, width = image.shape[:2]
        scaled = cv2.resize(image, tuple(own.input), interpolation=cv2.INTER_AREA)
        pixels = scaled.reshape(own.input[1], own.input[0], channels).astype(np.float32)
        pixels = (pixels - np.array(own.mean, np.float32)) * np.array(own.scale, np.float32)
        given = np.ascontiguousarray(pixels.transpose(2, 0, 1)[None])
        try:
            with silent_libraries():
                outputs = self._run(given)
        except Exception as error:  # whatever the libraries raise
            what = f'cannot be run on an input of {own.input[0]}x{own.input[1]}'
            instead = OR_ELSE if own.runtime == 'opencv' else ''
            raise InputError(f'{self.name}: {what} ({_first_line(error)}){instead}') from None
        try:
            return KINDS[own.kind](outputs, own, (width, height))
        except (ValueError, IndexError, TypeError, StopIteration):
            shapes = ', '.join(str(list(output.shape)) for output in outputs)
            what = f'{own.kind} with {len(own.classes)} classes'
            raise InputError(f'{self.name}: returns {shapes}, which is not {what}') from None

    def says(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return what labels (H, W) mean for the floor: `FLOOR`, `NOT_FLOOR` for what stands there
        whatever its depth, `MOVING` and elsewhere `NO_EVIDENCE`.
        """
        return cv2.LUT(labels, self._says)


def _opencv(path: Path) -> Run:
    try:
        with silent_libraries():
            network = cv2.dnn.readNetFromONNX(str(path))
            names = network.getUnconnectedOutLayersNames()
    except (cv2.error, SystemError) as error:
        raise InputError(
            f'{path}: OpenCV cannot read this network ({_first_line(error)}){OR_ELSE}'
        ) from None
    # All else that uses OpenCV is too short for more than one.
    cv2.setNumThreads(cv2.getNumberOfCPUs())

    def run(given: NDArray[np.float32]) -> list[NDArray[Any]]:
        network.setInput(given)
        return [np.asarray(output) for output in network.forward(names)]

    return run


def _onnxruntime(path: Path) -> Run:
    try:
        import onnxruntime
    except ImportError:
        raise InputError(
            f"{path}: needs onnxruntime: pip install 'segfloor_ros[onnx]' (or onnxruntime)"
        ) from None
    try:
        options, providers = onnxruntime.SessionOptions(), onnxruntime.get_available_providers()
        options.log_severity_level = 3  # errors alone
        session = onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # of types that it does not document
        raise InputError(
            f'{path}: onnxruntime cannot read this network ({_first_line(error)})'
        ) from None
    first = session.get_inputs()[0]
    # Mask R-CNN of torchvision takes one image (C, h, w).
    has_batch = len(first.shape) == 4
    return lambda given: session.run(None, {first.name: given if has_batch else given[0]})


RUNTIMES: dict[str, Callable[[Path], Run]] = {'opencv': _opencv, 'onnxruntime': _onnxruntime}


def _first_line(error: BaseException) -> str:
    """Return what an error of a library says, short."""
    lines = str(error).replace('OpenCV', '').splitlines() or [type(error).__name__]
    return lines[0].rpartition('error: ')[2].strip()[:80]


class ImageLabeller:
    """Labels the images of a drive; may be asked by several threads.

    remarks: what is wrong with what the network sees, in words.
    """

    def __init__(self, network: Network, times: StageTimes | None = None) -> None:
        self.network = network
        self.remarks: list[str] = []
        self._times = times or StageTimes()
        self._lock = threading.Lock()
        self._known: dict[int, NDArray[np.uint8]] = {}
        self._colours: dict[int, NDArray[np.uint8]] = {}

    @property
    def classes(self) -> list[str]:
        """The names of the classes."""
        return self.network.settings.classes

    @property
    def sees_colours(self) -> bool:
        """Whether the network is one for colours."""
        return len(self.network.settings.mean) > 1

    @property
    def is_late(self) -> bool:
        """Whether the network looks at keyframes alone, once they are keyframes."""
        return self.network.settings.every == 0

    def labels(self, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the labels (H, W) of the image of a stamp, of its colours where a frame has had
        them. Raises InputError.
        """
        with self._lock:
            if stamp_ns not in self._known:
                image = self._colours.get(stamp_ns, image)
                with self._times.measure('network'):
                    self._known[stamp_ns] = self.network.infer(image).labels
                if len(self._known) > KEPT:
                    del self._known[next(iter(self._known))]
            return self._known[stamp_ns]

    def says(self, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return what the network says of the floor in an image (H, W), as `Network.says`. Where
        nearly all of the image moves, it is wrong, or nothing can be seen beside it: nothing does.
        """
        said = self.network.says(self.labels(stamp_ns, image))
        share = float((said == MOVING).mean())
        if share > MAX_MOVING_SHARE:
            self._remark(
                f'{self.network.name}: {100 * share:.0f} % of an image are of classes that move; '
                f'masks of more than {100 * MAX_MOVING_SHARE:.0f} % are not used'
            )
            said = np.where(said == MOVING, np.uint8(NO_EVIDENCE), said)
        return said

    def moving(self, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the mask (H, W) of what may move in an image, 255."""
        return np.where(self.says(stamp_ns, image) == MOVING, np.uint8(255), np.uint8(0))

    def with_masks(self, frames: Iterator[StereoFrame]) -> Iterator[StereoFrame]:
        """Yield the frames with masks: that of the last one that the network has looked at."""
        every = self.network.settings.every
        mask: NDArray[np.uint8] | None = None
        for number, frame in enumerate(frames):
            if frame.colour is not None:
                with self._lock:
                    self._colours[frame.stamp_ns] = frame.colour
                    if len(self._colours) > KEPT:
                        del self._colours[next(iter(self._colours))]
            if every and number % every == 0:
                mask = self.moving(frame.stamp_ns, frame.left)
            excluded = union(frame.excluded, mask)
            yield dataclasses.replace(frame, excluded=excluded, colour=None)

    def _remark(self, words: str) -> None:
        if not self.remarks:
            self.remarks.append(words)
            logger.warning('%s', words)
