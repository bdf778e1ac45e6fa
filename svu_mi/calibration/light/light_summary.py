"""Summaries of estimated light and gains, and comparison with a known light."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.calibration.light.light_estimate import FoundGains, LightEstimate
from svu_mi.capture.capture import Capture
from svu_mi.core.arrays import fibonacci
from svu_mi.light.band_limited import degrees
from svu_mi.light.environment import Environment, basis_at, polar_from_local, read_environment

BLUR = 15.0  # full width at half maximum of the compared lights, in degrees
BLURRED = f"averaged over {BLUR:g} degrees"
DEGREE = 48  # higher degrees are removed by the blur
POINTS = 2048  # evenly spaced directions
STANDS_OUT = 2.0  # minimum ratio of the brightest direction to the mean
NEAR_AXIS = 0.97  # cosine within which a horizontal direction is called by the name of an axis
NOTED = 0.08  # reported log gain: twice the error with few photographs
FEWEST = 3  # photographs per quarter needed to detect drift
OF_MEDIAN = 1.25 * 1.48  # standard error of a median relative to the median deviation
CERTAIN = 4.5  # significance of a drift in standard errors
LETTERS = "RGB"


@dataclass(frozen=True, kw_only=True)
class LightComparison:
    """Comparison of an estimated light with the light of the capture.

    Attributes:
        correlation: Correlation over all directions, after a blur of 15 degrees.
        scale: (3,) ratio of the known to the estimated light per channel.
        inside: True if ``scale`` is in the 90 % interval in all channels; None if the scale was
            given.
        angle: Angle between the brightest directions in degrees.
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
    """Return the estimated light as an ``Environment``."""
    none = np.zeros((0, 3))
    radiance = estimate.radiance.astype(np.float64)
    return Environment(radiance, none, np.zeros(0), none, to_local=np.eye(3))


def brightest(estimate: LightEstimate) -> np.ndarray | None:
    """Return the brightest unit direction (3,); None if the light is nearly constant."""
    world = fibonacci(POINTS)
    grey = blurred(environment_of(estimate), world).mean(axis=1)
    if grey.max() < STANDS_OUT * grey.mean():
        return None
    return np.asarray(world[int(np.argmax(grey))])


def compare_lights(estimate: LightEstimate, emitter: Any) -> LightComparison:
    """Compare an estimated light with an emitter, such as ``Capture.environment``."""
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


def summary_sentences(estimate: LightEstimate, up: np.ndarray) -> Iterator[str]:
    """Yield sentences about an estimate; ``up``: (3,) zenith (``up_direction`` of the capture)."""
    yield f"The photographs determine {100 * estimate.known_part:.0f} % of the light's variance."
    yield direction_sentence(estimate, up)
    yield scale_sentence(estimate)
    if estimate.moves:
        yield "The light moves with the camera: turntable or flash."
    yield from estimate.remarks


def direction_sentence(estimate: LightEstimate, up: np.ndarray) -> str:
    """Return a sentence about the brightest direction."""
    toward = brightest(estimate)
    if toward is None:
        return "The light is nearly constant: it has no brightest direction."
    if estimate.moves:
        return (
            f"Brightest direction, {BLURRED}: {_vector(toward)} in camera space (+X left, +Y up, "
            "+Z forward)."
        )
    elevation = np.degrees(np.arcsin(np.clip(toward @ up, -1, 1)))
    # Azimuth as in Mitsuba's envmap: from -Z towards +X, if +Y is up.
    ahead, right = horizon(up)
    azimuth = np.degrees(np.arctan2(toward @ right, toward @ ahead)) % 360
    axes = f"0 is {nearest_axis(ahead)}, 90 is {nearest_axis(right)}"
    return (
        f"Brightest direction, {BLURRED}: {_vector(toward)} in world space, elevation "
        f"{elevation:.0f} degrees, azimuth {azimuth:.0f} degrees ({axes})."
    )


def scale_sentence(estimate: LightEstimate) -> str:
    """Return a sentence about the scale of the light."""
    if not estimate.scale_sd.any():
        return "Brightness and colour of the light were given: base colours share their errors."
    is_set = np.array_equal(estimate.scale_sd, estimate.tint_sd)  # by --mean-albedo or --grey-card
    common = "" if is_set else ", and its part common to all channels is removed by --mean-albedo"
    return (
        "Base colours are determined up to a factor per channel, as brightness and colour of the "
        f"light are estimated: {channel_factors(*estimate.scale_interval)} (90 % intervals). It is "
        f"narrowed by a well-seen spot for --grey-card of svu light{common}. Metals may deviate "
        "further."
    )


def channel_factors(lower: np.ndarray, upper: np.ndarray) -> str:
    """Return intervals per channel: "R 0.72 to 1.39, G ..."."""
    ends = zip(LETTERS, lower, upper, strict=True)
    return ", ".join(f"{letter} {low:.2f} to {high:.2f}" for letter, low, high in ends)


def gain_sentences(gains: FoundGains, capture: Capture) -> Iterator[str]:
    """Yield sentences about the gains of photographs, and about outliers."""
    names = [name for name, used in zip(capture.names, capture.used, strict=True) if used]
    kept = np.flatnonzero(~gains.odd)
    if len(kept):
        factor = gains.factor[kept].mean(axis=1)
        low, high = (
            f"{factor[k]:.2f} ({names[kept[k]]})" for k in (factor.argmin(), factor.argmax())
        )
        yield f"Exposure gains range from {low} to {high}."
        yield from _balance(gains)
    usual = float(np.median(gains.noise[gains.noise > 0])) if gains.noise.any() else 1.0
    for view in np.flatnonzero(gains.odd):
        brighter, unlike = gains.factor[view].mean(), gains.noise[view] / usual
        yield (
            f"{names[view]} is an outlier (gain {brighter:.2g}, residual {unlike:.1f} times the "
            "median); excluded."
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
            "Gains drift: from the first to the last quarter of the photographs, they change by "
            f"{', '.join(each)}."
        )


def comparison_sentence(match: LightComparison) -> str:
    """Return a sentence about a comparison of lights."""
    factors = ", ".join(f"{x:.2f} ({c})" for c, x in zip(LETTERS, match.scale, strict=True))
    where = "" if match.inside is None else f", {'in' if match.inside else 'out'}side the interval"
    return (
        f"Comparison with the light of the capture: correlation {match.correlation:.2f} at 15 "
        f"degrees, ratio to the estimate {factors}{where}, "
        f"brightest directions {match.angle:.0f} degrees apart."
    )


def horizon(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions of azimuth 0 and 90 degrees."""
    ahead = np.array([0.0, 0.0, -1.0]) if abs(up[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return ahead, np.cross(ahead, up)


def nearest_axis(direction: np.ndarray) -> str:
    """Return the world axis next to a direction, such as -Z; the direction if none is near."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < NEAR_AXIS:
        return f"({_vector(direction)})"
    return f"{'-' if direction[axis] < 0 else '+'}{'XYZ'[axis]}"


def _vector(direction: np.ndarray) -> str:
    return ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in direction)
