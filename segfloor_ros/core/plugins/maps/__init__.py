"""Saved maps and sessions: SLAM goes on with a map, and maps a submap beside one it was lost in.

In: the sparse map, or the arrays of a file. Out: arrays, and a known map that is merged with the
drive's own (Campos et al., ORB-SLAM3, IEEE T-RO 2021, section VI). The way in is `MapSession`.
"""
