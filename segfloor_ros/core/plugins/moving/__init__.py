"""What moves in an image, found by geometry alone.

In: a frame with its pose, and earlier keyframes. Out: a mask of what moves, and moving points.
The way in is `moving_regions.MovingRegions`. Papers: DynaSLAM (Bescos et al., 2018), geometric
half; Vedula et al., Three-Dimensional Scene Flow (1999).
"""
