"""The parts of the node `stereo_slam`: its inputs, its outputs, its maps and its camera's faults.

In: stereo pairs, depth, wheels, IMU, masks as messages. Out: odometry, tf, keyframes, saved maps.
The way in is `nodes.stereo_slam`.
"""
