"""Mapping: a frame becomes a keyframe, points are added, and both are adjusted to each other.

In: the track of a frame that shows something new. Out: a better sparse map.
The way in is `back_end.BackEnd`, which owns what is done with the map between frames.
Paper: Triggs et al., Bundle Adjustment - A Modern Synthesis (2000).
"""
