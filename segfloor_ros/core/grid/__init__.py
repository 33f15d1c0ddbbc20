"""The occupancy grid: evidence of free and occupied cells, which follows the keyframes.

In: labelled points, features, path and floor scan of each keyframe. Out: a grid as Nav2 takes it.
The way in is `mapper.OccupancyGridMapper`; `occupancy` holds the grid and its settings.
"""
