"""What is known of light that was found, in sentences."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from svu_mi.capture import Capture
from svu_mi.illumination.found_gains import FoundGains
from svu_mi.illumination.likeness import Likeness, brightest
from svu_mi.illumination.record import LightEstimate
from svu_mi.parameters import CHANNELS

UP = (0.0, 1.0, 0.0)
NOTED = 0.08  # of the logarithms of gains: twice what they are off by, if there are few photographs
FEWEST = 3  # photographs in each quarter that drift is told by
OF_MEDIAN = 1.25 * 1.48  # standard error of a median, by the median deviation of one value
CERTAIN = 4.5  # standard errors from which photographs drift
LETTERS = "RGB"[: CHANNELS["base_color"]]


def sentences(estimate: LightEstimate, up: np.ndarray | None = None) -> Iterator[str]:
    """Yield what there is to say, one sentence at a time.

    Args:
        estimate: what was found.
        up: (3,) unit, what elevations count from; +Y by default.
    """
    yield f"Of the light from all directions, photographs tell {100 * estimate.known_part:.0f} %."
    yield direction_sentence(estimate, np.array(UP) if up is None else up)
    yield scale_sentence(estimate)
    if estimate.moves:
        yield "It turns with the camera: a turntable, or a lamp on the camera."
    yield from estimate.remarks


def direction_sentence(estimate: LightEstimate, up: np.ndarray) -> str:
    """Say where the light is brightest."""
    found = brightest(estimate)
    if found is None:
        return "It comes from all around: no direction stands out."
    if estimate.moves:
        return f"It is brightest from {_vector(found)} in camera space (+X left, +Y up, +Z ahead)."
    elevation = np.degrees(np.arcsin(np.clip(found @ up, -1, 1)))
    # Azimuth counts as maps of Mitsuba's envmap do: from -Z towards +X, if +Y is up.
    ahead, right = _horizon(up)
    azimuth = np.degrees(np.arctan2(found @ right, found @ ahead)) % 360
    return (
        f"It is brightest from elevation {elevation:.0f} and azimuth {azimuth:.0f} degrees "
        f"({_vector(found)} in the world)."
    )


def scale_sentence(estimate: LightEstimate) -> str:
    """Say how far base colour is known but for one factor."""
    low, high = estimate.scale_interval
    if not estimate.scale_sd.any():
        return "Its brightness was given, so base colours are in true units."
    return (
        f"Base colours are known up to a common factor between {low.mean():.2f} and "
        f"{high.mean():.2f}; --grey-card or --mean-albedo of svu light fix it."
    )


def gain_sentences(gains: FoundGains, capture: Capture) -> Iterator[str]:
    """Yield what gains photographs have, and which of them do not fit the others."""
    names = [name for name, used in zip(capture.names, capture.used, strict=True) if used]
    factor = gains.factor[~gains.odd]
    if len(factor):
        low, high = factor.mean(axis=1).min(), factor.mean(axis=1).max()
        yield f"Photographs are {low:.2f} to {high:.2f} times as bright as if all were alike."
        yield from _balance(gains)
    usual = float(np.median(gains.noise[gains.noise > 0])) if gains.noise.any() else 1.0
    for view in np.flatnonzero(gains.odd):
        brighter, unlike = gains.factor[view].mean(), gains.noise[view] / usual
        yield (
            f"{names[view]} does not fit the others ({brighter:.2g} times as bright, "
            f"{unlike:.1f} times as far from what they explain); left out."
        )


def _balance(gains: FoundGains) -> Iterator[str]:
    """Say how white balance differs, and how gains drift from the first photographs to the last,
    if that is more than gains are known to."""
    logarithm = gains.logarithm[~gains.odd]
    if not len(logarithm):
        return
    grey = logarithm.mean(axis=1, keepdims=True)
    if (logarithm - grey).std(axis=0).max(initial=0) > NOTED / 2:
        factors = np.exp(logarithm - grey)
        each = (f"{letter} {factors[:, c].min():.2f} to {factors[:, c].max():.2f}"
                for c, letter in enumerate(LETTERS))  # fmt: skip
        yield f"White balance differs, relative to grey: {', '.join(each)}."
    part = len(logarithm) // 4
    if part < FEWEST:
        return
    ends = logarithm[:part], logarithm[-part:]
    first, last = (np.median(some, axis=0) for some in ends)
    away = [np.abs(some - middle) for some, middle in zip(ends, (first, last), strict=True)]
    # Of the difference of two medians, by the median of what photographs are away from theirs.
    error = OF_MEDIAN * np.median(np.concatenate(away), axis=0) * np.sqrt(2 / part)
    if (np.abs(last - first) > np.maximum(NOTED, CERTAIN * error)).any():
        changes = np.exp(last - first)
        each = (f"{letter} {x:.2f}" for letter, x in zip(LETTERS, changes, strict=True))
        yield (
            "They drift: from the first quarter of the photographs to the last, gains change by "
            f"{', '.join(each)}."
        )


def likeness_sentence(found: Likeness) -> str:
    """Say how like the light is to the one that the capture has."""
    factors = ", ".join(
        f"{value:.2f} ({letter})" for letter, value in zip(LETTERS, found.scale, strict=True)
    )
    where = "" if found.inside is None else f", {'in' if found.inside else 'out'}side the interval"
    return (
        f"Against the capture's own light: correlation {found.correlation:.2f} at 15 degrees; that "
        f"one is brighter by {factors}{where}; "
        f"brightest directions {found.angle:.0f} degrees apart."
    )


def _horizon(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions of azimuth 0 and 90 degrees."""
    ahead = np.array([0.0, 0.0, -1.0]) if abs(up[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return ahead, np.cross(ahead, up)


def _vector(direction: np.ndarray) -> str:
    return ", ".join(f"{value:.2f}" for value in direction)
