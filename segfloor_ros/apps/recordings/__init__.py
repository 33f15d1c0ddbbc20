"""Recordings: folders, bags, videos and devices behind one interface, and bags that are written.

In: a path, a device or a pattern. Out: a `StereoSource` of stamped pairs with their calibration.
The way in is `open_source`; `bag_writer` writes, `ros_bag` reads and writes by ROS.
"""

from segfloor_ros.apps.recordings.opening import open_source
from segfloor_ros.apps.recordings.source import StereoSource, prefetched
from segfloor_ros.core.camera.recording import RawPair

__all__ = ['RawPair', 'StereoSource', 'open_source', 'prefetched']
