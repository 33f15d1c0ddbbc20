"""What is published that looks like a topic that nobody publishes."""

from __future__ import annotations

import difflib

from rclpy.node import Node

from segfloor_ros.nodes.messages.topics import NODES, TOPICS

MOST = 3

SIDES = {
    'left': ('left', 'infra1', 'ir_left', 'cam0'),
    'right': ('right', 'infra2', 'ir_right', 'cam1'),
}
"""How drivers call the two sides."""


def lookalikes(node: Node, topic: str, kind: str) -> list[str]:
    """Return the published topics of a type, e.g. `sensor_msgs/msg/Image`, that look most like a
    full topic name; those of the other side of a stereo pair last, none that these nodes make.
    """
    own = tuple(f'/{one.name}' for one in TOPICS.values() if one.publisher in NODES[1:])
    found = [
        name
        for name, kinds in node.get_topic_names_and_types()
        if kind in kinds and not name.endswith(own) and node.count_publishers(name)
    ]
    return sorted(found, key=lambda name: -likeness(topic, name))[:MOST]


def likeness(wanted: str, name: str) -> float:
    """Return how much a topic's name looks like another: by its letters, and by its side."""
    score = difflib.SequenceMatcher(None, wanted.lower(), name.lower()).ratio()
    for side, words in SIDES.items():
        if side in wanted:
            score += any(word in name.lower() for word in words)
            others = (word for other, them in SIDES.items() if other != side for word in them)
            score -= any(word in name.lower() for word in others)
    return score
