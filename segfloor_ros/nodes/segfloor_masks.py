"""Node `segfloor_masks`: images in; what a segmentation network sees in them out."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import String

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import KeyframePath, Mount
from segfloor_ros.core.files.paths import user_path
from segfloor_ros.core.plugins.semantics.label_map import LabelMap, numbered
from segfloor_ros.core.plugins.semantics.network import ImageLabeller, NetworkSettings
from segfloor_ros.nodes.messages.colours import colour8_image
from segfloor_ros.nodes.messages.diagnostics import Level
from segfloor_ros.nodes.messages.grids import grid_message, grid_of
from segfloor_ros.nodes.messages.images import depth_image, grey8_image, image_message
from segfloor_ros.nodes.messages.points import features_arrays
from segfloor_ros.nodes.messages.poses import path_arrays, transform_array
from segfloor_ros.nodes.messages.scans import scan_arrays
from segfloor_ros.nodes.messages.topics import (
    IMAGES,
    KEYFRAME_PARTS,
    KEYFRAMES,
    SEMANTIC_MASK,
    best_effort,
    to_ns,
)
from segfloor_ros.nodes.network_files import open_network
from segfloor_ros.nodes.settings.masks import SegfloorMasksNodeSettings
from segfloor_ros.nodes.shared.running import run_node
from segfloor_ros.nodes.shared.stage_node import AnyStageNode, StageNode

IMAGE, (KEYFRAME, INFO, *_) = 'left/image_raw', KEYFRAME_PARTS
DISPARITY, MASK, SCAN = 'keyframe/disparity', 'keyframe/floor_mask', 'keyframe/floor_scan'
FEATURES, PATH = 'keyframe/features', 'keyframe/path'
SEEN = (DISPARITY, MASK, SCAN, FEATURES, PATH)


class LabelLayer:
    """Publishes the likeliest class of every cell with each map."""

    def __init__(self, node: AnyStageNode, network: NetworkSettings) -> None:
        self._node = node
        self._network = network
        self._mount: Mount | None = None
        self.reset()
        node.inputs.subscribe('camera_mount', self._take_mount)
        node.inputs.join((INFO, *SEEN), self._take_keyframe)
        node.inputs.subscribe('map', self._take_map)

    def reset(self) -> None:
        """Know no keyframe."""
        self._path: KeyframePath | None = None
        self._labels: LabelMap | None = None
        self._map: OccupancyGrid | None = None
        self._last_ns = 0
        self._waiting: dict[int, NDArray[np.uint8]] = {}

    def expect(self, stamp_ns: int, labels: NDArray[np.uint8]) -> None:
        """Keep the labels of a keyframe until its floor is known."""
        self._waiting[stamp_ns] = labels
        if len(self._waiting) > KEYFRAMES.depth:
            del self._waiting[min(self._waiting)]

    def _take_mount(self, message: TransformStamped) -> None:
        self._mount = Mount.from_transform(transform_array(message))

    def _take_keyframe(self, stamp_ns: int, parts: dict[str, Any]) -> None:
        self._last_ns = stamp_ns
        labels = self._waiting.pop(stamp_ns, None)
        if self._mount is None or labels is None:
            return self._publish()
        disparity = depth_image(parts[DISPARITY].image, DISPARITY).astype(np.float32)
        scan = scan_arrays(parts[SCAN], SCAN)
        if self._labels is None:
            (fx, _, cx, _), (_, fy, cy, _), _ = parts[INFO].p.reshape(3, 4).tolist()
            height, width = disparity.shape
            camera = StereoCamera(width, height, fx, fy, cx, cy, float(parts[DISPARITY].t))
            height_m = self._node.settings.robot_height_m
            own = self._network
            self._labels = LabelMap(camera, own.classes, height_m, own.moves)
        self._labels.add(
            stamp_ns,
            labels,
            grey8_image(parts[MASK], MASK),
            disparity,
            self._mount,
            features_arrays(parts[FEATURES], FEATURES),
            scan.range_max_m,
        )
        self._path = path_arrays(parts[PATH])
        self._publish()

    def _take_map(self, message: OccupancyGrid) -> None:
        self._map = message
        self._publish()

    def _publish(self) -> None:
        """Publish the classes of a map once those of its last keyframe are there, too."""
        message = self._map
        if self._labels is None or self._path is None or message is None:
            return
        if to_ns(message.header.stamp) > self._last_ns:
            return
        self._map, grid = None, grid_of(message)
        layer = numbered(grid, self._labels.cells(grid, self._path))
        at = to_ns(message.header.stamp), message.header.frame_id
        self._node.outputs.publish('semantic_map', grid_message(*at, layer))


class SegfloorMasksNode(StageNode[SegfloorMasksNodeSettings]):
    """Looks at keyframes first, for which others wait, then at the newest image; where the network
    is for keyframes alone, at the images that have become keyframes.
    """

    settings_type = SegfloorMasksNodeSettings

    def set_up(self) -> None:
        """Read the network and make the topics."""
        network = open_network(user_path(self.settings.network))
        self._labeller = ImageLabeller(network)
        self._every = network.settings.every
        self._work = self.inputs.later(self._process)
        self.inputs.subscribe(IMAGE, self._take_image, lambda: best_effort(IMAGES))
        self.inputs.subscribe(KEYFRAME, self._take_keyframe)
        self._layer = LabelLayer(self, network.settings)
        self.outputs.publish('semantic_classes', String(data=network.settings.as_json()))

    def reset_stage(self) -> None:
        """Know no image."""
        self._keyframes: deque[Image] = deque(maxlen=KEYFRAMES.depth)
        self._images: deque[Image] = deque(maxlen=1 if self._every else IMAGES.depth)
        self._recent: dict[int, Image] = {}
        self._wanted: deque[int] = deque(maxlen=IMAGES.depth)
        self._count = 0
        self._layer.reset()

    def find_problems(self) -> None:
        """Say what is wrong with what the network sees."""
        for remark in self._labeller.remarks:
            self.reporter.diagnose('network', remark)

    def _take_image(self, message: Image) -> None:
        if not self._every:
            self._recent[to_ns(message.header.stamp)] = message
            while len(self._recent) > IMAGES.depth:
                del self._recent[min(self._recent)]
            self._choose_wanted()
        elif self._count % self._every == 0:
            self._images.append(message)
            self._work()
        self._count += 1

    def _take_keyframe(self, message: Image) -> None:
        self._keyframes.append(message)
        self._wanted.append(to_ns(message.header.stamp))
        self._choose_wanted()
        self._work()

    def _choose_wanted(self) -> None:
        """Look at the images of keyframes, whichever of both has come first."""
        for stamp_ns in set(self._wanted) & self._recent.keys():
            self._wanted.remove(stamp_ns)
            self._images.append(self._recent.pop(stamp_ns))
            self._work()

    def _process(self) -> None:
        """Look at one image that waits."""
        waiting, look = (self._keyframes, self._look_at_keyframe)
        if not waiting:
            waiting, look = (self._images, self._look_at_image)
        if not waiting:
            return
        message = waiting.popleft()
        self._work()
        stamp_ns = to_ns(message.header.stamp)
        try:
            look(stamp_ns, message)
        except Exception as error:
            self.reporter.report_fault(stamp_ns, error)

    def _look_at_keyframe(self, stamp_ns: int, message: Image) -> None:
        # It is rectified, hence another image than that of its stamp.
        image = grey8_image(message, KEYFRAME)
        said = self._labeller.says(-stamp_ns, image)
        self._layer.expect(stamp_ns, self._labeller.labels(-stamp_ns, image))
        mask = image_message(stamp_ns, message.header.frame_id, said)
        self.outputs.publish(SEMANTIC_MASK, mask)
        self.reporter.report(stamp_ns, Level.OK, 'keyframe')

    def _look_at_image(self, stamp_ns: int, message: Image) -> None:
        read = colour8_image if self._labeller.sees_colours else grey8_image
        image, at = read(message, IMAGE), (stamp_ns, message.header.frame_id)
        moving = self._labeller.moving(stamp_ns, image)
        self.outputs.publish('dynamic_mask', image_message(*at, moving))
        labels = self._labeller.labels(stamp_ns, image)
        self.outputs.publish('semantic_labels', image_message(*at, labels))
        self.reporter.report(stamp_ns, Level.OK, 'image')


def main() -> None:
    """Run the node."""
    run_node(SegfloorMasksNode)


if __name__ == '__main__':
    main()
