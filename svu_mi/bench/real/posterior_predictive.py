"""Posterior predictive radiance of texels in other views.

The reflection model evaluates draws of a texel's parameters for any camera position.
``svu bench real`` compares the distribution with held-out photographs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError
from svu_mi.geometry.sample_view import TexelLanes, mirror_direction
from svu_mi.light.light_visibility import is_unoccluded
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import Observed
from svu_mi.presets import AngularPreset
from svu_mi.reflection.mix_columns import Parts, interpolate_radiance
from svu_mi.reflection.reflection_model import ReflectionModel
from svu_mi.reflection.roughness_levels import level_shares, roughness_levels
from svu_mi.statistics.gather_statistics import GRAZING, Values, mixing_values

CHANNELS = 3


@dataclass(frozen=True)
class Prediction:
    """Predicted radiance of n texels towards cameras.

    Attributes:
        scene: Scene with the occluders.
        model: Reflection model of the texels at ``roughness_levels``.
        draws: D draws from the posterior: a Float per channel by parameter.
        shares: Spline weights of the R levels for the roughness of each draw: R Floats.
    """

    scene: Any
    model: ReflectionModel
    draws: list[Values]
    shares: list[list[Any]]

    @staticmethod
    def of(estimate: Estimate, texels: np.ndarray, draws: int = 32, seed: int = 0) -> Prediction:
        """Draw the parameters of texels from their posterior.

        Args:
            estimate: Estimate with the angular preset ``default``: estimated noise, a base colour
                per channel.
            texels: (n,) texel indices.
            draws: Number of draws D; more give a smoother distribution.
            seed: Seed of the draws.

        Raises:
            OptionError: an estimate with another noise model, or without colour.
        """
        switches, observed = estimate.switches, estimate.observed
        is_calibrated = isinstance(switches, AngularPreset) and switches.noise == "estimated"
        if not is_calibrated or estimate.posterior.channels != CHANNELS:
            raise OptionError("Predicting photographs needs an angular estimate, preset default.")
        assert observed is not None and isinstance(switches, AngularPreset)
        model = observed.model(roughness_levels(switches.levels), switches, CHANNELS, texels)
        drawn = {name: np.array(values)[:, texels]
                 for name, values in estimate.posterior.draw(draws, seed).items()}  # fmt: skip
        return Prediction(
            observed.views.scene, model,
            [{name: _floats(values[k]) for name, values in drawn.items()} for k in range(draws)],
            [_floats(level_shares(x, switches.levels)) for x in drawn["roughness"]],
        )  # fmt: skip

    def seen_from(self, eye: np.ndarray) -> np.ndarray:
        """Return the radiance towards a camera at ``eye`` (3,): (D, n, 3) float32.

        Texels that face away are treated as grazing; occluders of the camera ray are ignored.
        """
        lobes = columns_seen_from(self.scene, self.model, eye)
        radiance = np.empty((len(self.draws), self.model.surface.count, CHANNELS), np.float32)
        for k, (values, shares) in enumerate(zip(self.draws, self.shares, strict=True)):
            shown = interpolate_radiance(lobes, shares, values["base_color"], mixing_values(values))
            shown = [dr.maximum(x, 0) for x in shown]  # splines overshoot
            dr.eval(shown)
            radiance[k] = np.stack([x.numpy() for x in shown], axis=1)
        return radiance


def diffuse_seen_from(
    observed: Observed, switches: AngularPreset, texels: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function: camera position (3,) -> radiance of white diffuse texels, (n, 3)."""
    model = observed.model(np.ones(1), switches, CHANNELS, texels)

    def seen_from(eye: np.ndarray) -> np.ndarray:
        (level,) = columns_seen_from(observed.views.scene, model, eye)
        return np.stack([level[c % len(level)][0].numpy() for c in range(CHANNELS)], axis=1)

    return seen_from


def columns_seen_from(scene: Any, model: ReflectionModel, eye: np.ndarray) -> list[list[Parts]]:
    """Return the columns of ``ReflectionModel.columns`` for a camera at ``eye`` (3,), evaluated."""
    surface: TexelLanes = model.surface
    point = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in eye))
    direction = mi.Vector3f(dr.normalize(point - surface.position))
    cosine = dr.maximum(dr.dot(surface.normal, direction), GRAZING)
    mirrored = mirror_direction(surface.normal, direction)
    up = dr.dot(surface.geometric_normal, mirrored) > 0
    lobes = model.columns(
        direction, cosine, is_unoccluded(scene, surface, mirrored, up, coherent=True)
    )
    dr.eval(lobes)
    return lobes


def _floats(values: np.ndarray) -> list[Any]:
    """Return the C columns of (n,) or (n, C) as Floats."""
    columns = np.asarray(values, np.float32).reshape(len(values), -1).T
    return [to_drjit(mi.Float, column) for column in columns]
