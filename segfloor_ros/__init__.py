"""Occupancy maps for ground robots from a stereo camera alone."""

import os

__version__ = '0.2.0'

MAX_PIXELS = 50_000_000
"""Larger images are refused: a damaged header must not take all memory."""

# OpenCV and the FFmpeg in it read these when they are loaded; what is wrong is said here, once.
os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(MAX_PIXELS))
os.environ.setdefault('OPENCV_LOG_LEVEL', 'OFF')
os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')
