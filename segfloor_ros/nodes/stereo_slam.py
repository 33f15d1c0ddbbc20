"""Node `stereo_slam`: stereo images in; odometry, tf, keyframes and the sparse map out."""

from __future__ import annotations

import math
import time
from collections import deque
from functools import partial
from typing import Any

from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from segfloor_ros.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.camera.images import EightBitScale
from segfloor_ros.camera.model import Mount, StereoFrame
from segfloor_ros.camera.rectification import StereoRectifier
from segfloor_ros.messages import qos
from segfloor_ros.messages.camera_info import eye_calibration, same_calibration
from segfloor_ros.messages.diagnostics import Level
from segfloor_ros.messages.headers import to_ns
from segfloor_ros.messages.images import grey_image
from segfloor_ros.messages.join import MAX_DISORDER_NS
from segfloor_ros.node_settings import StereoSlamNodeSettings
from segfloor_ros.nodes.camera_watch import CameraWatch
from segfloor_ros.nodes.hand_over import HandOver
from segfloor_ros.nodes.qos_check import offered_best_effort
from segfloor_ros.nodes.slam_outputs import CameraFrames, SlamOutputs
from segfloor_ros.nodes.slam_resumption import SlamResumption
from segfloor_ros.nodes.stage_node import StageNode, run_node
from segfloor_ros.nodes.transforms import Transforms
from segfloor_ros.slam.continuation import LastState
from segfloor_ros.slam.results import FrameResult
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.stereo_slam import StereoSlam
from segfloor_ros.stages import make_slam

INFOS = ('left/camera_info', 'right/camera_info')
MAX_UNPAIRED = 30
MAX_KEPT = 100
"""Pairs that are kept while calibration or mount are not known."""
CATCH_UP = 0.2
"""Of so many of the pairs kept one is skipped per pair processed, where there is no other way."""
WORK_OFF_EVERY_S = 0.2


