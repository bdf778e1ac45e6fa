"""Likely cause of held-out photographs that are predicted badly.

The limits were chosen on vase, knot and spheres under window and studio, with one mistake at a
time (``svu bench verdict``); other objects and lights report how often they are right.
"""

from dataclasses import dataclass

from svu_mi.posterior.photograph_patterns import GROUPS, PhotographPatterns
from svu_mi.posterior.reflection_patterns import ReflectionPatterns

GAINS, EQUALIZED, FAIR = 0.14, 0.15, 0.6  # sd of log gains, their effect, R^2 after them
TURNING, TURNED = 0.2, 0.1  # clear and likely effect of a light that turns
BELOW, BENEATH = 0.25, 0.2  # clear and likely correlation with directions that point down
BLURRED = 0.6  # shifts of this effect look like a turning light
STATIC, CONSISTENT = 0.2, 0.5  # part explained by a static light; R^2 of means
ALIKE, FAR = 0.2, 1.8  # R^2 of means, and errors of the model relative to theirs
DISPLACED, SHIFTED, FOREIGN = 0.25, 0.1, 0.4  # part explained by shifts; R^2 after them


@dataclass(frozen=True)
class ResidualPatterns(ReflectionPatterns, PhotographPatterns):
    """All patterns of residuals."""


def clear_cause(patterns: ResidualPatterns) -> str:
    """Return a key of ``prediction.CAUSES`` with a pattern that sound captures lack, or ""."""
    spread, part = patterns.gain
    shift = patterns.shift[0]
    if spread > GAINS and part > max(EQUALIZED, shift) and 1 - patterns.error * (1 - part) > FAIR:
        return "gains"
    if patterns.groups > max(GROUPS, patterns.error * shift):
        return "objects"
    if patterns.moving_light > max(TURNING, BLURRED * shift):
        return "turning light"
    if _is_changed_from_below(patterns, BELOW):
        return "surroundings"
    return "poses" if shift > DISPLACED else ""


def likely_cause(patterns: ResidualPatterns) -> str:
    """Return the likely cause of a bad prediction; "" if no pattern fits."""
    clear, shift, static = clear_cause(patterns), patterns.shift[0], patterns.static_light
    error, of_means = patterns.error, patterns.error_of_means
    if clear not in ("", "poses"):
        return clear
    if patterns.moving_light > max(TURNED, BLURRED * shift):
        return "turning light"
    if _is_changed_from_below(patterns, BENEATH):
        return "surroundings"
    if of_means < 1 - ALIKE and error > FAR * of_means:
        return "light"
    if of_means < 1 - CONSISTENT and static > max(STATIC, shift):
        return "light"
    if 1 - error * (1 - shift) < FOREIGN:
        return "mesh"
    return "poses" if shift > SHIFTED else ""


def _is_changed_from_below(patterns: ResidualPatterns, least: float) -> bool:
    """Return whether light from below explains errors; a table leaves some of it right."""
    explained = patterns.from_below > least and patterns.error < 1
    return explained and patterns.around.from_above
