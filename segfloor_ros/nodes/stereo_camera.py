"""Node `stereo_camera`: a recording or device as stereo images with calibration.

When the next frame of a recording may be sent: in step with the clock, or with the chain.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from segfloor_ros.core.camera.calibration import StereoCalibration
from segfloor_ros.core.camera.images import Grey
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import JPEG_QUALITY
from segfloor_ros.core.camera.recording import (
    DEPTH,
    IMU_FRAME,
    MAX_LAG_S,
    MeasurementLog,
    RawPair,
    RecordedSensor,
)
from segfloor_ros.core.camera.settings import SENSORS, StereoCameraSettings
from segfloor_ros.core.contracts import MAX_KEYFRAMES_UNDER_WAY, Measurement, WheelPose
from segfloor_ros.core.errors import InputError, SegfloorError
from segfloor_ros.core.geometry import Array, make_transform
from segfloor_ros.nodes.messages.camera_infos import camera_info_message, compressed_message
from segfloor_ros.nodes.messages.diagnostics import RECORDING, Level
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.poses import transform_message
from segfloor_ros.nodes.messages.sensors import imu_message, wheel_message
from segfloor_ros.nodes.messages.topics import (
    FRAMES,
    PACED_BY,
    PATIENCE_S,
    TOPICS,
    Topic,
    stamp_of,
    to_time,
)
from segfloor_ros.nodes.settings.camera import StereoCameraNodeSettings
from segfloor_ros.nodes.settings.slam import StereoSlamNodeSettings
from segfloor_ros.nodes.shared.inputs import LOOK_S
from segfloor_ros.nodes.shared.stage_node import StageNode
from segfloor_ros.nodes.shared.tf_link import TfLink

WAITING = 'waiting'

MAX_FRAMES_UNDER_WAY = StereoSlamNodeSettings.max_waiting_frames
"""Frames that may be between the camera and SLAM: no more than SLAM lets wait before it skips any
(`max_waiting_frames`), and enough for it to find the next one when it has done with one.
"""


class Recording(Protocol):
    """What the node plays: raw pairs and what was measured beside them.

    calibration: of the raw pairs; camera: the rectified one. takes_depth: whether depth images
    stand in place of the right ones. skipped_frames: pairs left out so far.
    """

    name: str
    calibration: StereoCalibration
    sensors: Sequence[RecordedSensor]
    skipped_frames: int

    @property
    def camera(self) -> StereoCamera:
        """The rectified stereo camera."""

    @property
    def takes_depth(self) -> bool:
        """Whether depth images stand in place of the right ones."""

    def raw_pairs(self) -> Iterator[RawPair]:
        """Yield the pairs in order of their stamps."""

    def mask(self, index: int) -> NDArray[np.uint8] | None:
        """Return the mask (H, W) of what moves in a frame, None where there is none."""


OpenRecording = Callable[[StereoCameraSettings], Recording]


class StereoCameraNode(StageNode[StereoCameraNodeSettings]):
    """Publishes every pair with its own stamp, once somebody listens."""

    settings_type = StereoCameraNodeSettings

    def __init__(self, open_recording: OpenRecording) -> None:
        self._open = open_recording
        super().__init__()

    def output_topics(self) -> Sequence[Topic]:
        """Return none: they follow from the recording."""
        return ()

    def set_up(self) -> None:
        """Open the recording and make the topics."""
        if not self.settings.input:
            raise InputError('stereo_camera.input is empty; name a recording or a device')
        own = self.settings
        self._source = self._open(own)
        self._frame_ids = {'left': own.left_frame, 'right': own.right_frame}
        self._imu_frame = ''
        self._compressed = own.image_transport == 'compressed'
        kind = 'image_raw/compressed' if self._compressed else 'image_raw'
        self._has_depth = self._source.takes_depth
        sides = ('left',) if self._has_depth else ('left', 'right')
        self._images = {side: self.outputs.publisher(f'{side}/{kind}') for side in sides}
        self._infos = {side: self.outputs.publisher(f'{side}/camera_info') for side in sides}
        if self._has_depth:
            self._images['right'] = self.outputs.publisher('depth/image_raw')
        self._mask = self.outputs.publisher('dynamic_mask')
        self._sensors = {
            sensor.name: self.outputs.publisher(sensor.name)
            for sensor in self._source.sensors
            if sensor.used and sensor.name in SENSORS
        }
        self._clock_output: Publisher | None = None
        if own.publish_clock:
            clock = self._clock_output = self.create_publisher(Clock, '/clock', FRAMES)
            self.outputs.at_clean_up(lambda: self.destroy_publisher(clock))
        if own.lossless or not own.rate:
            self._follow_chain()
        self.inputs.repeat(self._advance)
        self.states.pause(own.start_paused)
        self.outputs.at_clean_up(self._stop_reading)

    def reset_stage(self) -> None:
        """Begin with the first frame."""
        own = self.settings
        self._pairs = self._source.raw_pairs()
        self._measurements = MeasurementLog(self._source.sensors)
        self._measurements_sent = dict.fromkeys(self._sensors, 0)
        self._next: RawPair | None = None
        if not self._imu_frame:
            self._imu_frame = self._place_imu(self._measurements.imu_place_m)
        self._frames_sent = 0
        self._connected = self._finished = False
        self._wait_no_more()
        self._clock_pace = ClockPace(own.rate or math.inf)
        self._chain_pace = ChainPace(is_on=own.lossless or not own.rate)
        self._paces = (self._clock_pace, self._chain_pace)

    def on_inputs_opened(self) -> None:
        """Keep the recording's pace from here on."""
        self._wait_no_more()
        for pace in self._paces:
            pace.restart()

    def _stop_reading(self) -> None:
        self._pairs = iter(())

    def _follow_chain(self) -> None:
        """Listen to how far the frames are, also while paused: they are under way then, too."""

        def follow(name: str, note: Callable[[ChainPace, int], None]) -> None:
            def take(message: Any) -> None:
                note(self._chain_pace, stamp_of(message))
                if self.inputs.is_open:
                    self._advance()

            topic = TOPICS[name]
            made = self.create_subscription(topic.type, name, take, topic.profile)
            self.outputs.at_clean_up(lambda: self.destroy_subscription(made))

        notes = (ChainPace.frame_done, ChainPace.keyframe_began, ChainPace.keyframe_done)
        for name, note in zip(PACED_BY, notes, strict=True):
            follow(name, note)

    def _advance(self) -> float:
        """Send the next pairs as far as they may go now; returns when to look again, in s."""
        try:
            while self._may_play() and self._fetch() and self._next is not None:
                wait_s = self._wait_s(self._next)
                if wait_s > 0:
                    return wait_s
                self._send(self._next)
                self._next = None
        except SegfloorError as error:
            self.reporter.log_fault(self._source.name, error)
            self._finish(Level.ERROR, str(error))
        return LOOK_S

    def _may_play(self) -> bool:
        """Whether somebody listens; a recording that must lose nothing waits whenever nobody
        does.
        """
        if self._finished:
            return False
        if not self._connected or self._chain_pace.is_on:
            outputs = (*self._images.values(), *self._infos.values())
            silent = [out.topic_name for out in outputs if not out.get_subscription_count()]
            if silent:
                self._log_waiting_for('subscribers of ' + ', '.join(silent))
            if silent and self._connected:
                self._chain_pace.drop_frames()
                self._chain_pace.restart()
            self._connected = not silent
        return self._connected

    def _wait_s(self, pair: RawPair) -> float:
        wait_s = self._clock_pace.wait_s(pair.stamp_ns)
        if wait_s > 0 or self._chain_pace.ready():
            return wait_s
        given_up = self._chain_pace.give_up()
        if given_up:
            self.reporter.diagnose(
                'lost',
                f'{given_up} under way have not come to their end and are given up: a node was '
                'paused, deactivated or killed; look at its status',
            )
            return 0.0
        self._log_waiting_for(self._chain_pace.waits_for())
        return LOOK_S

    def _fetch(self) -> bool:
        """Read the next pair if none is at hand; False at the end of the recording."""
        if self._next is None:
            self._next = next(self._pairs, None)
            if self._next is None:
                self._finish(Level.OK, 'finished')
        return self._next is not None

    def _send(self, pair: RawPair) -> None:
        calibration = self._source.calibration
        eyes = {'left': (pair.left, calibration.left), 'right': (pair.right, calibration.right)}
        for pace in self._paces:
            pace.sent(pair.stamp_ns)
        self._wait_no_more()
        if self._clock_output is not None:
            self._clock_output.publish(Clock(clock=to_time(pair.stamp_ns)))
        # What sensors measured is sent ahead of the images: their stamps may be late.
        for measurement in self._measurements.until(pair.stamp_ns + round(1e9 * MAX_LAG_S)):
            self._send_measurement(measurement)
        mask = self._source.mask(pair.index)
        if mask is not None:
            self._mask.publish(image_message(pair.stamp_ns, self._frame_ids['left'], mask))
        if self._has_depth:
            eyes.pop('right')
            depth_m = np.float32(self._source.camera.disparity_times_depth) / pair.right
            message = image_message(pair.stamp_ns, self._frame_ids['left'], depth_m)
            self._images['right'].publish(message)
        for side, (image, eye) in eyes.items():
            frame_id = self._frame_ids[side]
            self._infos[side].publish(camera_info_message(pair.stamp_ns, frame_id, eye))
            self._images[side].publish(self._image_message(pair.stamp_ns, frame_id, image))
        self._frames_sent += 1
        self.reporter.report(pair.stamp_ns, Level.OK, 'sent', frame_index=pair.index)

    def _send_measurement(self, measurement: Measurement) -> None:
        name = 'wheel_odometry' if isinstance(measurement, WheelPose) else 'imu'
        if isinstance(measurement, WheelPose):
            self._sensors[name].publish(wheel_message(measurement, 'base_link'))
        else:
            R_left_rectified = self._source.calibration.left.R.T
            self._sensors[name].publish(imu_message(measurement, self._imu_frame, R_left_rectified))
        self._measurements_sent[name] += 1

    def _place_imu(self, place_m: Array) -> str:
        """Return the frame of an IMU at a place (3,) in the rectified left optical frame; one that
        is elsewhere than the camera has a frame of its own on tf.
        """
        left_frame = self._frame_ids['left']
        link = TfLink(self) if place_m.any() else None
        if link is None or not link.is_there:
            return left_frame
        link.stop_listening()
        R_left_rectified = self._source.calibration.left.R.T
        T_left_imu = make_transform(np.eye(3), R_left_rectified @ place_m)
        link.send_fixed(transform_message(0, left_frame, IMU_FRAME, T_left_imu))
        return IMU_FRAME

    def _image_message(self, stamp_ns: int, frame_id: str, image: Grey) -> Any:
        if not self._compressed:
            return image_message(stamp_ns, frame_id, image)
        quality = JPEG_QUALITY if self.settings.compression == 'jpeg' else None
        return compressed_message(stamp_ns, frame_id, image, quality)

    def _finish(self, level: Level, message: str) -> None:
        self._finished = True
        self.get_logger().info(f'{self._source.name}: {self._frames_sent} pairs sent')
        stamp_ns = self.get_clock().now().nanoseconds
        values = {
            'frames': self._frames_sent,
            'skipped': self._source.skipped_frames,
            **self._measurements_sent,
        }
        if self._has_depth:
            values[DEPTH] = self._frames_sent
        self.reporter.publish(RECORDING, stamp_ns, level, message, values)

    def _wait_no_more(self) -> None:
        self._waiting_since_s = time.monotonic()
        self.reporter.over(WAITING)

    def _log_waiting_for(self, what: str) -> None:
        if what and time.monotonic() - self._waiting_since_s > PATIENCE_S:
            self.reporter.diagnose(WAITING, f'waiting for {what}')