class StereoSlamNode(StageNode[StereoSlamSettings, StereoSlamNodeSettings]):
    """Tracks every stereo pair and publishes what comes of it."""

    works_on_demand = True

    def __init__(self, hand_over: HandOver | None = None) -> None:
        super().__init__(StereoSlamSettings, StereoSlamNodeSettings, hand_over)

    def set_up(self) -> None:
        """Make the topics."""
        self._slam: StereoSlam | None = None
        self._waiting: deque[dict[str, Any]] = deque()
        own = self.parameters.own
        self._outputs_of_slam = SlamOutputs(self, own)
        self._transforms = Transforms(self, own)
        self._infos: dict[str, CameraInfo] = {}
        self._eyes: dict[str, EyeCalibration] = {}
        self._takes_best_effort = own.image_reliability == 'best_effort'
        self._left, self._right = self._subscribe(own)
        self._watch = CameraWatch(self, own, self._left, self._right)
        self._work = self.when_idle(self._work_off)
        self.every(WORK_OFF_EVERY_S, self._work_on)
        tolerance_ns = round(own.sync_tolerance_s * 1e9)
        self._pairs = self.joiner(
            (self._left, self._right), capacity=MAX_UNPAIRED, tolerance_ns=tolerance_ns
        )

    def start_anew(self) -> None:
        """Begin with an empty map; the mount of the camera is found again, too."""
        self._end_stage()
        self._allowed: float = MAX_KEPT
        self._outputs_of_slam.start_anew()
        self._transforms.start_anew()
        self._last_stamp_ns: int | None = None
        self._resumption = SlamResumption(self.keep)
        self._calibration: StereoCalibration | None = None
        self._frames = CameraFrames('', '')
        self._rectifier: StereoRectifier | None = None
        self._eight_bit = EightBitScale(self.parameters.own.bit_depth)
        self._mount: Mount | None = None
        self._frame_count = 0

    def reset(self) -> None:
        """Drop the map, and the images that wait."""
        self._waiting.clear()
        super().reset()

    def resume(self, state: LastState) -> None:
        """Go on with the map of a killed node once the images come."""
        self._resumption = SlamResumption(self.keep, state)

    def forget(self) -> None:
        """Drop the map."""
        super().forget()
        self._end_stage()

    def listener_count(self) -> int:
        """Return how many listen to tf."""
        return self._transforms.listener_count()

    def on_inputs_opened(self) -> None:
        """Give tf time to tell the mount, from now on."""
        self._transforms.start_waiting()

    def on_inputs_closed(self) -> None:
        """Give up the images that wait."""
        super().on_inputs_closed()
        self._waiting.clear()

    def _end_stage(self) -> None:
        if self._slam is not None:
            self._slam.close()
        self._slam = None

    def _subscribe(self, own: StereoSlamNodeSettings) -> tuple[str, str]:
        kind = 'image_rect' if own.rectified_input else 'image_raw'
        kind += '/compressed' if own.image_transport == 'compressed' else ''
        left, right = f'left/{kind}', f'right/{kind}'
        for info in INFOS:
            self.listen(info, partial(self._take_info, info), self._image_profile)
        for image in (left, right):
            self.listen(image, partial(self._take_image, image), self._image_profile)
        return left, right

    def _image_profile(self) -> QoSProfile:
        return qos.IMAGES_BEST_EFFORT if self._takes_best_effort else qos.IMAGES

    def adapt(self) -> None:
        """Take the images best effort where a driver offers no more, if the choice is left to the
        node.
        """
        if self._takes_best_effort or self.parameters.own.image_reliability != 'auto':
            return
        lossy = offered_best_effort(self, (*INFOS, self._left, self._right))
        if lossy:
            self._takes_best_effort = True
            names = ', '.join(lossy)
            self.get_logger().info(f'taken best effort, as offered: {names}; images may get lost')
            self.reopen()

    def _take_info(self, topic: str, message: CameraInfo) -> None:
        if topic in self._infos and same_calibration(message, self._infos[topic]):
            return
        self._eyes[topic] = eye_calibration(message, topic)
        self._infos[topic] = message
        if self._slam is not None:
            self.say(f'{topic}: the calibration is not the one in use; ~/reset takes it over')
        self._work_on()

    def _take_image(self, topic: str, message: Image | CompressedImage) -> None:
        self._watch.saw_image(topic, to_ns(message.header.stamp))
        pair = self._pairs.add(topic, to_ns(message.header.stamp), message)
        self.say_dropped(self._pairs)
        if pair is not None:
            self._waiting.append(pair)
            self._work.request()

    def _work_on(self) -> None:
        if self._waiting:
            self._work.request()

    def _work_off(self) -> None:
        """Process the first pair that waits, once all is known that it needs; look for newer ones
        before the next.
        """
        is_ready = bool(self._waiting) and self._is_ready(self._waiting[0])
        if is_ready:
            # What came before the mount was known is caught up on, not thrown away at once.
            least = self.parameters.own.max_waiting_frames
            self._allowed = max(min(self._allowed - CATCH_UP, len(self._waiting)), least)
        while len(self._waiting) > self._allowed:
            self._skip(to_ns(self._waiting.popleft()[self._left].header.stamp), is_ready)
        if is_ready:
            self._take_pair(self._waiting.popleft())
            self._work_on()

    def _skip(self, stamp_ns: int, is_ready: bool) -> None:
        """Leave out a pair that newer ones have overtaken: a late pose is of no use to a robot."""
        self.note_skipped()
        if not is_ready:
            words = 'skipped: calibration or mount of the camera are not known yet'
            self.report(stamp_ns, Level.WARN, words)
            return
        self.report(stamp_ns, Level.WARN, 'skipped: tracking is slower than the camera')
        self.diagnose(
            'skipped',
            f'{self._left} comes faster than it is tracked, so that frames are skipped; lower the '
            'rate or the size of the images or num_features of stereo_slam, or play a recording '
            'with lossless set on stereo_camera',
        )

    def find_problems(self) -> None:
        """Say what is wrong with the camera."""
        missing = [topic for topic in INFOS if topic not in self._eyes]
        self._watch.find_problems(missing if self._waiting else [])

    def _is_ready(self, pair: dict[str, Any]) -> bool:
        """Whether calibration and mount are known: they come in their own time."""
        if self._slam is not None:
            return True
        if len(self._eyes) < 2:
            return False
        if self._mount_is_given():
            return True
        return self._transforms.mount_is_settled(pair[self._left].header.frame_id)

    def _mount_is_given(self) -> bool:
        settings = self.parameters.stage
        given = (settings.camera_height_m, settings.camera_pitch_rad, settings.camera_roll_rad)
        return not all(math.isnan(value) for value in given)

    def _take_pair(self, pair: dict[str, Any]) -> None:
        stamp_ns = to_ns(pair[self._left].header.stamp)
        if not self._is_in_order(stamp_ns):
            self.report(stamp_ns, Level.ERROR, 'older than the pair before it; dropped')
            return
        start = time.perf_counter()
        try:
            results = self._process(stamp_ns, pair)
        except Exception as error:
            self.report_fault(stamp_ns, error)
            return
        milliseconds = 1e3 * (time.perf_counter() - start)
        for result in results:
            self._publish(result, milliseconds / len(results))
        if self._resumption.is_hopeless(stamp_ns):
            self.begin_anew('the place where the last SLAM was killed is not found')
        if not results:
            words = 'waiting for the floor, to measure the mount of the camera'
            self.report_waiting(stamp_ns, words)

    def _is_in_order(self, stamp_ns: int) -> bool:
        """Whether a pair comes after the one before; where time has jumped back, e.g. because a
        recording begins again, the map is begun anew.
        """
        last_ns = self._last_stamp_ns
        if last_ns is not None and stamp_ns < last_ns - MAX_DISORDER_NS:
            jump_s = 1e-9 * (last_ns - stamp_ns)
            self.begin_anew(f'the stamps of the images went back by {jump_s:.3f} s')
        elif last_ns is not None and stamp_ns <= last_ns:
            return False
        self._last_stamp_ns = stamp_ns
        return True

    def _process(self, stamp_ns: int, pair: dict[str, Any]) -> list[FrameResult]:
        if self._slam is None:
            self._start(pair)
        assert self._slam is not None and self._rectifier is not None
        images = (grey_image(pair[topic], topic) for topic in (self._left, self._right))
        left, right = self._rectifier.rectify(*self._eight_bit(*images))
        self._watch.check_rows(left, right)
        frame = StereoFrame(self._frame_count, stamp_ns, left, right)
        self._frame_count += 1
        return self._resumption.join(self._slam.process(frame))

    def _start(self, pair: dict[str, Any]) -> None:
        """Build the stage, now that the calibration is known."""
        calibration = StereoCalibration(*(self._eyes[topic] for topic in sorted(self._eyes)))
        self._calibration = calibration.rectified()
        if self.parameters.own.rectified_input:
            calibration = self._calibration
        self._rectifier = StereoRectifier(calibration)
        self._frames = CameraFrames(
            pair[self._left].header.frame_id, pair[self._right].header.frame_id
        )
        mount = None if self._mount_is_given() else self._transforms.mount(self._frames.left)
        camera, stamp_ns = self._rectifier.camera, to_ns(pair[self._left].header.stamp)
        mount = self._resumption.mount_for(camera, stamp_ns) or mount
        stage, background = self.parameters.stage, self.parameters.own.background
        self._slam = make_slam(camera, stage, mount, background=background)
        self._resumption.begin(self._slam)

    def _announce_mount(self, stamp_ns: int, mount: Mount) -> None:
        self._mount = mount
        self.get_logger().info(
            f'camera {mount.height_m:.3f} m above the floor, pitch '
            f'{math.degrees(mount.pitch_rad):.2f} deg, roll {math.degrees(mount.roll_rad):.2f} deg'
        )
        if not self._mount_is_given() and self._transforms.mount(self._frames.left) is None:
            self._watch.judge_measured(mount)
        self._outputs_of_slam.publish_mount(stamp_ns, self._frames, mount)
        self._transforms.announce_mount(stamp_ns, self._frames.left, mount)

    def _publish(self, result: FrameResult, milliseconds: float) -> None:
        assert self._calibration is not None and self._slam is not None
        if self._mount is None and result.keyframe is not None and self._slam.mount is not None:
            # Its stamp tells which map it belongs to.
            self._announce_mount(int(result.keyframe.path.stamp_ns[0]), self._slam.mount)
        if self._mount is not None:
            self._resumption.keep(self._calibration.camera, self._mount, result)
        # What a robot steers by comes first, the images of a keyframe later.
        self._transforms.broadcast(result)
        self._outputs_of_slam.publish(result, self._calibration, self._frames)
        self.report_processed(
            result.stamp_ns,
            Level.OK if result.tracked else Level.ERROR,
            result.state,
            milliseconds,
            tracked=int(result.tracked),
            keyframe=int(result.keyframe is not None),
            matches=result.num_matches,
            reference_keyframe_ns=result.reference_keyframe_ns,
        )


def main() -> None:
    """Run the node."""
    run_node(StereoSlamNode)


if __name__ == '__main__':
    main()
