"""By how much the stamps of a sensor are later than those of the images."""

from __future__ import annotations

SAID_S = 0.01
"""A lag that is worth a word; less is what a driver may be off."""


def is_late(lag_s: float, sigma_s: float) -> bool:
    """Whether a lag is large enough, and known well enough, to be said."""
    return abs(lag_s) > max(SAID_S, 3 * sigma_s)


def lag_in_words(sensor: str, lag_s: float) -> str:
    """Return that the stamps of a sensor are late, in words."""
    later = 'later' if lag_s > 0 else 'earlier'
    return (
        f'the stamps of the {sensor} are {1e3 * abs(lag_s):.0f} ms {later} than those of the '
        'images; this is taken into account'
    )
