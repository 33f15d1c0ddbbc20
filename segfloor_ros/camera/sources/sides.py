"""Names that stereo recordings give to their two sides."""

from __future__ import annotations

from collections.abc import Iterable

SIDES = (
    ('left', 'right'),
    ('Left', 'Right'),
    ('LEFT', 'RIGHT'),
    ('infra1', 'infra2'),
    ('cam0', 'cam1'),
    ('cam_0', 'cam_1'),
    ('camera0', 'camera1'),
    ('camera_0', 'camera_1'),
    ('image0', 'image1'),
    ('image_00', 'image_01'),
    ('image_0', 'image_1'),
    ('image_02', 'image_03'),
    ('image_2', 'image_3'),
)
"""Words for left and right inside a name, the usual ones first."""


def side_pairs(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the (left, right) names that differ only in the word for the side, in the order of
    `SIDES`, then of `names`.
    """
    known = list(names)
    pairs: dict[tuple[str, str], None] = {}
    for left_word, right_word in SIDES:
        for name in known:
            partner = name.replace(left_word, right_word)
            if partner != name and partner in known:
                pairs[name, partner] = None
    return list(pairs)


def is_side(name: str, side: int) -> bool:
    """Whether `name` says, in letters, that it is the left (0) or the right (1) side."""
    return ('left', 'right')[side] in name.lower()
