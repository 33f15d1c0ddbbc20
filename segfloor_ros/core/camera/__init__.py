"""The stereo camera: its model, its calibration and rectification, and images as arrays.

In: raw images, calibrations, messages of sensors. Out: rectified stereo frames of a known camera.
The way in is `rectification.StereoRectifier`; `model` is what all stages know of the camera.
"""
