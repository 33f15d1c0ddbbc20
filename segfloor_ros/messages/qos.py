"""Quality of service of the topics, by name.

Everything between the nodes of this package is reliable: best effort loses large messages. Only
the camera images of other drivers may be taken best effort, by parameter.
"""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

IMAGE_DEPTH = 30
KEYFRAME_DEPTH = 100


def _reliable(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def _lossy(depth: int) -> QoSProfile:
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


IMAGES = _reliable(IMAGE_DEPTH)
"""Camera images and their calibrations."""

IMAGES_BEST_EFFORT = _lossy(10)
"""Camera images of drivers that publish best effort; frames may be lost."""

SENSORS = _lossy(400)
"""Wheel odometry and IMU of drivers that publish best effort."""

SENSORS_RELIABLE = _reliable(400)
"""Wheel odometry and IMU where that is offered."""

FRAMES = _reliable(5)
"""Small images of every frame, of which only the latest count."""

KEYFRAMES = _reliable(KEYFRAME_DEPTH)
"""Everything about a keyframe; deep enough for a burst after the camera's mount was measured."""

ODOMETRY = _reliable(KEYFRAME_DEPTH)
"""Poses of frames."""

LATCHED = _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""The last value also for those who come later: the map, the camera's mount (REP-2003)."""

CLOCK = _reliable(10)
"""The time of a recording."""

TF = _reliable(100)
"""Moving frames, as tf2 does."""

TF_STATIC = _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""Fixed frames that one node broadcasts, all in one message."""

TF_STATIC_LISTENER = _reliable(100, DurabilityPolicy.TRANSIENT_LOCAL)
"""The fixed frames of many nodes."""

DIAGNOSTICS = _reliable(KEYFRAME_DEPTH)
"""Status messages."""


def describe(profile: QoSProfile) -> str:
    """Return a profile in words, e.g. `reliable, volatile, depth 30`."""
    return f'{describe_policies(profile)}, depth {profile.depth}'


def describe_policies(profile: QoSProfile) -> str:
    """Return what both sides must agree on in words, e.g. `reliable, volatile`."""
    words = (profile.reliability.name, profile.durability.name)
    return ', '.join(word.lower().replace('_', ' ') for word in words)
