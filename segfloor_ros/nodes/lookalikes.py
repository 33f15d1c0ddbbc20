"""Topics that are published and look like one that nobody publishes."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from rclpy.node import Node

MOST = 3
SIDES = {
    'left': ('left', 'infra1', 'ir_left', 'cam0'),
    'right': ('right', 'infra2', 'ir_right', 'cam1'),
}
"""How drivers call the two sides."""


def lookalikes(node: Node, topic: str, kind: str) -> list[str]:
    """Return the published topics of a type, e.g. `sensor_msgs/msg/Image`, that look most like a
    full topic name; those of the other side of a stereo pair last.
    """
    own = {publisher.topic_name for publisher in node.publishers}
    found = [
        name
        for name, kinds in node.get_topic_names_and_types()
        if kind in kinds and name not in own and node.count_publishers(name)
    ]
    return sorted(found, key=lambda name: -likeness(topic, name))[:MOST]


def published_kinds(node: Node, topic: str) -> list[str]:
    """Return the types that a full topic name is published with."""
    return sorted({info.topic_type for info in node.get_publishers_info_by_topic(topic)})


def likeness(wanted: str, name: str) -> float:
    """Return how much a topic's name looks like another: by its letters, and by its side."""
    score = difflib.SequenceMatcher(None, wanted.lower(), name.lower()).ratio()
    for side, words in SIDES.items():
        if side in wanted:
            score += any(word in name.lower() for word in words)
            others = (word for other, them in SIDES.items() if other != side for word in them)
            score -= any(word in name.lower() for word in others)
    return score


def in_words(names: Sequence[str]) -> str:
    """Return names as a list in words."""
    return ', '.join(names[:-1]) + ' and ' * (len(names) > 1) + names[-1] if names else 'nothing'
