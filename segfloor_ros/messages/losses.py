"""Messages that never came, by the numbers that the middleware gives to those of one publisher."""

from __future__ import annotations

from rclpy.qos import QoSProfile, ReliabilityPolicy


class LossCounter:
    """Counts the gaps in the numbers of one topic. A number that does not grow is that of another
    publisher, or of one that was started again: counting starts over.
    """

    def __init__(self) -> None:
        self.total = 0
        self._last: int | None = None

    def note(self, number: int | None) -> int:
        """Take in the number of a message, None where the middleware knows none; returns how many
        are missing before it.
        """
        last, self._last = self._last, number
        if last is None or number is None or number <= last:
            return 0
        self.total += number - last - 1
        return number - last - 1

    def skip(self) -> None:
        """Let the numbers of the next messages be any: nothing was to be received meanwhile."""
        self._last = None


def loss_in_words(topic: str, lost: int, node: str, profile: QoSProfile) -> str:
    """Return what was lost, why, and what to do about it."""
    if profile.reliability == ReliabilityPolicy.BEST_EFFORT:
        return (
            f'{lost} messages lost on {topic}, which is taken best effort; set image_reliability '
            'to reliable where the driver offers it, or lower the rate or the size of the images'
        )
    return (
        f'{lost} messages lost on {topic}: {node} was too slow for its queue of {profile.depth}, '
        'or the link is; lower the rate or the size of the images, let stereo_slam make fewer '
        'keyframes, or play a recording with lossless set on stereo_camera'
    )
