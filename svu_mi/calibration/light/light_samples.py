"""Samples of selected texels in all photographs, for estimates of light and gains."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.load_warnings import FEWEST_FOR_LIGHT
from svu_mi.capture.scene import to_world
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import CaptureError
from svu_mi.geometry.sample_view import TexelLanes, sample_visible
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.posterior.observations import Observed
from svu_mi.presets import AngularPreset
from svu_mi.statistics.statistics import noise_weight

GRAZING = 1e-3  # minimum cosine; smaller values are clamped
OF_SAMPLES = ("view", "direction", "cosine", "radiance", "contrast", "weight")
FACING = 0.4  # minimum cosine: pixels of steeper views also cover neighbours


@dataclass(frozen=True)
class TexelSamples:
    """S samples of n texels in V views, sorted by texel.

    Attributes:
        scene: Scene for visibility rays.
        surface: The n texels.
        owner, view: (S,) int64 indices of texel (ascending) and view.
        direction: (S, 3) float32 unit directions to the camera, in world space.
        cosine: (S,) float32 cosines between ``direction`` and the shading normal.
        radiance, contrast: (S, 3) and (S,) float32 mean and variance of the pixels.
        weight: (S,) float64 weights (``noise_weight``).
        cameras: (V, 3, 3) float64 rotations from camera to world space.
        unit: Radiance that noise is relative to.
        kappa, edges: Parameters of the weights.
        grid: Grid of the materials, with known parameters.
    """

    scene: Any
    surface: TexelLanes
    owner: np.ndarray
    view: np.ndarray
    direction: np.ndarray
    cosine: np.ndarray
    radiance: np.ndarray
    contrast: np.ndarray
    weight: np.ndarray
    cameras: np.ndarray
    unit: float
    kappa: float
    edges: float
    grid: PrincipledGrid

    @property
    def count(self) -> int:
        """Number of samples, S."""
        return len(self.owner)

    @property
    def texels(self) -> int:
        """Number of texels, n."""
        return self.surface.count

    @property
    def first(self) -> np.ndarray:
        """(n,) index of the first sample of each texel."""
        return np.searchsorted(self.owner, np.arange(self.texels))

    def blocks(self, size: int) -> Iterator[tuple[slice, slice]]:
        """Yield slices of texels, and of their samples: about ``size`` samples each."""
        ends = np.append(self.first, self.count)
        step = max(size * self.texels // self.count, 1)
        for begin in range(0, self.texels, step):
            end = min(begin + step, self.texels)
            yield slice(begin, end), slice(int(ends[begin]), int(ends[end]))

    def sum(self, values: np.ndarray) -> np.ndarray:
        """Sum values (S, ...) over the samples of each texel; return (n, ...)."""
        return np.add.reduceat(values, self.first, axis=0)

    def without_steep_views(self) -> tuple[TexelSamples, np.ndarray]:
        """Drop steep views and rarely seen texels; return the kept samples and their indices."""
        kept = self.cosine > FACING
        enough = np.bincount(self.owner[kept], minlength=self.texels) >= FEWEST_FOR_LIGHT
        if not enough.any():
            return self, np.arange(self.count)
        chosen = np.flatnonzero(kept & enough[self.owner])
        return self.at(chosen), chosen

    def thinned(self, texels: int) -> TexelSamples:
        """Return the samples of at least ``texels`` texels, evenly distributed, or of all."""
        step = self.texels // texels
        return self if step <= 1 else self.at(np.flatnonzero(self.owner % step == 0))

    def at(self, chosen: np.ndarray) -> TexelSamples:
        """Return the samples with ascending indices ``chosen``, and their texels."""
        texels, owner = np.unique(self.owner[chosen], return_inverse=True)
        return replace(
            self,
            surface=self.surface.at(to_drjit(mi.UInt32, texels.astype(np.uint32))),
            owner=owner,
            **{name: getattr(self, name)[chosen] for name in OF_SAMPLES},
        )

    def divided(self, gains: np.ndarray) -> TexelSamples:
        """Return the samples divided by gains (V, 3) of their photographs."""
        of_sample = gains[self.view]
        radiance = (self.radiance / of_sample).astype(np.float32)
        contrast = self.contrast / np.square(of_sample.mean(axis=1))
        weight = noise_weight(radiance.mean(axis=1), self.kappa, contrast, self.edges)
        left = self.weight > 0
        return replace(
            self, radiance=radiance, contrast=contrast, weight=left * weight.astype(np.float64)
        )

    @staticmethod
    def of(
        observed: Observed, switches: AngularPreset, count: int, known: Mapping[str, float],
        offset: float = 0.5,
    ) -> TexelSamples:  # fmt: skip
        """Sample at most ``count`` seen texels, evenly distributed over the surface.

        ``offset``: place of the first texel, in [0, 1) steps; others select other texels.
        """
        views, visibility = observed.views, observed.visibility
        if not visibility.scale > 0:
            raise CaptureError(
                "The object is black in all photographs; check their gains and masks with svu "
                "check."
            )
        enough = np.flatnonzero(observed.coverage >= FEWEST_FOR_LIGHT)
        if not len(enough):
            few = views.number < FEWEST_FOR_LIGHT
            remedy = "take more photographs" if few else "run svu check"
            raise CaptureError(
                f"No texel is seen in {FEWEST_FOR_LIGHT} of {views.number} photographs, as many as "
                f"estimates of light and gains need; {remedy}, or give the light and the gains."
            )
        # Texels are ordered by position: equal steps cover the surface evenly.
        count = min(count, len(enough))
        chosen = enough[((np.arange(count) + offset) * len(enough) / count).astype(np.int64)]
        texel = to_drjit(mi.UInt32, chosen.astype(np.uint32))
        lanes = dr.arange(mi.UInt32, count * views.number)
        number = dr.opaque(mi.UInt32, views.number)
        own, view = lanes // number, lanes % number
        launch = TexelLanes.of(observed.texels, dr.gather(mi.UInt32, texel, own))
        seen = sample_visible(views, launch, view, visibility.bits.test(view, launch.index))
        kappa = switches.kappa(observed.unit)
        weight = noise_weight(
            sum(seen.radiance) / 3, dr.opaque(mi.Float, kappa), seen.contrast, switches.edges
        )
        dr.eval(seen.direction, seen.cosine, seen.radiance, seen.contrast, weight)
        kept = np.flatnonzero(seen.seen.numpy())
        sensors = observed.capture.used_sensors
        return TexelSamples(
            scene=views.scene,
            surface=TexelLanes.of(observed.texels, texel),
            owner=kept // views.number,
            view=kept % views.number,
            direction=seen.direction.numpy().T[kept],
            cosine=np.maximum(seen.cosine.numpy()[kept], GRAZING),
            radiance=seen.radiance.numpy().T[kept],
            contrast=seen.contrast.numpy()[kept],
            weight=weight.numpy()[kept].astype(np.float64),
            cameras=np.stack([to_world(sensor)[:3, :3] for sensor in sensors]),
            unit=observed.unit,
            kappa=kappa,
            edges=switches.edges,
            grid=PrincipledGrid(known=known),
        )
