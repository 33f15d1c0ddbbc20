"""The sparse map: keyframes and points, how a stereo camera measures them, and copies of both.

In: keyframes and points of mapping. Out: arrays by row or by id, for tracking, files and messages.
The way in is `sparse_map.SparseMap`; `records` are its rows.
"""
