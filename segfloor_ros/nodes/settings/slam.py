"""Parameters of the node `stereo_slam`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from segfloor_ros.core.settings import setting
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.nodes.settings.shared import NodeSettings


@dataclass(frozen=True)
class StereoSlamNodeSettings(StereoSlamSettings, NodeSettings):
    """Frames, images and tf."""

    map_frame: str = setting('map', 'Frame of the map.')
    odom_frame: str = setting('odom', 'Continuous frame of the odometry.')
    base_frame: str = setting('base_link', 'Frame of the robot, on the floor.')
    publish_tf: bool = setting(
        True, 'Broadcast tf: map to odom, odom to base_link, and the mount where tf lacks it.'
    )
    publish_odom_tf: bool = setting(
        True,
        'Broadcast odom to base_link; off where another node does, e.g. one that fuses the wheels: '
        'map to odom then corrects that one.',
    )
    tf_wait_s: float = setting(
        5.0,
        'How long after the start to wait for the mount of the camera on tf before measuring it, '
        'where another node publishes tf.',
        within=(0.0, 60.0),
    )
    load_map: str = setting(
        '',
        'Saved map to continue, at the start, at a reset and by ~/load_map; empty: an empty map.',
        live=True,
    )
    localize: bool = setting(
        False, 'Poses in the map of load_map only: nothing is added to it.', live=True
    )
    path_only: bool = setting(
        False,
        'Poses alone, without floor and map; where the mount of the camera is not known, the base '
        'is taken to be where the camera is.',
    )
    resume_within_s: float = setting(
        30.0,
        'A node that is killed and restarted within this time continues its map; 0: it begins an '
        'empty one.',
        within=(0.0, 3600.0),
    )
    save_map: str = setting('', 'File that ~/save_map writes the whole map to.', live=True)
    background: bool = setting(
        True,
        'Adjust the map in parallel to tracking, so that no frame waits for it; off: results do '
        'not depend on timing.',
    )
    image_kind: str = setting(
        'auto',
        'Take raw images, which are rectified here, or rectified ones (left/image_rect and '
        'right/image_rect); auto: what is published, raw ones first.',
        choices=('auto', 'raw', 'rect'),
    )
    use_depth: bool = setting(
        False,
        'Take depth/image_raw in place of the right images; off: only where nobody publishes '
        'those.',
    )
    image_transport: str = setting(
        'auto',
        'Take images as they are or compressed, the latter on the topics with /compressed behind '
        'their names; auto: what is published, uncompressed ones first.',
        choices=('auto', 'raw', 'compressed'),
    )
    image_reliability: str = setting(
        'auto',
        'Quality of service of the image subscriptions; auto: reliable, and best effort where a '
        'driver offers no more.',
        choices=('auto', 'reliable', 'best_effort'),
    )
    sync_tolerance_s: float = setting(
        0.005,
        'Largest difference of stamps of a left and a right image of one pair.',
        within=(0.0, 0.5),
    )
    mask_timeout_s: float = setting(
        0.2,
        'A mask on dynamic_mask also serves later frames until it is this old or a newer one '
        'comes; 0: only the frame of its stamp.',
        within=(0.0, 10.0),
    )
    max_waiting_frames: int = setting(
        3,
        'When more pairs than these wait, the oldest are skipped, so that poses stay fresh where '
        'tracking is slower than the camera; while it is not, twice as many may wait for a '
        'keyframe. A lossless stereo_camera sends no more at a time.',
        within=(3, 100),
        live=True,
    )

    @property
    def gives_mount(self) -> bool:
        """Whether any of height, pitch and roll of the camera is given; then tf is not asked."""
        given = (self.camera_height_m, self.camera_pitch_rad, self.camera_roll_rad)
        return not all(math.isnan(value) for value in given)
