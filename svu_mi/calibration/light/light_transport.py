"""Radiance of samples under cells of light, and the posterior of their materials.

Radiance is linear in the light: r = sum_j K_j L_j over N cells of equal size, with K from the
reflection model (``reflection/wide_lobes.py``, ``mix_columns.py``) and traced visibility. Lobes
narrower than the cells are widened to their size, so that they do not miss light.
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.calibration.light.light_samples import GRAZING, TexelSamples
from svu_mi.core.arrays import fibonacci, fold, to_drjit
from svu_mi.light.light_visibility import is_unoccluded
from svu_mi.parameters import MIXED
from svu_mi.posterior.calibrated import CalibratedKernel, calibrated_posterior
from svu_mi.posterior.calibrated_fit import noise_of_parts
from svu_mi.posterior.posterior import Posterior
from svu_mi.presets import AngularPreset
from svu_mi.reflection.lobes import dielectric_fresnel, disk_ggx, smith_g1
from svu_mi.reflection.mix_columns import diffuse_shading, dot
from svu_mi.reflection.principled import Mixture, alpha_from_roughness, columns, mixture
from svu_mi.reflection.roughness_levels import roughness_levels
from svu_mi.statistics.cholesky_factors import PAIRS
from svu_mi.statistics.statistics import Statistics

WIDENED = 0.55  # widening of lobes in cell radii, added in quadrature
PARTS = 3  # specular columns p, q, d
LANES = 2**22  # pairs of samples and cells that are computed at a time, 50 MB
HEAT, COOLING = 12.0, 0.6  # initial factor of the overdispersion, and its decay


class Materials(NamedTuple):
    """Parameters of n texels, float64: roughness (n,), mixing parameters (n, M) in the order of
    ``MIXED``, and base colour (n, 3)."""

    roughness: np.ndarray
    mixed: np.ndarray
    color: np.ndarray

    def mixture(self, owner: np.ndarray) -> Mixture:
        """Return the mixture, (S, 1), for S samples of the texels with indices ``owner``."""
        return mixture(*(values[owner, None] for values in self.mixed.T))


class Columns(NamedTuple):
    """(S, K, 3) float64 radiance at K roughnesses: e, p, q, d of ``reflection/principled.py``."""

    e: np.ndarray
    p: np.ndarray
    q: np.ndarray
    d: np.ndarray

    def at(self, level: int) -> tuple[np.ndarray, ...]:
        """Return the mixed columns at a roughness level, (S, 3) each."""
        return columns(*(part[:, level] for part in self))

    def subset(self, samples: np.ndarray) -> "Columns":
        """Return the columns of selected samples."""
        return Columns(*(part[samples] for part in self))


@dataclass(frozen=True)
class Transport:
    """Samples, and N cells of distant light.

    Attributes:
        samples: Samples of n texels.
        number: Number of cells, N.
        moves: True if the light moves with the cameras.
        lanes: Texel and view (UInt32), direction (Vector3f) and cosine (Float) of the samples.
        cells: (3 N,) Float directions of the cells in the light frame.
        frames: (9 V,) Float rotations from the light frame to world space, per view.
        free: Bool visibility of each (texel, cell), or each (sample, cell) if the light moves.
        count: N as an opaque UInt32.
    """

    samples: TexelSamples
    number: int
    moves: bool
    lanes: tuple[Any, Any, Any, Any]
    cells: Any
    frames: Any
    free: Any
    count: Any

    @staticmethod
    def of(samples: TexelSamples, number: int, moves: bool = False) -> "Transport":
        """Trace the visibility of N cells from the texels."""
        cameras = samples.cameras
        turned = cameras if moves else np.broadcast_to(np.eye(3), cameras.shape)
        transport = Transport(
            samples, number, moves,
            lanes=(
                to_drjit(mi.UInt32, samples.owner), to_drjit(mi.UInt32, samples.view),
                to_drjit(mi.Vector3f, samples.direction.T), to_drjit(mi.Float, samples.cosine),
            ),
            cells=to_drjit(mi.Float, fibonacci(number).astype(np.float32).ravel()),
            frames=to_drjit(mi.Float, turned.astype(np.float32).ravel()),
            free=mi.Bool(), count=dr.opaque(mi.UInt32, number),
        )  # fmt: skip
        return replace(transport, free=transport._traced())

    def _traced(self) -> Any:
        texel, view = self.lanes[:2]
        if not self.moves:
            texel = dr.arange(mi.UInt32, self.samples.texels)
            view = dr.zeros(mi.UInt32, self.samples.texels)
        lanes = dr.arange(mi.UInt32, dr.width(texel) * self.number)
        owner, cell = lanes // self.count, lanes % self.count
        texel, view = (dr.gather(mi.UInt32, x, owner) for x in (texel, view))
        near, toward = self.samples.surface.at(texel), self._toward(cell, view)
        up = (dr.dot(near.normal, toward) > 0) & (dr.dot(near.geometric_normal, toward) > 0)
        free = is_unoccluded(self.samples.scene, near, toward, up, coherent=not self.moves)
        dr.eval(free)
        return free

    def _toward(self, cell: Any, view: Any) -> Any:
        """Return the direction of a cell in world space."""
        local = dr.gather(mi.Vector3f, self.cells, cell)
        rows = [dr.gather(mi.Vector3f, self.frames, 3 * view + k) for k in range(3)]
        return mi.Vector3f(*(dr.dot(row, local) for row in rows))

    def _seen(self, lane: Any, cell: Any) -> tuple[Any, Any, Any]:
        """Return normal, direction of a cell and whether the cell is visible above the horizon."""
        texel, view = (dr.gather(mi.UInt32, x, lane) for x in self.lanes[:2])
        normal, toward = self.samples.surface.at(texel).normal, self._toward(cell, view)
        place = (lane if self.moves else texel) * self.count + cell
        return normal, toward, dr.gather(mi.Bool, self.free, place) & (dr.dot(normal, toward) > 0)

    def _reflected(self, lane: Any, normal: Any, toward: Any, widths: list[Any]) -> tuple[Any, ...]:
        """Return the reflection of a visible cell of unit radiance: diffuse (a + roughness b),
        Fresnel factors of p, q, d, and lobes of given widths."""
        direction, cosine = (dr.gather(type(x), x, lane) for x in self.lanes[2:])
        solid = 4 * dr.pi / mi.Float(self.count)
        incident = dr.maximum(dr.dot(normal, toward), GRAZING)
        received = solid * incident
        grazing = received * (1 - incident) ** 5
        moments = [received, *(received * toward), grazing, *(grazing * toward)]
        half = dr.normalize(toward + direction)
        across, up = dr.maximum(dr.dot(toward, half), GRAZING), dr.dot(normal, half)
        # A disk of the solid angle of a cell has the squared radius 4 / N. The half vector turns by
        # half the angle, and by more across the plane of incidence.
        spread = 0.5 * (1 + dr.rcp(across * across))
        cell_width = WIDENED**2 * 4 / mi.Float(self.count) * spread
        wide = [dr.sqrt(dr.fma(alpha, alpha, cell_width)) for alpha in widths]
        lobes = disk_ggx(up, incident, wide, mi.Float(0))
        scale, schlick = solid * dr.rcp(4 * cosine), (1 - across) ** 5
        diffuse = diffuse_shading("disney", moments, direction, cosine)
        of_widths = zip(widths, lobes, strict=True)
        lobes = [scale * smith_g1(cosine, alpha) * lobe for alpha, lobe in of_widths]
        return diffuse, (1 - schlick, schlick, dielectric_fresnel(across)), lobes

    def columns(self, light: np.ndarray, roughness: np.ndarray) -> Columns:
        """Return the columns at roughness (K,) or (n, K) under light (N, 3)."""
        levels = np.broadcast_to(roughness, (self.samples.texels, np.shape(roughness)[-1]))
        of_texel = [to_drjit(mi.Float, alpha_from_roughness(level)) for level in levels.T]
        widths = [dr.gather(mi.Float, alpha, self.lanes[0]) for alpha in of_texel]
        flux = to_drjit(mi.Float, light.astype(np.float32).ravel())
        lane = dr.arange(mi.UInt32, self.samples.count)
        size = 6 + 3 * PARTS * len(widths)
        sums = dr.alloc_local(mi.Float, size)
        for k in range(size):
            sums[k] = dr.zeros(mi.Float, self.samples.count)

        def add(cell: Any, normal: Any, toward: Any, sums: Any) -> tuple[Any]:
            diffuse, fresnel, lobes = self._reflected(lane, normal, toward, widths)
            of_cell = list(dr.gather(mi.Vector3f, flux, cell))
            for k, (part, value) in enumerate(product(diffuse, of_cell)):
                sums[k] = dr.fma(part, value, sums[k])
            parts = [f * value for f, value in product(fresnel, of_cell)]
            for k, (lobe, part) in enumerate(product(lobes, parts)):
                sums[6 + k] = dr.fma(lobe, part, sums[6 + k])
            return (sums,)

        def add_visible(cell: Any, sums: Any) -> tuple[Any, Any]:
            normal, toward, seen = self._seen(lane, cell)
            return cell + 1, *dr.if_stmt((cell, normal, toward, sums), seen, add, lambda *x: x[-1:])

        (sums,) = fold(0, self.count, add_visible, sums)
        values = [sums[k] for k in range(size)]
        dr.eval(values)
        table = np.stack([np.array(x, np.float64) for x in values])
        a, b = table[:6].reshape(2, 1, 3, -1)
        r = levels.T[:, None, self.samples.owner]  # (K, 1, S)
        specular = table[6:].reshape(len(widths), PARTS, 3, -1)
        e = a + r * b
        return Columns(*(np.moveaxis(x, -1, 0) for x in (e, *np.moveaxis(specular, 1, 0))))

    def matrix(
        self, materials: Materials, light: np.ndarray, weight: np.ndarray, chosen: slice
    ) -> list[np.ndarray]:
        """Return K of ``r = K L`` per channel for ``chosen`` samples, (N, s) float32 each, times
        ``light`` (N, 3) and ``weight`` (S,)."""
        values = [materials.roughness, *materials.mixed.T, *materials.color.T]
        of_texels = [to_drjit(mi.Float, value.astype(np.float32)) for value in values]
        weights = to_drjit(mi.Float, weight.astype(np.float32))
        flux = to_drjit(mi.Float, light.astype(np.float32).ravel())
        count, begin = (dr.opaque(mi.UInt32, x) for x in (chosen.stop - chosen.start, chosen.start))
        # Lanes of a packet share a cell and mostly a texel, so that they skip occluded cells.
        lanes = dr.arange(mi.UInt32, (chosen.stop - chosen.start) * self.number)
        lane, cell = lanes % count + begin, lanes // count

        def reflected(lane: Any, cell: Any, normal: Any, toward: Any) -> list[Any]:
            texel = dr.gather(mi.UInt32, self.lanes[0], lane)
            r, *mixed = (dr.gather(mi.Float, values, texel) for values in of_texels)
            mixing, color = mixture(*mixed[:-3]), mixed[-3:]
            width = alpha_from_roughness(r)
            (a, b), fresnel, (lobe,) = self._reflected(lane, normal, toward, [width])
            parts = columns(dr.fma(r, b, a), *(lobe * part for part in fresnel))
            scale = dr.gather(mi.Float, weights, lane) * dr.gather(mi.Vector3f, flux, cell)
            return [x * dot(mixing.at(c), parts) for x, c in zip(scale, color, strict=True)]

        normal, toward, seen = self._seen(lane, cell)
        args = lane, cell, normal, toward
        channels = dr.if_stmt(args, seen, reflected, lambda *_: [mi.Float(0) for _ in range(3)])
        dr.eval(channels)
        return [channel.numpy().reshape(self.number, -1) for channel in channels]


def columns_of(transport: Transport, light: np.ndarray, switches: AngularPreset) -> Columns:
    """Return the columns under light (N, 3) at the roughness levels of the statistics."""
    return transport.columns(light, roughness_levels(switches.levels))


@dataclass(frozen=True)
class SampleMoments:
    """Sums over the samples of n texels, for posteriors at any scale of the light.

    ``table``: (5, 5, n, K, 3) float64 sums of weighted products of e, p, q, d and observation
    at K roughness levels.
    """

    samples: TexelSamples
    table: np.ndarray

    @staticmethod
    def of(samples: TexelSamples, columns: Columns) -> "SampleMoments":
        """Sum products over samples; ``columns``: result of ``columns_of``."""
        observed = np.broadcast_to(samples.radiance[:, None].astype(np.float64), columns.e.shape)
        parts, weight = (*columns, observed), samples.weight[:, None, None]
        table = np.empty((len(parts), len(parts), samples.texels, *columns.e.shape[1:]))
        for i, part in enumerate(parts):
            weighted = weight * part
            for j in range(i, len(parts)):
                table[i, j] = table[j, i] = samples.sum(weighted * parts[j])
        return SampleMoments(samples, table)

    def posterior(
        self, switches: AngularPreset, factor: np.ndarray | float = 1.0
    ) -> Posterior[CalibratedKernel]:
        """Return the posterior under the light times ``factor``, scalar or (3,)."""
        statistics = self._statistics(switches, np.broadcast_to(factor, (1, 3)))
        return calibrated_posterior(statistics, self.samples.grid, self.samples.unit, switches)

    def noise(self, switches: AngularPreset, factors: np.ndarray) -> np.ndarray:
        """Return geometric means (F,) of the noise of texels over their unit, with ``factors``.

        ``factors`` (F, 3) multiply the light. All are computed at once, and nothing is integrated.
        """
        samples, statistics = self.samples, self._statistics(switches, factors)
        noise = noise_of_parts(statistics, samples.grid, samples.unit, switches, len(factors))
        return np.asarray(np.exp(np.log(noise).mean(axis=1)) / samples.unit)

    def _statistics(self, switches: AngularPreset, factors: np.ndarray) -> Statistics:
        """Return statistics of F n texels, under the light times each of ``factors`` (F, 3)."""
        samples, unit = self.samples, np.eye(len(self.table))[:, None, :, None]
        e, p, q, d = (factors[:, None] * row for row in unit[:-1])
        mixed = columns(e, p, q, d, unit[-1] * np.ones_like(e))
        table = np.stack(
            [np.einsum("fic,fjc,ijnkc->fnkc", mixed[i], mixed[j], self.table, optimize=True)
             for i, j in PAIRS]
        )  # fmt: skip
        views = np.bincount(samples.owner[samples.weight > 0], minlength=samples.texels)
        return Statistics.of(
            table.reshape(len(PAIRS), -1, *table.shape[3:]).transpose(2, 3, 0, 1),
            np.tile(samples.sum(samples.weight), len(factors)), np.tile(views, len(factors)),
            roughness_levels(switches.levels), samples.kappa,
        )  # fmt: skip


def materials_of(posterior: Posterior[CalibratedKernel]) -> Materials:
    """Return the posterior means of the materials."""

    def mean(name: str) -> np.ndarray:
        return np.array(posterior.mean(name), np.float64)

    mixed = np.stack([mean(name) for name in MIXED], axis=1)
    return Materials(mean("roughness"), mixed, mean("base_color"))


def annealed(switches: AngularPreset, factor: float) -> AngularPreset:
    """Return the preset with its overdispersion multiplied by a factor."""
    return replace(switches, overdispersion=switches.overdispersion * factor)
