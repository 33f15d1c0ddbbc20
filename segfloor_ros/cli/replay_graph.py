"""The ROS graph of a replay: a domain of its own, and which topics must be connected."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

from segfloor_ros.errors import SegfloorError
from segfloor_ros.messages.topics import DIAGNOSTICS, NODES, PACED_BY, TOPICS

# DDSI-RTPS 2.3, 9.6.1.1: discovery ports start at 7400, 250 per domain. Above domain 101 they run
# into the ports that Linux hands out to clients.
FIRST_PORT, PORTS_PER_DOMAIN, DOMAINS = 7400, 250, 101
PARTICIPANT_OFFSET = 10
PARTICIPANTS_TRIED = 8

_reservation: socket.socket | None = None
"""Holds the last port of the domain that this process was told."""

RECORDED = (
    'odometry',
    'pose',
    'camera_mount',
    'keyframe/path',
    'keyframe/floor_mask',
    'labelled_points',
)
"""Topics that the replay itself listens to."""


def isolated_environment() -> dict[str, str]:
    """Return the environment of a graph that no other node on the network sees or disturbs.

    A domain or a discovery range that the user has set is kept.
    """
    environment = dict(os.environ)
    environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    if not environment.get('ROS_DOMAIN_ID'):
        environment['ROS_DOMAIN_ID'] = str(free_domain())
    return environment


def free_domain() -> int:
    """Return a ROS domain id without participants on this machine.

    It is reserved for this process until the next call: no other process is told the same one.
    """
    global _reservation
    for attempt in range(DOMAINS):
        domain = 1 + (os.getpid() + attempt) % DOMAINS
        first = FIRST_PORT + PORTS_PER_DOMAIN * domain
        reservation = _bind(first + PORTS_PER_DOMAIN - 1, socket.SOCK_STREAM)
        if reservation is None:
            continue
        if all(_is_free(first + PARTICIPANT_OFFSET + 2 * i) for i in range(PARTICIPANTS_TRIED)):
            _reservation = reservation
            return domain
    raise SegfloorError('every ROS domain id is in use on this machine; set ROS_DOMAIN_ID')


def unconnected(counts: Mapping[str, Mapping[str, int]], is_paced: bool = True) -> list[str]:
    """Return what is missing before the first frame can be sent without loss, in words.

    counts: subscribers by node and topic, as each publisher sees them. is_paced: the camera listens
    to how far the frames are.
    """
    missing = []
    for node in NODES:
        if node not in counts:
            missing.append(f'{node} (no sign of life)')
            continue
        needed = {topic: _listeners_of(topic, is_paced) for topic in counts[node]}
        missing += [
            f'{topic} ({counts[node][topic]} of {number} subscribers)'
            for topic, number in needed.items()
            if counts[node][topic] < number
        ]
    return missing


def _listeners_of(topic: str, is_paced: bool) -> int:
    if topic == DIAGNOSTICS.name:
        return 1  # the replay itself
    listeners = len(TOPICS[topic].subscribers) + (topic in RECORDED)
    return listeners + (is_paced and topic in PACED_BY)


def _is_free(port: int) -> bool:
    probe = _bind(port, socket.SOCK_DGRAM)
    if probe is not None:
        probe.close()
    return probe is not None


def _bind(port: int, kind: socket.SocketKind) -> socket.socket | None:
    bound = socket.socket(socket.AF_INET, kind)
    try:
        bound.bind(('', port))
    except OSError:
        bound.close()
        return None
    return bound
