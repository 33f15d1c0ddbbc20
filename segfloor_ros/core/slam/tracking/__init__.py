"""Tracking: where the camera is, frame by frame.

In: the images of a frame, the sparse map, and what the sensors measured since the last frame.
Out: a `Track`, the pose and the map points found again, or that tracking is lost.
The way in is `front_end.FrontEnd`. Papers: ORB (Rublee et al., 2011), ORB-SLAM2 (Mur-Artal and
Tardos, 2017), SVO (Forster et al., 2014) for the alignment of patches.
"""
