"""What the package exists for: stereo images in, an occupancy grid out.

Imports NumPy, OpenCV, SciPy and itself, nothing else: no ROS, no YAML, no command line. `pipeline`
knows the order of the stages, which are camera, slam, floor, cloud and grid. What a map can do
without is in `plugins`.
"""
