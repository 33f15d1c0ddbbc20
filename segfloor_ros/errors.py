"""The exceptions of the package. All share one root, so that a program can print one line and
stop.
"""


class SegfloorError(Exception):
    """Root of every error whose message is meant for the user: what, where, what to do."""


class InputError(SegfloorError):
    """A recording cannot be read: missing, empty, inconsistent or of an unknown kind."""


class CalibrationError(SegfloorError):
    """A camera calibration is missing, incomplete or impossible."""


class SettingsError(SegfloorError):
    """A parameter is unknown, of the wrong type or out of its range."""


class MapError(SegfloorError):
    """No map could be made, or a map file cannot be read."""
