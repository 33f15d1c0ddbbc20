"""Occupancy maps for ground robots from a stereo camera alone."""

__version__ = '0.1.0'
