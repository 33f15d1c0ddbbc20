"""Calibration, rectification and image sources of the stereo camera."""
