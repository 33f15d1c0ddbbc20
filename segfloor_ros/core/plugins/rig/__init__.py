"""What is wrong with a camera: said within fifty frames, from its images alone.

In: rectified frames. Out: faults with a figure and a remedy, and frames whose rows are mended.
The way in is `check.RigCheck`. Paper: Hartley, Self-calibration from multiple views with a rotating
camera (1994).
"""
