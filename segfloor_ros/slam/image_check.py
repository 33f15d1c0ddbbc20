"""Images that cannot be tracked: black, white, or only half delivered."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MIN_CONTRAST = 3.0
MIN_LIVE_ROWS = 0.7


def image_fault(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> str:
    """Return what is wrong with a stereo pair of grey images (H, W), in words, or '' when it
    can be tracked.
    """
    for side, image in (('left', left), ('right', right)):
        sampled = image[::4, ::4]
        if float(sampled.std()) < MIN_CONTRAST:
            return f'{side} image without contrast (mean grey level {sampled.mean():.0f})'
        live = np.ptp(sampled, axis=1) > 0
        if live.mean() < MIN_LIVE_ROWS:
            return f'{side} image incomplete: {1 - live.mean():.0%} of its rows are empty'
    return ''
