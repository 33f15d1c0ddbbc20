"""How much views say for a place, against all others that it may be taken for.

Chance is soon excluded: what looks like a place is there, or somewhere else. So a view counts as
much as the share of views that fit elsewhere, too, allows, and what speaks against the place is
taken from that. Views that agree are summed, with how likely the robot is there at all (Bayes'
rule in logarithms: MacKay, Information Theory, Inference, and Learning Algorithms, 2003, chapter
3). All terms are natural logarithms of ratios of likelihood, in nats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from segfloor_ros.core.slam.tracking.evidence import ENOUGH_EVIDENCE

LOOKS_ALIKE = 0.008
"""Share of views that fit another place as well, so that three that agree are enough: of floors of
different places 6 of 400 did, all where drift cannot lead."""

OF_VIEW = -math.log(LOOKS_ALIKE)
"""The most that one view says for a place by its look, its floor, or what stands there."""

MOST = 5 * OF_VIEW
"""The most that all say: a building that repeats itself does so at every keyframe."""

HOPELESS = ENOUGH_EVIDENCE - MOST
"""What views cannot make up for."""

REASONS = {
    'look': 'looks like chance',
    'ground': 'floor like others',
    'around': 'other things around',
    'sides': 'not seen from the other side',
    'free': 'free space through obstacles',
    'rivals': 'as much for another place',
    'travel': 'more than drift',
    'level': 'another floor',
}
"""What is noted where a term speaks most against a place."""


@dataclass(frozen=True)
class PlaceEvidence:
    """What one view says for a place, and what was known before, in nats.

    look: points, found where they should be. ground: the floor from above. around: what stands
    there, against the same some decimetres beside. sides: the keyframe's own points in the view of
    the place. free: space that one side sees through. rivals: other places that the view fits.
    travel: how the robot can have come there. level: whether it stands there as it did.
    """

    look: float = 0.0
    ground: float = 0.0
    around: float = 0.0
    sides: float = 0.0
    free: float = 0.0
    rivals: float = 0.0
    travel: float = 0.0
    level: float = 0.0

    @property
    def seen(self) -> float:
        """What counts for each view."""
        shows = sum(unlike_others(cue) for cue in (self.look, self.ground, self.around))
        return shows + min(self.sides, 0.0) + min(self.free, 0.0) + self.rivals

    @property
    def prior(self) -> float:
        """What counts once."""
        return self.travel + self.level

    @property
    def objection(self) -> str:
        """The reason why the view cannot count, '' for none."""
        if self.seen > 0 and self.prior >= HOPELESS:
            return ''
        return REASONS[min(REASONS, key=lambda term: float(getattr(self, term)))]


def is_enough(views: Sequence[PlaceEvidence], new: Sequence[float]) -> bool:
    """Whether views that agree, the latest last, are enough for a place. new: how far each differs
    from those before, 1 where it is a new view.
    """
    seen = sum(min(share, 1.0) * view.seen for view, share in zip(views, new, strict=True))
    return min(seen, MOST) + views[-1].prior >= ENOUGH_EVIDENCE


def unlike_others(log_ratio: float) -> float:
    """Return what is left of a ratio over chance where some of all views fit another place, and as
    many of the right one do not.
    """
    ratio = math.exp(max(-700.0, min(log_ratio, 700.0)))
    right, other = 1.0 - LOOKS_ALIKE, LOOKS_ALIKE
    return math.log((right * ratio + other) / (other * ratio + right))


def of_counts(here: float, elsewhere: float) -> float:
    """Return how much likelier counts are than if both had the same mean (Poisson; Wilks 1938),
    negative where there are more elsewhere.
    """
    mean = max(0.5 * (here + elsewhere), 1e-9)
    nats = sum(count * math.log(max(count, 1e-9) / mean) for count in (here, elsewhere))
    return math.copysign(nats, here - elsewhere)


def of_errors(*errors: tuple[float, float]) -> float:
    """Return how likely errors are, each with its sigma, against none."""
    return -0.5 * float(sum((error / sigma) ** 2 for error, sigma in errors))
