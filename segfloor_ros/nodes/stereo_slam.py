"""Node `stereo_slam`: stereo images in; odometry, tf, keyframes and the sparse map out."""

from __future__ import annotations

import json
import math
import time
from collections import deque

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.configuration import StereoSlamNodeSettings
from segfloor_ros.errors import InputError
from segfloor_ros.geometry import MAX_DISORDER_NS
from segfloor_ros.map_file import MapFile
from segfloor_ros.messages.diagnostics import REMARKS_APART, Level
from segfloor_ros.messages.topics import FRAME_DONE, make_header
from segfloor_ros.nodes.shared.running import run_node
from segfloor_ros.nodes.shared.stage_node import StageNode
from segfloor_ros.nodes.shared.transforms import Transforms
from segfloor_ros.nodes.shared.when_idle import WhenIdle
from segfloor_ros.nodes.slam_camera import Pair, PairQueue, StereoInput
from segfloor_ros.nodes.slam_maps import SlamMaps
from segfloor_ros.nodes.slam_outputs import CameraFrames, LostTime, SlamOutputs
from segfloor_ros.nodes.slam_sensors import InitialPose, MaskInput, SensorInput
from segfloor_ros.pipeline import make_slam
from segfloor_ros.slam.mapping.back_end import Submap
from segfloor_ros.slam.results import FrameResult
from segfloor_ros.slam.saved_slam import (
    LoadedMap,
    last_pose_of,
    last_pose_values,
    load_slam,
    saved_camera,
)
from segfloor_ros.slam.stereo_slam import StereoSlam

LOOK_AGAIN_S = 0.2
REMARK_AGAIN_S = 600.0
NEXT_S, IDLE_S = 0.005, 0.05
"""Results that were held back are published one by one: others need time to take each of them."""
MAPPING_SUBMAP = 'lost; maps a submap until it recognises a place of the map'


