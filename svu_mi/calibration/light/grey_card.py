"""Scale of estimated light from a known base colour: of a grey card, or the mean.

Photographs hardly distinguish brighter light from brighter base colour. The light is therefore
scaled until the estimated base colour has the known value.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from svu_mi.calibration.light.light_estimate import LightEstimate
from svu_mi.calibration.light.resolve_light import with_light
from svu_mi.capture.capture import LightUncertainty
from svu_mi.errors import CaptureError, OptionError
from svu_mi.geometry.neighbors import texel_squares
from svu_mi.parameters import MIXED
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import Observed

SMALLEST, LARGEST = 0.01, 1.0  # range of base colours
MOST_ROUNDS, DONE = 6, 0.02  # iterations, since base colour is not quite proportional
FARTHEST = 3.0  # maximum factor per iteration, as base colour is clipped at 1
NEAR = 12  # number of texels around the spot
SHARPEST = 0.02  # minimum standard deviation of a texel

Brightness = Callable[[Estimate], np.ndarray]  # ratio (3,) of estimated to known base colour


def require_albedo(value: float, option: str) -> None:
    """Raise ``OptionError`` for a base colour outside (0, 1]."""
    if not SMALLEST <= value <= LARGEST:
        raise OptionError(
            f"{option}: a base colour must be in [{SMALLEST}, {LARGEST:g}], got {value:g}."
        )


def scaled_by_mean(light: LightEstimate, observed: Observed, albedo: float) -> LightEstimate:
    """Scale light by one factor until the mean base colour has a given value.

    The mean is over the area of the seen surface and over R, G and B, at the texels of
    ``observed``.
    """
    require_albedo(albedo, "The mean base colour")
    seen = observed.coverage > 0
    area = np.square(np.array(observed.texels.footprint, np.float64)) * seen

    def excess(result: Estimate) -> np.ndarray:
        mean = np.average(_base_color(result, "mean").mean(axis=1), weights=area)
        return np.asarray(mean / albedo)

    return _scaled(light, observed, excess)[0]


def scaled_by_card(
    light: LightEstimate, observed: Observed, uv: tuple[float, float], albedo: float
) -> LightEstimate:
    """Scale light per channel until a grey spot has a given base colour.

    The scale stays as uncertain as the spot: its texels share views and light, so that their
    errors do not average out, and they differ at an edge.

    Args:
        light: Estimated light.
        observed: Photographs, at texels that resolve the spot.
        uv: Texture coordinates of the spot.
        albedo: Base colour of the spot, which is assumed to be grey and not metallic.
    """
    require_albedo(albedo, "The grey card")
    chosen = texels_at(observed, uv)

    def excess(result: Estimate) -> np.ndarray:
        return _spot(result, chosen)[0] / albedo

    scaled, result = _scaled(light, observed, excess, dict.fromkeys(MIXED, 0.0))
    mean, sd = _spot(result, chosen)
    return replace(scaled, scale_sd=sd / mean, tint_sd=sd / mean)


def _spot(result: Estimate, chosen: np.ndarray) -> np.ndarray:
    """Return mean and standard deviation (2, 3) of the base colour of some texels."""
    mean, sd = (_base_color(result, what)[chosen] for what in ("mean", "sd"))
    weight = 1 / np.maximum(sd, SHARPEST) ** 2
    center = np.average(mean, axis=0, weights=weight)
    variance = np.average(sd**2 + (mean - center) ** 2, axis=0, weights=weight)
    return np.stack([center, np.sqrt(variance)])


def texels_at(observed: Observed, uv: tuple[float, float]) -> np.ndarray:
    """Return the seen texels near texture coordinates."""
    if not all(0 <= value <= 1 for value in uv):
        raise OptionError(f"The grey card: texture coordinates are in [0, 1], got {uv}.")
    layout = observed.texels
    width, height = layout.resolution
    row, column = texel_squares(layout).T
    distance = np.hypot(column + 0.5 - uv[0] * width, row + 0.5 - uv[1] * height)
    near = np.argsort(distance, kind="stable")[:NEAR]
    near = near[(distance[near] <= np.sqrt(NEAR)) & (observed.coverage[near] > 0)]
    if not len(near):
        raise CaptureError(
            f"The grey card: no photograph shows the surface at texture coordinates {uv[0]:g} "
            f"{uv[1]:g}; give the coordinates of a seen spot."
        )
    return np.asarray(near)


def _scaled(
    light: LightEstimate, observed: Observed, excess: Brightness,
    known: Mapping[str, float] | None = None,
) -> tuple[LightEstimate, Estimate]:  # fmt: skip
    """Scale light until ``excess`` of the estimate is 1, with tolerance ``DONE``.

    Returns the light and the last estimate.
    """
    if light.moves:
        raise CaptureError(
            "Base colours cannot be estimated under light that moves with the camera; set its "
            "brightness with --light-scale."
        )
    total = np.ones(())
    for _ in range(MOST_ROUNDS):
        lit = light.scaled(total)
        # The light's details stay uncertain, its scale is what is looked for.
        uncertainty = LightUncertainty(light.widening)
        capture = replace(with_light(observed.capture, lit), light_uncertainty=uncertainty)
        # Reuse rays to the cameras; rays to cells of the light differ.
        seen = Observed(
            capture=capture, views=observed.views, texels=observed.texels,
            visibility=observed.visibility, seen=observed.seen,
        )  # fmt: skip
        result = estimate(seen, known=known)
        factor = np.clip(excess(result), 1 / FARTHEST, FARTHEST)
        total = total * factor
        if np.abs(np.log(factor)).max() < DONE:
            break
    if np.abs(np.log(factor)).max() > 10 * DONE:
        raise CaptureError(
            "No brightness of the light gives this base colour; check the value and the texture "
            "coordinates, or take a spot of lower entropy."
        )
    return light.scaled(total), result


def _base_color(result: Estimate, what: str) -> np.ndarray:
    """Return posterior means or standard deviations of base colour, (T, 3)."""
    values = np.array(getattr(result.posterior, what)("base_color"), np.float64)
    return np.broadcast_to(values.reshape(len(values), -1), (len(values), 3))