class ClockPace:
    """Sends frames at the recording's own pace times a rate; the first one starts the clock."""

    def __init__(self, rate: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate
        self._clock_s = clock_s
        self._start: tuple[float, int] | None = None

    def wait_s(self, stamp_ns: int) -> float:
        """Return in how many seconds the frame is due; 0 when it is."""
        if self._start is None:
            return 0.0
        start_s, start_ns = self._start
        due_s = start_s + (stamp_ns - start_ns) * 1e-9 / self._rate
        return max(due_s - self._clock_s(), 0.0)

    def sent(self, stamp_ns: int) -> None:
        """Start the clock with the first frame."""
        if self._start is None:
            self._start = self._clock_s(), stamp_ns

    def restart(self) -> None:
        """Start the clock again with the next frame, e.g. after a pause."""
        self._start = None


class ChainPace:
    """Lets few frames and keyframes be under way at a time, so that no queue between the nodes
    can run over, however fast the frames come.

    What a node had in its queue is lost when it is paused, deactivated or killed: when nothing
    at all has happened for some seconds, what is under way is given up.

    is_on: off, any number may be under way.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic, is_on: bool = True) -> None:
        self.is_on = is_on
        self._clock_s = clock_s
        self._last_sign_s = clock_s()
        self._frames: set[int] = set()
        self._keyframes: set[int] = set()
        self._done_early: set[int] = set()

    def ready(self) -> bool:
        """Whether the next frame may be sent."""
        return (
            len(self._frames) < MAX_FRAMES_UNDER_WAY
            and len(self._keyframes) < MAX_KEYFRAMES_UNDER_WAY
        )

    def sent(self, stamp_ns: int) -> None:
        """Wait for SLAM to be done with this frame from now on."""
        self._last_sign_s = self._clock_s()
        if self.is_on:
            self._frames.add(stamp_ns)

    def frame_done(self, stamp_ns: int) -> None:
        """SLAM is done with a frame; it takes them in order, so earlier ones are done or lost."""
        self._last_sign_s = self._clock_s()
        self._frames = {t for t in self._frames if t > stamp_ns}

    def keyframe_began(self, stamp_ns: int) -> None:
        """SLAM has published a keyframe."""
        # The messages of two nodes may overtake each other.
        if stamp_ns in self._done_early:
            self._done_early.discard(stamp_ns)
        else:
            self._keyframes.add(stamp_ns)

    def keyframe_done(self, stamp_ns: int) -> None:
        """A keyframe goes no further; the nodes take them in order, so earlier ones are nearly done
        or lost.
        """
        self._last_sign_s = self._clock_s()
        if stamp_ns not in self._keyframes:
            self._done_early.add(stamp_ns)
        self._keyframes = {t for t in self._keyframes if t > stamp_ns}

    def restart(self) -> None:
        """Start the patience again, e.g. after a pause."""
        self._last_sign_s = self._clock_s()

    def drop_frames(self) -> None:
        """Wait for no frame any more: whoever had them listens no longer."""
        self._frames.clear()

    def give_up(self) -> str:
        """Where nothing has happened for too long, wait for nothing that is under way any more and
        return in words what it was; else ''.
        """
        if self.ready() or self._clock_s() - self._last_sign_s < PATIENCE_S:
            return ''
        words = f'{len(self._frames)} frames and {len(self._keyframes)} keyframes'
        self._frames.clear()
        self._keyframes.clear()
        return words

    def waits_for(self) -> str:
        """Return what is being waited for, in words."""
        if self._frames:
            return f'stereo_slam to answer the frame with stamp {min(self._frames)}'
        return f'the keyframe with stamp {min(self._keyframes, default=0)} to reach the map'
