"""Sources of stereo pairs: folders, bags, videos and devices behind one interface."""

from segfloor_ros.camera.sources.opening import open_source
from segfloor_ros.camera.sources.source import RawPair, StereoSource, prefetched

__all__ = ['RawPair', 'StereoSource', 'open_source', 'prefetched']
