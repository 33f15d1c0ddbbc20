"""Errors of messages that arrive."""

from segfloor_ros.errors import SegfloorError


class MessageError(SegfloorError):
    """A message contradicts itself or is of a kind that the package does not take."""
