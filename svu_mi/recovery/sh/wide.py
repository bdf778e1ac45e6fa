"""Wide lobes, by quadrature over cells of the light.

Pre-filtered light is exact for a mirror. The lobe of a rough surface is neither symmetric nor
centred where a mirror's is, and part of its light is hidden: under a sun, brushed metal comes
out wrong by half its radiance. Once a lobe is wider than a few hundred cells of the light are,
a sum over these is as good as the light itself, with the exact BRDF and traced visibility.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.brdf.lobes import dielectric_fresnel, ggx, smith_g1
from svu_mi.radiance.bits import Bits
from svu_mi.radiance.cells import LightCells
from svu_mi.radiance.hemisphere import is_open
from svu_mi.radiance.observe import Surface


@dataclass(frozen=True)
class WideLobes:
    """What of the light S texels see, and the widths that it is asked for.

    Attributes:
        cells: N cells of the light.
        visible: of N cells and S texels: whether nothing hides the one from the other.
        alpha: (K,) float64 lobe widths.
    """

    cells: LightCells
    visible: Bits
    alpha: np.ndarray

    @staticmethod
    def trace(scene: Any, surface: Surface, cells: LightCells, alpha: np.ndarray) -> WideLobes:
        """Trace all cells from every texel of a launch.

        Args:
            scene: what occludes.
            surface: S texels.
            cells: N cells.
            alpha: (K,) lobe widths.
        """
        visible, lane = Bits.clear(int(cells.count[0]), surface.count), surface.lane

        def look(cell: Any) -> tuple[Any]:
            direction = mi.Vector3f(dr.gather(mi.Vector3f, cells.directions, cell))
            above = (dr.dot(surface.normal, direction) > 0) & (
                dr.dot(surface.geometric_normal, direction) > 0
            )
            # Neighbouring texels look in one direction: packets stay together.
            free = is_open(scene, surface, direction, above, coherent=True)
            visible.set(cell, lane, free)
            return (cell + 1,)

        # One cell per lane, or the loop would have a single lane.
        dr.while_loop(
            state=(dr.zeros(mi.UInt32, surface.count),),
            cond=lambda cell: cell < cells.count,
            body=look,
        )
        dr.eval(visible)
        return WideLobes(cells, visible, alpha)

    def reflect(
        self, lane: Any, normal: Any, direction: Any, cosine: Any
    ) -> list[list[tuple[Any, Any, Any]]]:
        """Reflect the visible light towards a camera.

        Args:
            lane: UInt32, which of the S texels.
            normal: Vector3f, shading normals.
            direction: unit Vector3f to the camera.
            cosine: Float between the two, positive.

        Returns:
            For each width and colour channel (p, q, d): a metal of base colour c reflects
            c p + q (Schlick), and a dielectric of index 1.5 d.
        """
        leaving = [smith_g1(cosine, float(alpha)) for alpha in self.alpha]

        def add(cell: Any, *sums: Any) -> tuple[Any, ...]:
            toward = mi.Vector3f(dr.gather(mi.Vector3f, self.cells.directions, cell))
            incident = dr.dot(normal, toward)
            lit = self.visible.test(cell, lane) & (incident > 0)

            def reflected(*state: Any) -> tuple[Any, ...]:
                half = dr.normalize(toward + direction)
                up, across = dr.dot(normal, half), dr.dot(toward, half)
                schlick, dielectric = (1 - across) ** 5, dielectric_fresnel(across)
                flux = mi.Color3f(dr.gather(mi.Color3f, self.cells.flux, cell))
                parts = [
                    [value * factor for factor in (1 - schlick, schlick, dielectric)]
                    for value in flux
                ]
                result, place = [], 0
                for alpha in self.alpha:
                    lobe = ggx(up, float(alpha)) * smith_g1(incident, float(alpha))
                    for values in parts:
                        for value in values:
                            result.append(dr.fma(value, lobe, state[place]))
                            place += 1
                return tuple(result)

            sums = dr.if_stmt(
                args=sums, cond=mi.Bool(lit), true_fn=reflected, false_fn=lambda *s: s
            )
            return (cell + 1, *sums)

        size = 9 * len(self.alpha)
        zero = 0 * cosine
        sums = dr.while_loop(
            state=(mi.UInt32(0), *([zero] * size)),
            cond=lambda cell, *_: cell < self.cells.count,
            body=add,
        )[1:]
        result = []
        for k, masking in enumerate(leaving):
            scale = masking / (4 * cosine)
            own = [scale * value for value in sums[9 * k : 9 * (k + 1)]]
            result.append([tuple(own[3 * c : 3 * c + 3]) for c in range(3)])
        return result
