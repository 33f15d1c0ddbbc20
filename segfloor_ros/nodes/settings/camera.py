"""Parameters of the node `stereo_camera`."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.settings import setting
from segfloor_ros.nodes.settings.shared import NodeSettings


@dataclass(frozen=True)
class StereoCameraNodeSettings(StereoCameraSettings, NodeSettings):
    """How a recording is played."""

    rate: float = setting(
        1.0,
        'Speed of a recording against real time; 0: as fast as the chain takes it, without loss.',
        within=(0.0, 100.0),
    )
    lossless: bool = setting(
        False,
        'Slow down rather than lose a frame when the nodes cannot follow; always so at rate 0.',
    )
    image_transport: str = setting(
        'raw',
        'Publish the images raw or compressed, the latter on left/image_raw/compressed and '
        'right/image_raw/compressed, for links that raw images would fill.',
        choices=('raw', 'compressed'),
    )
    compression: str = setting(
        'jpeg',
        'How images are compressed: jpeg, small, or png, without loss.',
        choices=('jpeg', 'png'),
    )
    publish_clock: bool = setting(
        False,
        'Publish the stamps of a recording as /clock, for nodes with use_sim_time; no other node '
        'may do so.',
    )
    start_paused: bool = setting(False, 'Wait for the service ~/pause before the first frame.')
    left_frame: str = setting('left_camera_optical_frame', 'Optical frame of the left camera.')
    right_frame: str = setting('right_camera_optical_frame', 'Optical frame of the right camera.')
