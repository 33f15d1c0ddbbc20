"""Floor segmentation after Segfloor: disparity, u/v-disparity, B-spline floor profile, mask, scan.

In: a rectified stereo pair (or image and depth) of a keyframe, its pose and the camera's mount.
Out: disparity, floor mask, and the floor scan: how far the floor is seen, per bearing.
The way in is `segmentation.FloorSegmentation`; the rooms are plane, disparity and mask.
"""
