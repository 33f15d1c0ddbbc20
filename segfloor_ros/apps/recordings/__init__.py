"""Sources of stereo pairs: folders, bags, videos and devices behind one interface."""

from segfloor_ros.apps.recordings.opening import open_source
from segfloor_ros.apps.recordings.source import StereoSource, prefetched
from segfloor_ros.core.camera.recording import RawPair

__all__ = ['RawPair', 'StereoSource', 'open_source', 'prefetched']
