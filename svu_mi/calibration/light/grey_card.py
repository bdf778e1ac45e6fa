"""Scale of estimated light from a known base colour: of a grey card, or the mean.

Photographs hardly determine a common factor of light and one over base colour, so the light is
scaled until the estimate has the known base colour.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from svu_mi.calibration.light.light_estimate import LightEstimate
from svu_mi.calibration.light.resolve_light import with_light
from svu_mi.errors import CaptureError, OptionError
from svu_mi.geometry.neighbors import texel_squares
from svu_mi.parameters import MIXED
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import Observed

SMALLEST, LARGEST = 0.01, 1.0  # base colours
MOST_ROUNDS, DONE = 6, 0.02  # base colour is not quite proportional: gloss is beside it
FARTHEST = 3.0  # factor of one round: base colour is clipped at 1
NEAR = 12  # texels around the spot
SHARPEST = 0.02  # standard deviation that one of them is known to, at best

Brightness = Callable[[Estimate], np.ndarray]  # factor (3,) by which base colours are too bright


def require_albedo(value: float, option: str) -> None:
    """Refuse a base colour outside (0, 1] by an OptionError."""
    if not SMALLEST <= value <= LARGEST:
        raise OptionError(
            f"{option}: a base colour must be in [{SMALLEST}, {LARGEST:g}], got {value:g}."
        )


def scaled_by_mean(light: LightEstimate, observed: Observed, albedo: float) -> LightEstimate:
    """Scale light until the mean base colour has a given value: one factor for all channels.

    The mean is over the visible surface, by area, and over R, G and B, at the texels of
    ``observed``.
    """
    require_albedo(albedo, "The mean base colour")
    seen = observed.coverage > 0
    area = np.square(np.array(observed.texels.footprint, np.float64)) * seen

    def excess(result: Estimate) -> np.ndarray:
        mean = np.average(_base_color(result, "mean").mean(axis=1), weights=area)
        return np.full(3, mean / albedo)

    return _scaled(light, observed, excess)


def scaled_by_card(
    light: LightEstimate, observed: Observed, uv: tuple[float, float], albedo: float
) -> LightEstimate:
    """Scale light until a grey spot has a given base colour: a factor per channel.

    Args:
        light: light of the right shape.
        observed: the photographs, at texels that resolve the spot.
        uv: its texture coordinates.
        albedo: base colour of R, G and B there; the card is taken as not metallic.
    """
    require_albedo(albedo, "The grey card")
    chosen = _texels_at(observed, uv)

    def excess(result: Estimate) -> np.ndarray:
        mean, sd = (_base_color(result, what)[chosen] for what in ("mean", "sd"))
        weight = 1 / np.maximum(sd, SHARPEST) ** 2
        return np.asarray((weight * mean).sum(axis=0) / weight.sum(axis=0) / albedo)

    return _scaled(light, observed, excess, dict.fromkeys(MIXED, 0.0))


def _texels_at(observed: Observed, uv: tuple[float, float]) -> np.ndarray:
    """Return the visible texels next to texture coordinates."""
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
            f"{uv[1]:g}; give those of a spot that is seen."
        )
    return np.asarray(near)


def _scaled(
    light: LightEstimate, observed: Observed, excess: Brightness,
    known: Mapping[str, float] | None = None,
) -> LightEstimate:  # fmt: skip
    """Scale light until the base colours are as wanted, to ``DONE``."""
    if light.moves:
        raise CaptureError(
            "The light turns with the camera, so base colours cannot be found under it; give its "
            "brightness with --light-scale."
        )
    total = np.ones(3)
    for _ in range(MOST_ROUNDS):
        lit = light.scaled(total)
        capture = replace(with_light(observed.capture, lit), light_uncertainty=None)
        # Rays to the cameras are the same ones; those to the light's cells are not.
        seen = Observed(
            capture=capture, views=observed.views, texels=observed.texels,
            visibility=observed.visibility, seen=observed.seen,
        )  # fmt: skip
        factor = np.clip(excess(estimate(seen, known=known)), 1 / FARTHEST, FARTHEST)
        total = total * factor
        if np.abs(np.log(factor)).max() < DONE:
            return light.scaled(total)
    if np.abs(np.log(factor)).max() > 10 * DONE:
        raise CaptureError(
            "No brightness of the light makes the base colour what was given; check the value, and "
            "that nothing else is measured there."
        )
    return light.scaled(total)


def _base_color(result: Estimate, what: str) -> np.ndarray:
    """Return posterior means, or standard deviations, of base colour (T, 3)."""
    values = np.array(getattr(result.posterior, what)("base_color"), np.float64)
    return np.broadcast_to(values.reshape(len(values), -1), (len(values), 3))
