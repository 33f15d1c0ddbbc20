"""How much must agree for something to be believed: one answer for all rooms of SLAM."""

from __future__ import annotations

ENOUGH = 20
"""Fewest points that must be shared for two views to be linked. Chance gives five or six."""

SAME = 0.5, 0.3
"""Two poses further apart than this, in m and rad, are two places."""

MAJORITY = 0.5
"""Share that must agree: a wrong pose has followers too, but not most."""

CHANCE_SHARE = 0.1
"""Share of the points of a view of which no more may be found by chance: far ones alone fit many
places."""

NEARLY_ALL = 0.9
"""Share of a keyframe's points that others must see as well, or of a view that they must cover, for
it to add nothing (Mur-Artal et al., ORB-SLAM, IEEE T-RO 2015, section VI-E); and what counts as
much as the best."""

SEARCHED_FRAMES = 100
"""Frames of a camera that is looked for: for so long only the neighbourhood of a given pose is
searched, which may be wrong, and so many may turn out to have seen where it was."""

FOUND_SHARE = 0.25
"""Least share of what should be seen that must be found: by a frame, of the points of its keyframe,
and in frames, of a point (Mur-Artal et al., ORB-SLAM, 2015, sections V-E and VI-B)."""

POINTS_PER_KEYFRAME = 300
"""Points of a keyframe that hold the map together where it is adjusted as a whole, those that most
others see, and corners of its floor; the rest moves along."""

PROOF = 3
"""Keyframes that must show something for it to be believed: that a point stands still, or is gone,
that a view adds nothing; and corners of a thing that moves. By chance
hardly two agree."""


SPEED_SIGMA = 0.5
"""Error of a speed that nothing measures, m/s: at first, or by wheels that slip; and how much one
changes that is taken for constant, m/s per root second."""
