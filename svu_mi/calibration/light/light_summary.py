"""Summaries of estimated light and gains: sentences, and a comparison with a known light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.calibration.light.light_estimate import FoundGains, LightEstimate
from svu_mi.capture.capture import Capture
from svu_mi.core.arrays import fibonacci
from svu_mi.light.band_limited import degrees
from svu_mi.light.environment import Environment, basis_at, polar_from_local, read_environment

BLUR = 15.0  # degrees, full width at half maximum, at which light is compared
DEGREE = 48  # beyond which that leaves nothing
POINTS = 2048  # even directions
STANDS_OUT = 2.0  # times the mean, from which a direction is called bright
UP = np.array([0.0, 1.0, 0.0])
NOTED = 0.08  # log gain: twice the error with few photographs
FEWEST = 3  # photographs in each quarter, to detect drift
OF_MEDIAN = 1.25 * 1.48  # standard error of a median, by the median deviation of one value
CERTAIN = 4.5  # standard errors of a drift
LETTERS = "RGB"


@dataclass(frozen=True, kw_only=True)
class LightComparison:
    """Comparison of estimated light with the light that a capture has.

    Attributes:
        correlation: of both, blurred to 15 degrees, over all directions.
        scale: (3,) factor per channel, by which the true light is brighter.
        inside: whether that factor is in the 90 % interval of the estimate, in all channels;
            None where the scale was given.
        angle: degrees between their brightest directions.
    """

    correlation: float
    scale: np.ndarray
    inside: bool | None
    angle: float


def blurred(environment: Environment, world: np.ndarray, width: float = BLUR) -> np.ndarray:
    """Return the radiance (N, 3) from unit directions (N, 3), blurred to ``width`` degrees."""
    sd = np.radians(width) / np.sqrt(8 * np.log(2))
    degree = degrees(DEGREE)
    smooth = np.exp(-degree * (degree + 1) * sd**2 / 2)
    polar = polar_from_local(world @ environment.to_local.T)
    radiance = basis_at(polar, DEGREE) @ (environment.coefficients(DEGREE) * smooth[:, None])
    return np.asarray(np.maximum(radiance, 0))


def environment_of(estimate: LightEstimate) -> Environment:
    """Return an estimate as an environment."""
    none = np.zeros((0, 3))
    radiance = estimate.radiance.astype(np.float64)
    return Environment(radiance, none, np.zeros(0), none, to_local=np.eye(3))


def brightest(estimate: LightEstimate) -> np.ndarray | None:
    """Return the brightest unit direction (3,); None if none stands out."""
    world = fibonacci(POINTS)
    grey = blurred(environment_of(estimate), world).mean(axis=1)
    if grey.max() < STANDS_OUT * grey.mean():
        return None
    return np.asarray(world[int(np.argmax(grey))])


def compare_lights(estimate: LightEstimate, emitter: Any) -> LightComparison:
    """Compare an estimate with the ``environment`` of a capture."""
    world = fibonacci(POINTS)
    truth = blurred(read_environment(emitter), world)
    estimated = blurred(environment_of(estimate), world)
    scale = truth.mean(axis=0) / np.maximum(estimated.mean(axis=0), 1e-30)
    low, high = estimate.scale_interval
    grey = truth.mean(axis=1), estimated.mean(axis=1)
    flat = min(float(np.ptp(one) / one.mean()) for one in grey) < 1e-6
    first, second = (world[int(np.argmax(one))] for one in grey)
    return LightComparison(
        correlation=0.0 if flat else float(np.corrcoef(*grey)[0, 1]), scale=scale,
        inside=bool(((low <= scale) & (scale <= high)).all()) if estimate.scale_sd.any() else None,
        angle=float(np.degrees(np.arccos(np.clip(first @ second, -1, 1)))),
    )  # fmt: skip


def summary_sentences(estimate: LightEstimate, up: np.ndarray | None = None) -> Iterator[str]:
    """Yield sentences about an estimate; elevations count from ``up`` (3,), +Y by default."""
    yield f"Of the light from all directions, photographs tell {100 * estimate.known_part:.0f} %."
    yield direction_sentence(estimate, UP if up is None else up)
    yield scale_sentence(estimate)
    if estimate.moves:
        yield "It turns with the camera: a turntable, or a lamp on the camera."
    yield from estimate.remarks


def direction_sentence(estimate: LightEstimate, up: np.ndarray) -> str:
    """Return a sentence about the brightest direction."""
    toward = brightest(estimate)
    if toward is None:
        return "It comes from all around: no direction stands out."
    if estimate.moves:
        return f"It is brightest from {_vector(toward)} in camera space (+X left, +Y up, +Z ahead)."
    elevation = np.degrees(np.arcsin(np.clip(toward @ up, -1, 1)))
    # Azimuth counts as maps of Mitsuba's envmap do: from -Z towards +X, if +Y is up.
    ahead, right = _horizon(up)
    azimuth = np.degrees(np.arctan2(toward @ right, toward @ ahead)) % 360
    return (
        f"It is brightest from elevation {elevation:.0f} and azimuth {azimuth:.0f} degrees "
        f"({_vector(toward)} in the world)."
    )


def scale_sentence(estimate: LightEstimate) -> str:
    """Return a sentence about the scale of the light."""
    low, high = estimate.scale_interval
    if not estimate.scale_sd.any():
        return "Its brightness was given, so base colours are in true units."
    return (
        f"Base colours are known up to a common factor between {low.mean():.2f} and "
        f"{high.mean():.2f}; --grey-card or --mean-albedo of svu light fix it."
    )


def gain_sentences(gains: FoundGains, capture: Capture) -> Iterator[str]:
    """Yield sentences about the gains of photographs, and about outliers."""
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
    """Yield sentences about significant differences of white balance and drift of gains."""
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
    # Standard error of the difference of two medians, by the median absolute deviation.
    error = OF_MEDIAN * np.median(np.concatenate(away), axis=0) * np.sqrt(2 / part)
    if (np.abs(last - first) > np.maximum(NOTED, CERTAIN * error)).any():
        changes = np.exp(last - first)
        each = (f"{letter} {x:.2f}" for letter, x in zip(LETTERS, changes, strict=True))
        yield (
            "They drift: from the first quarter of the photographs to the last, gains change by "
            f"{', '.join(each)}."
        )


def comparison_sentence(match: LightComparison) -> str:
    """Return a sentence that compares the light with the capture's own."""
    factors = ", ".join(f"{x:.2f} ({c})" for c, x in zip(LETTERS, match.scale, strict=True))
    where = "" if match.inside is None else f", {'in' if match.inside else 'out'}side the interval"
    return (
        f"Against the capture's own light: correlation {match.correlation:.2f} at 15 degrees; "
        f"that one is brighter by {factors}{where}; "
        f"brightest directions {match.angle:.0f} degrees apart."
    )


def _horizon(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions of azimuth 0 and 90 degrees."""
    ahead = np.array([0.0, 0.0, -1.0]) if abs(up[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return ahead, np.cross(ahead, up)


def _vector(direction: np.ndarray) -> str:
    return ", ".join(f"{value:.2f}" for value in direction)
