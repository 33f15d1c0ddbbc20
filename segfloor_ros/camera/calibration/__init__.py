"""Calibration: lenses and relative pose of a stereo pair, measured, read from files, and applied.

In: pictures of a board, or files of ROS, EuRoC, KITTI. Out: a calibration, rectified images.
The way in is `parameters.StereoCalibration`. Paper: Zhang, A Flexible New Technique for Camera
Calibration (2000).
"""
