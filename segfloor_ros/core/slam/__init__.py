"""Feature-based stereo SLAM after ORB-SLAM2 (Mur-Artal and Tardos, 2017) and OpenVSLAM.

In: rectified stereo frames. Out: a pose per frame, a keyframe with its features per new view, and
the sparse map. The way in is `stereo_slam.StereoSlam`; the map is `sparse_map.SparseMap`; the rooms
are tracking, mapping and places. What plugs in is listed in `optional`.
"""