class StereoSlamNode(StageNode[StereoSlamNodeSettings]):
    """Tracks every stereo pair and publishes what comes of it."""

    settings_type = StereoSlamNodeSettings

    works_on_demand = True

    def set_up(self) -> None:
        """Make the topics."""
        own = self.settings
        self._slam: StereoSlam | None = None
        self._ready: tuple[StereoSlam, StereoCamera] | None = None
        self._waiting = PairQueue()
        self._unsent: deque[tuple[FrameResult, StereoSlam, float]] = deque()
        self._outputs = SlamOutputs(self, own)
        self._frame_done = self.output(FRAME_DONE)
        self._transforms = Transforms(self, own)
        self._masks = MaskInput(self, own.mask_timeout_s)
        self._work = WhenIdle(self, self._process_waiting)
        self._camera = StereoInput(self, own, self._take_pair, self._work.request)
        self._sensors = SensorInput(self, self._transforms, self._look_at_waiting)
        self._maps = SlamMaps(self, self._known, lambda: self.reset('by ~/load_map'))
        self._initial_pose = InitialPose(self, own)
        self.inputs.every(LOOK_AGAIN_S, self._look_again)
        self.inputs.repeat(self._send_next)
        self.at_clean_up(self._end_stage)

    def reset_stage(self) -> None:
        """Begin with the map of `load_map` or an empty one; the mount of the camera is found again,
        too.
        """
        saved = self._maps.read()
        self._end_stage()
        self._waiting.reset()
        self._unsent.clear()
        self._outputs.reset(self.get_clock().now().nanoseconds, is_loaded=saved is not None)
        self._transforms.reset()
        self._camera.reset()
        self._sensors.reset()
        self._masks.reset()
        self._initial_pose.reset()
        self._lost = LostTime(self)
        self._last_stamp_ns: int | None = None
        self._is_resumed = False
        self._frames = CameraFrames('', '')
        self._mount: Mount | None = None
        self._provisional_ns = -1
        self._frame_count = 0
        self._unannounced: tuple[MapFile, LoadedMap] | None = None
        if saved is not None:
            name, own = self.settings.load_map, self.settings
            slam, camera = self._ready = self._make_slam(saved_camera(saved, name))
            loaded = load_slam(slam, camera, saved, name, own.localize)
            self._unannounced = saved, loaded

    def restore(self, saved: MapFile) -> None:
        """Go on with the map of a killed node: with its stamps, and where it ended. Raises
        InputError.
        """
        last = last_pose_of(saved.header.get('note', {}))
        self._unannounced = None
        self._outputs.reset(saved.header['start_ns'])
        slam, camera = self._ready = self._make_slam(saved_camera(saved, 'kept map'))
        load_slam(slam, camera, saved, 'kept map', last=last)
        self._last_stamp_ns = last.stamp_ns
        self._is_resumed = True

    def is_needed_otherwise(self) -> bool:
        """Whether anybody listens to tf."""
        return self._transforms.listener_count() > 0

    def on_inputs_opened(self) -> None:
        """Give tf time to tell the mount, from now on."""
        self._transforms.start_waiting()

    def on_inputs_closed(self) -> None:
        """Drop the images that wait."""
        self._waiting.clear()

    def find_problems(self) -> None:
        """Follow what the driver offers, and report what is wrong with the camera."""
        self._camera.adapt_reliability()
        self._sensors.adapt_reliability()
        missing = self._camera.missing_calibrations if self._waiting else []
        self._camera.watch.find_problems(missing)

    def _take_pair(self, stamp_ns: int, pair: Pair) -> None:
        self._waiting.append((stamp_ns, pair))
        self._work.request()

    def _look_at_waiting(self) -> None:
        if self._waiting:
            self._work.request()

    def _look_again(self) -> None:
        if self._unannounced is not None:
            self._maps.announce(*self._unannounced, self._outputs.map_start_ns)
            self._unannounced = None
        self._camera.find_images()
        self._work.request()

    def _process_waiting(self) -> None:
        """Process the first pair that waits, once all is known that it needs; look for newer ones
        before the next.
        """
        if not self._waiting:
            return
        is_ready = self._is_ready(self._waiting[0][1])
        least = self.settings.max_waiting_frames
        for stamp_ns, _ in self._waiting.skip_overdue(is_ready, least):
            self._camera.watch.report_skipped(stamp_ns, is_ready)
            self._frame_done.publish(make_header(stamp_ns, self._frames.left))
        lag_ns = self._slam.sensors.lag_ns if self._slam is not None else 0
        if not is_ready or self._sensors.is_behind(self._waiting[0][0], lag_ns):
            return
        stamp_ns, pair = self._waiting.popleft()
        self._work.request()
        if self._is_in_order(stamp_ns):
            self._process(stamp_ns, pair)
        self._frame_done.publish(make_header(stamp_ns, self._frames.left))

    def _is_ready(self, pair: Pair) -> bool:
        """Whether calibration and mount are known: they come in their own time."""
        if self._slam is not None:
            return True
        if self._camera.missing_calibrations:
            return False
        if self._mount_is_given() or self._ready is not None:
            return True
        return self._transforms.mount_is_settled(self._camera.frame_ids(pair)[0])

    def _mount_is_given(self) -> bool:
        settings = self.settings
        given = (settings.camera_height_m, settings.camera_pitch_rad, settings.camera_roll_rad)
        return not all(math.isnan(value) for value in given)

    def _is_in_order(self, stamp_ns: int) -> bool:
        """Whether a pair comes after the one before; where time has jumped back, e.g. because a
        recording is played again, the map is reset.
        """
        last_ns = self._last_stamp_ns
        if last_ns is not None and stamp_ns < last_ns - MAX_DISORDER_NS:
            jump_s = 1e-9 * (last_ns - stamp_ns)
            self.reset(f'the stamps of the images went back by {jump_s:.3f} s')
        elif last_ns is not None and stamp_ns <= last_ns:
            self.reporter.report(stamp_ns, Level.ERROR, 'older than the pair before it; dropped')
            return False
        self._last_stamp_ns = stamp_ns
        return True

    def _process(self, stamp_ns: int, pair: Pair) -> None:
        start = time.perf_counter()
        try:
            slam = self._slam or self._start(pair)
            images = self._camera.images(pair)
            mask = self._masks.mask_for(stamp_ns, self._camera.rectifier)
            frame = StereoFrame(self._frame_count, stamp_ns, *images, mask)
            self._frame_count += 1
            for measurement in self._sensors.take(stamp_ns, slam.sensors.lag_ns):
                slam.add(measurement)
            self._initial_pose.apply(slam)
            results = slam.process(frame)
        except Exception as error:
            self.reporter.report_fault(stamp_ns, error)
            return
        milliseconds = 1e3 * (time.perf_counter() - start)
        self._unsent.extend((result, slam, milliseconds / len(results)) for result in results)
        if results and results[-1].stamp_ns == stamp_ns and results[-1].tracked:
            frame = slam.rig_check.corrected(frame)
            images = frame.left, frame.right
            self._outputs.publish_frame(stamp_ns, images, self._calibration, self._frames)
        if len(self._unsent) == 1:
            self._send_next()
        for about, remark in slam.sensors.remarks.items():
            self.reporter.diagnose(about, remark, repeat_s=REMARK_AGAIN_S)
        self._camera.watch.report_faults(slam.rig_check.faults.values())
        if self._mount is not None and slam.back_end.idle:
            self._maps.keep(slam)
        if slam.last_pose is not None:
            self.kept_state.note(last_pose_values(slam.last_pose))
        if not results:
            self._report_held(stamp_ns, slam)

    def _start(self, pair: Pair) -> StereoSlam:
        """Build the stage, now that the calibration is known."""
        camera = self._camera.rectifier.camera
        self._calibration = self._camera.calibration
        self._frames = CameraFrames(*self._camera.frame_ids(pair))
        if self._ready is not None and self._ready[1] != camera:
            if not self._is_resumed:
                raise InputError(
                    f'{self.settings.load_map}: was made with another camera or calibration; '
                    'map anew'
                )
            self._ready = None
        if self._ready is None:
            mount = None if self._mount_is_given() else self._transforms.mount(self._frames.left)
            self._ready = self._make_slam(camera, mount)
        self._slam = self._ready[0]
        self._sensors.begin(self._frames.left, self._camera.rectifier.calibration.left.R)
        return self._slam

    def _make_slam(
        self, camera: StereoCamera, mount: Mount | None = None
    ) -> tuple[StereoSlam, StereoCamera]:
        stage, background = self.settings, self.settings.background
        return make_slam(camera, stage, mount, background=background), camera

    def _end_stage(self) -> None:
        if self._ready is not None:
            self._ready[0].close()
        self._slam = self._ready = None

    def _known(self) -> tuple[StereoSlam, StereoCamera, int] | None:
        """Return what can be saved."""
        return self._ready and (*self._ready, self._outputs.map_start_ns)

    def _send_next(self) -> float:
        """Publish the oldest result that is not yet; return in how many seconds the next is due."""
        if self._unsent:
            self._publish(*self._unsent.popleft())
        return NEXT_S if self._unsent else IDLE_S

    def _publish(self, result: FrameResult, slam: StereoSlam, milliseconds: float) -> None:
        if self._mount is None and result.tracked and slam.mount is not None:
            self._announce_mount(result.stamp_ns, slam.mount)
        # What a robot steers by comes first, the images of a keyframe later.
        if result.stamp_ns > self._provisional_ns:
            self._transforms.broadcast(result)
        self._outputs.publish(result, self._calibration, self._frames)
        level = Level.WARN if result.blind else Level.OK if result.tracked else Level.ERROR
        self.reporter.report_processed(
            result.stamp_ns,
            level,
            result.state,
            milliseconds,
            tracked=int(result.tracked),
            loops=slam.back_end.loop_count,
            keyframe=int(result.keyframe is not None),
            matches=result.num_matches,
            reference_keyframe_ns=result.reference_keyframe_ns,
            **self._lost.note(result.stamp_ns, result.tracked),
            moving=len(result.moving.xyz_map) if result.moving is not None else 0,
            blind=int(result.blind),
            submap=int(result.in_submap),
            repeated=int(result.repeated and result.tracked),
            input_faults=_faults_json(slam),
            remarks=REMARKS_APART.join(slam.sensors.remarks.values()),
        )

    def _report_held(self, stamp_ns: int, slam: StereoSlam) -> None:
        """Tell why no result is ready. While the mount is being measured, and by a drive that was
        broken off, the newest pose is published: it is corrected once, when keyframes come.
        """
        result = slam.provisional
        if result is not None:
            self._provisional_ns = stamp_ns
            self._transforms.broadcast(result)
            self._outputs.publish(result, self._calibration, self._frames)
        if slam.back_end.submap is Submap.LOST:
            lost = self._lost.note(stamp_ns, tracked=False)
            self.reporter.report(stamp_ns, Level.ERROR, MAPPING_SUBMAP, tracked=0, submap=1, **lost)
            return
        words = 'pose with a provisional mount: the floor is not seen well enough to measure it yet'
        self.reporter.report_waiting(stamp_ns, words, input_faults=_faults_json(slam))

    def _announce_mount(self, stamp_ns: int, mount: Mount) -> None:
        self._mount = mount
        self.get_logger().info(
            f'camera {mount.height_m:.3f} m above the floor, pitch '
            f'{math.degrees(mount.pitch_rad):.2f} deg, roll {math.degrees(mount.roll_rad):.2f} deg'
        )
        if not self._mount_is_given() and self._transforms.mount(self._frames.left) is None:
            self._camera.watch.judge_measured(mount)
        self._outputs.publish_mount(self._frames, mount)
        self._transforms.announce_mount(stamp_ns, self._frames.left, mount)


def _faults_json(slam: StereoSlam) -> str:
    return json.dumps(slam.rig_check.as_dicts())


def main() -> None:
    """Run the node."""
    run_node(StereoSlamNode)


if __name__ == '__main__':
    main()
