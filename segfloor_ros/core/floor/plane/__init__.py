"""The plane of the floor: the camera's mount in the first frames, and the plane of each frame.

In: disparities with a camera, and the mount where it is known. Out: height, pitch and roll.
The way in is `mount.MountEstimator` for the mount, `plane.plane_of_frame` for a frame.
Paper: Labayrade et al., Real Time Obstacle Detection ... Through V-disparity (2002).
"""
