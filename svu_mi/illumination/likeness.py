"""Light as it looks from afar: blurred, where it is brightest, and how like another one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.illumination.record import LightEstimate
from svu_mi.light.cells import fibonacci
from svu_mi.light.environment import (
    Environment,
    basis_at,
    polar_from_local,
    read_environment,
)
from svu_mi.light.lighting import degrees

BLUR = 15.0  # degrees, full width at half maximum, at which light is compared
DEGREE = 48  # beyond which that leaves nothing
POINTS = 2048  # even directions
STANDS_OUT = 2.0  # times the mean, from which a direction is called bright


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """How like light that was found is to the one that a capture has.

    Attributes:
        correlation: of both, blurred to 15 degrees, over all directions.
        scale: (3,) factor per channel, by which the true light is brighter.
        inside: whether that factor is in the 90 % interval of the estimate, in all channels;
            None where the scale was given.
        angle: degrees between the directions that both are brightest in.
    """

    correlation: float
    scale: np.ndarray
    inside: bool | None
    angle: float


def blurred(environment: Environment, world: np.ndarray, width: float = BLUR) -> np.ndarray:
    """Return the radiance (N, 3) from unit directions (N, 3), blurred.

    Args:
        environment: the light.
        world: where from.
        width: of the blur, at half its maximum, in degrees.
    """
    sd = np.radians(width) / np.sqrt(8 * np.log(2))
    degree = degrees(DEGREE)
    smooth = np.exp(-degree * (degree + 1) * sd**2 / 2)
    polar = polar_from_local(world @ environment.to_local.T)
    found = basis_at(polar, DEGREE) @ (environment.coefficients(DEGREE) * smooth[:, None])
    return np.asarray(np.maximum(found, 0))


def environment_of(estimate: LightEstimate) -> Environment:
    """Return light that was found as an environment."""
    none = np.zeros((0, 3))
    radiance = estimate.radiance.astype(np.float64)
    return Environment(radiance, none, np.zeros(0), none, to_local=np.eye(3))


def brightest(estimate: LightEstimate) -> np.ndarray | None:
    """Return the unit direction (3,) that most light comes from; None if none stands out."""
    world = fibonacci(POINTS)
    grey = blurred(environment_of(estimate), world).mean(axis=1)
    if grey.max() < STANDS_OUT * grey.mean():
        return None
    return np.asarray(world[int(np.argmax(grey))])


def likeness(estimate: LightEstimate, emitter: Any) -> Likeness:
    """Compare light that was found with the light that a capture has.

    Args:
        estimate: what was found.
        emitter: the capture's ``environment``.

    Raises:
        SceneError: as ``read_environment``.
    """
    world = fibonacci(POINTS)
    truth, found = (blurred(one, world)
                    for one in (read_environment(emitter), environment_of(estimate)))  # fmt: skip
    scale = truth.mean(axis=0) / np.maximum(found.mean(axis=0), 1e-30)
    low, high = estimate.scale_interval
    grey = truth.mean(axis=1), found.mean(axis=1)
    flat = min(float(np.ptp(one) / one.mean()) for one in grey) < 1e-6
    first, second = (world[int(np.argmax(one))] for one in grey)
    return Likeness(
        correlation=0.0 if flat else float(np.corrcoef(*grey)[0, 1]), scale=scale,
        inside=bool(((low <= scale) & (scale <= high)).all()) if estimate.scale_sd.any() else None,
        angle=float(np.degrees(np.arccos(np.clip(first @ second, -1, 1)))),
    )  # fmt: skip
