"""What a network says of keyframes, gathered in the map: what the pipeline plugs in."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import FloorObservation, Keyframe, KeyframePath, Mount, StereoFrame
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.plugins.semantics.label_map import LABELS, LabelMap, Labels
from segfloor_ros.core.plugins.semantics.network import ImageLabeller


class SemanticMap:
    """The labels of a map. labeller: of its keyframes; without one it keeps the labels of a map
    that was loaded.
    """

    def __init__(
        self,
        camera: StereoCamera,
        labeller: ImageLabeller | None = None,
        robot_height_m: float = math.inf,
    ) -> None:
        self._labeller, self._label_map = labeller, LabelMap(camera)
        if labeller is not None:
            own = labeller.network.settings
            self._label_map = LabelMap(camera, own.classes, robot_height_m, own.moves)

    @property
    def remarks(self) -> list[str]:
        """What is wrong with what the network sees, in words."""
        return self._labeller.remarks if self._labeller is not None else []

    @property
    def is_late(self) -> bool:
        """Whether the network looks at keyframes alone, once they are keyframes."""
        return self._labeller is not None and self._labeller.is_late

    def moving(self, frame: StereoFrame) -> NDArray[np.uint8]:
        """Return the mask (H, W) of what may move in a frame, 255."""
        assert self._labeller is not None
        return self._labeller.moving(frame.stamp_ns, frame.left)

    def says(self, keyframe: Keyframe) -> NDArray[np.uint8] | None:
        """Return what the network says of the floor in a keyframe, (H, W)."""
        if self._labeller is None:
            return None
        return self._labeller.says(keyframe.stamp_ns, keyframe.left)

    def add(self, keyframe: Keyframe, floor: FloorObservation, mount: Mount) -> None:
        """Take in a keyframe whose floor is segmented."""
        if self._labeller is not None:
            self._label_map.add(
                keyframe.stamp_ns,
                self._labeller.labels(keyframe.stamp_ns, keyframe.left),
                floor.mask,
                floor.disparity_px,
                mount,
                keyframe.features,
                floor.scan.range_max_m,
            )

    def labels(
        self, grid: OccupancyGrid | None, path: KeyframePath, point_id: NDArray[np.int32]
    ) -> Labels | None:
        """Return the labels of the map, with its keyframes where they lie now; None where no
        network has looked at them.
        """
        return self._label_map.labels(grid, path, point_id)

    def to_parts(self) -> dict[str, Arrays]:
        """Return what keyframes showed, as parts of a saved map."""
        return {LABELS: self._label_map.to_arrays()} if self._label_map.classes else {}

    def from_parts(self, parts: dict[str, Arrays], shift_ns: int) -> None:
        """Go on with the parts of a saved map, whose stamps are later by shift_ns. Raises KeyError,
        IndexError or ValueError for other arrays.
        """
        if LABELS in parts:
            self._label_map.from_arrays(parts[LABELS], shift_ns)
