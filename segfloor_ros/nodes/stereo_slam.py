"""Node `stereo_slam`: stereo images in; odometry, tf, keyframes and the sparse map out."""

from __future__ import annotations

import time

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import LastPose, LoadedMap, Mount, StereoFrame
from segfloor_ros.core.errors import InputError, about
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.slam.stereo_slam import CAMERA_AS_BASE, StereoSlam
from segfloor_ros.nodes.messages.diagnostics import Level
from segfloor_ros.nodes.messages.topics import FRAME_DONE, make_header
from segfloor_ros.nodes.settings.slam import StereoSlamNodeSettings
from segfloor_ros.nodes.shared.inputs import CHECK_S
from segfloor_ros.nodes.shared.running import run_node
from segfloor_ros.nodes.shared.stage_node import StageNode
from segfloor_ros.nodes.shared.stamp_order import InTime, StampOrder
from segfloor_ros.nodes.shared.transforms import Transforms
from segfloor_ros.nodes.slam_camera import Pair, StereoInput
from segfloor_ros.nodes.slam_outputs import CameraFrames, SlamResults
from segfloor_ros.nodes.slam_sensors import InitialPose, MaskInput, SensorInput


class StereoSlamNode(StageNode[StereoSlamNodeSettings]):
    """Tracks every stereo pair and publishes what comes of it."""

    settings_type = StereoSlamNodeSettings

    works_on_demand = True

    def set_up(self) -> None:
        """Make the topics."""
        from segfloor_ros.nodes.slam_maps import SlamMaps
        from segfloor_ros.nodes.watches.camera import CameraWatch
        from segfloor_ros.nodes.watches.tf import RivalWatch

        self.slam: StereoSlam | None = None
        self._transforms = Transforms(self, RivalWatch(self))
        self.masks = MaskInput(self, self.settings.mask_timeout_s, self._take_late_mask)
        self._work = self.inputs.later(self._process_waiting)
        self._camera = StereoInput(self, self._work, CameraWatch(self))
        self._sensors = SensorInput(self, self._transforms, self._look)
        self._results = SlamResults(self, self._transforms, self._camera.watch)
        self._maps = SlamMaps(self, self._results.topics, lambda: self.slam)
        self._initial_pose = InitialPose(self)
        self.inputs.every(CHECK_S, self._look_again)
        self.outputs.at_clean_up(self._end_stage)

    def reset_stage(self) -> None:
        """Begin with the map of a killed node, that of `load_map` or an empty one; the mount of the
        camera is found again, too.
        """
        saved = self._maps.read()
        self._end_stage()
        self._results.reset(self.get_clock().now().nanoseconds)
        self._transforms.reset()
        self._camera.reset()
        self._sensors.reset()
        self.masks.reset()
        self._initial_pose.reset()
        self._stamps = StampOrder()
        self._is_started = self._is_resumed = False
        self._frame_count = 0
        kept = self._maps.kept.take()
        if kept is not None:
            self._resume(kept)
        elif saved is not None:
            self._maps.hold_loaded(saved, self._load(saved, self.settings.load_map))

    def reset(self, reason: str) -> None:
        """Drop the map, which is saved first where `save_map` names a file."""
        self._maps.save_before_reset()
        self._maps.kept.remove()
        super().reset(reason)

    def _resume(self, saved: MapFile) -> None:
        """Go on with the map of a killed node: with its stamps, and where it ended. Raises
        InputError.
        """
        from segfloor_ros.core.plugins.maps.saved_slam import last_pose_of

        last = last_pose_of(saved.header.get('note', {}))
        self._results.reset(saved.header['start_ns'])
        self._load(saved, 'kept map', last)
        self._maps.hold_kept(saved)
        self._stamps = StampOrder(last.stamp_ns)
        self._is_resumed = True
        self.get_logger().warning('resumed with the map of a node that was killed')

    def _load(self, saved: MapFile, name: str, last: LastPose | None = None) -> LoadedMap:
        """Make SLAM that goes on with a map; poses alone have the axes that they had in it."""
        from segfloor_ros.core.plugins.maps.saved_slam import base_of, load_slam, saved_camera

        own, camera = self.settings, saved_camera(saved, name)
        self.slam = self._make_slam(camera)
        loaded = load_slam(self.slam, camera, saved, name, own.localize and last is None, last)
        if own.path_only:
            self.slam.rig.base = base_of(saved)
        return loaded

    def is_needed_otherwise(self) -> bool:
        """Whether anybody listens to tf."""
        return self._transforms.listener_count() > 0

    def on_inputs_opened(self) -> None:
        """Give tf time to tell the mount, from now on."""
        self._transforms.start_waiting()

    def on_inputs_closed(self) -> None:
        """Drop the images that wait."""
        self._camera.pairs.clear()

    def find_problems(self) -> None:
        """Follow what the driver offers, and report what is wrong with the camera."""
        self._camera.adapt_to_offers()
        self._sensors.adapt_reliability()
        missing = self._camera.missing_calibrations if self._camera.pairs else []
        self._camera.watch.find_problems(missing)

    def _take_late_mask(self, stamp_ns: int) -> None:
        """Take points back, where the mask is of a frame that was tracked already."""
        last_ns = self._stamps.last_ns
        if self.slam is not None and last_ns is not None and stamp_ns <= last_ns:
            mask = self.masks.mask_of(stamp_ns, self._camera.rectifier)
            self.slam.late_masks.add(stamp_ns, mask)

    def _look(self) -> None:
        if self._camera.pairs:
            self._work()

    def _look_again(self) -> None:
        self._maps.work()
        self._camera.find_images()
        self._look()

    def _process_waiting(self) -> None:
        """Process the first pair that waits, once all is known that it needs; look for newer ones
        before the next.
        """
        pairs = self._camera.pairs
        if not pairs:
            return
        is_ready = self._is_ready(pairs[0][1])
        for stamp_ns, _ in pairs.skip_overdue(is_ready, self.settings.max_waiting_frames):
            self._camera.watch.report_skipped(stamp_ns, is_ready)
            self._answer(stamp_ns)
        lag_ns = self.slam.sensors.lag_ns if self.slam is not None else 0
        if not is_ready or self._sensors.is_behind(pairs[0][0], lag_ns):
            return
        stamp_ns, pair = pairs.popleft()
        self._work()
        if self._is_in_order(stamp_ns):
            self._camera.watch.note_taken()
            self._process(stamp_ns, pair)
        self._answer(stamp_ns)

    def _answer(self, stamp_ns: int) -> None:
        """Report that a pair goes no further."""
        self.outputs.publish(FRAME_DONE, make_header(stamp_ns, self._results.topics.frames.left))

    def _is_ready(self, pair: Pair) -> bool:
        """Whether calibration and mount are known: they come in their own time."""
        if self._is_started:
            return True
        if self._camera.missing_calibrations:
            return False
        if self.settings.gives_mount or self.slam is not None:
            return True
        return self._transforms.mount_is_settled(self._camera.frame_ids(pair)[0])

    def _is_in_order(self, stamp_ns: int) -> bool:
        """Whether a pair comes after the one before; where time has jumped back, e.g. because a
        recording is played again, the map is reset.
        """
        stamps, last_ns = self._stamps, self._stamps.last_ns
        found = stamps.take(stamp_ns)
        step_s = 0.0 if last_ns is None else 1e-9 * (stamp_ns - last_ns)
        if found in (InTime.LATE, InTime.ELSEWHERE):
            words = f'its stamp is {step_s:.3f} s from the one before; dropped'
            if found is InTime.LATE:
                words = 'older than the pair before it; dropped'
            self.reporter.health.count('dropped')
            self.reporter.report(stamp_ns, Level.ERROR, words)
            return False
        if found is InTime.JUMPED and step_s < 0:
            self.reset(f'the stamps of the images went back by {-step_s:.3f} s')
            self._stamps = stamps
        return True

    def _process(self, stamp_ns: int, pair: Pair) -> None:
        start = time.perf_counter()
        try:
            slam = self._started(pair)
            images = self._camera.images(pair)
            mask = self.masks.mask_for(stamp_ns, self._camera.rectifier)
            frame = StereoFrame(self._frame_count, stamp_ns, *images, mask)
            self._frame_count += 1
            for measurement in self._sensors.take(stamp_ns, slam.sensors.lag_ns):
                slam.add(measurement)
            self._initial_pose.apply(slam)
            results = slam.process(frame)
        except Exception as error:
            self.reporter.report_fault(stamp_ns, error)
            return
        self._results.add(results, slam, 1e3 * (time.perf_counter() - start))
        if not results:
            self._results.report_held(stamp_ns, slam)
        elif results[-1].stamp_ns == stamp_ns and results[-1].tracked:
            is_idle = not self._camera.pairs
            self._results.topics.publish_frame(slam.rig_check.corrected(frame), is_idle)
        for sensor, remark in slam.sensors.remarks.items():
            self.reporter.diagnose(sensor, remark)
        self._camera.watch.report_faults(slam.rig_check.faults.values())
        if slam.last_pose is not None:
            from segfloor_ros.core.plugins.maps.saved_slam import last_pose_values

            self._maps.kept.note(last_pose_values(slam.last_pose))

    def _started(self, pair: Pair) -> StereoSlam:
        """Return the stage, made with the first pair, whose calibration is known."""
        if self._is_started and self.slam is not None:
            return self.slam
        camera, frames = self._camera.rectifier.camera, CameraFrames(*self._camera.frame_ids(pair))
        if self.slam is not None and self.slam.rig.camera != camera:
            if not self._is_resumed:
                raise InputError(
                    f'{self.settings.load_map}: was made with another camera or calibration; '
                    'map anew'
                )
            self._end_stage()
        if self.slam is None:
            own = self.settings
            mount = None if own.gives_mount else self._transforms.mount(frames.left)
            if own.path_only and mount is None and not own.has_mount:
                mount = CAMERA_AS_BASE
            source = f'tf from {own.base_frame} to {frames.left}' if mount else 'camera_height_m'
            with about(source):
                self.slam = self._make_slam(camera, mount)
        self.slam.announce = self._results.announce if self.settings.background else None
        self._results.topics.begin(self._camera.calibration, frames)
        self._sensors.begin(frames.left, self._camera.rectifier.calibration.left.R)
        self._is_started = True
        return self.slam

    def _make_slam(self, camera: StereoCamera, mount: Mount | None = None) -> StereoSlam:
        """Build SLAM with all that plugs in, which is loaded only now."""
        from segfloor_ros.core.plugins.assembly import make_slam

        own = self.settings
        return make_slam(camera, own, mount, background=own.background, path_only=own.path_only)

    def _end_stage(self) -> None:
        if self.slam is not None:
            self.slam.close()
        self.slam = None


def main() -> None:
    """Run the node."""
    run_node(StereoSlamNode)


if __name__ == '__main__':
    main()
