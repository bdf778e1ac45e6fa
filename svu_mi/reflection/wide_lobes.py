"""Wide lobes, by summing cells of the light with the exact BRDF and traced visibility.

Over a cell of radius rho the half vector turns by up to rho / (2 cos theta_d), with theta_d the
angle between it and either direction, and GGX falls off as 1 / s^2 with s = sin^2 theta_h +
alpha^2 cos^2 theta_h. Cells where rho^2 / (s cos^2 theta_d) is too large (near the mirror
direction, mostly in grazing views) are replaced by their smaller ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.geometry.sample_view import fold
from svu_mi.light.light_tree import Cells
from svu_mi.light.light_visibility import Reach
from svu_mi.reflection.lobes import blurred_ggx, dielectric_fresnel, smith_g1

NARROW = 0.03  # lobe alpha up to which light is looked up; its leaves are as far apart
LARGE = 1.6  # rho^2 / (s cos^2 theta_d) from which a cell is too large

Lobe = list[tuple[Any, Any, Any]]
"""(p, q, d) per colour channel: a metal of base colour c reflects c p + q, a dielectric d."""


class _Look(NamedTuple):
    """A cell's radius and its square; cosines of (normal, light), (normal, half), (light, half)."""

    radius: Any
    square: Any
    incident: Any
    up: Any
    across: Any


class Sums:
    """Sums of cells under lobes of K ascending widths; a plain class, opaque to loops."""

    def __init__(self, alpha: np.ndarray, channels: int, normal: Any, direction: Any) -> None:
        self.alpha, self.channels = alpha.tolist(), channels
        self.normal, self.direction = normal, direction

    def over(self, count: Any, add: Callable[..., Any], cosine: Any) -> list[Lobe]:
        """Return the lobes of all cells; ``add(cell, sums)`` returns the next cell, and sums."""
        size = 3 * self.channels
        sums = dr.alloc_local(mi.Float, size * len(self.alpha))
        for k in range(size * len(self.alpha)):
            sums[k] = 0 * cosine
        (sums,) = fold(mi.UInt32(0), count, add, sums)
        result = []
        for k, alpha in enumerate(self.alpha):
            scale = smith_g1(cosine, alpha) / (4 * cosine)
            own = [scale * sums[size * k + part] for part in range(size)]
            result.append([tuple(own[3 * c : 3 * c + 3]) for c in range(self.channels)])
        return result

    def look(self, cells: Cells, cell: Any) -> _Look:
        """Read a cell, and turn half way to it."""
        toward, radius = cells.at(cell)
        half = dr.normalize(toward + self.direction)
        return _Look(
            radius, dr.square(radius), incident=dr.dot(self.normal, toward),
            up=dr.dot(self.normal, half), across=dr.dot(toward, half),
        )  # fmt: skip

    def lit(self, cells: Cells, cell: Any, look: _Look, free: Any, sums: Any) -> tuple[Any]:
        """Add what one cell contributes to every width, if it is seen."""
        _, square, incident, up, across = look

        def reflected(sums: Any) -> tuple[Any]:
            schlick, dielectric = (1 - across) ** 5, dielectric_fresnel(across)
            parts = [
                value * factor
                for value in cells.light(cell, self.channels)
                for factor in (1 - schlick, schlick, dielectric)
            ]
            # Across the plane of incidence the half vector turns by more, 1 / cos theta_d as far.
            spread = 0.5 * square * (1 + dr.rcp(across * across))
            lobes = blurred_ggx(up, incident, self.alpha, spread)
            for k, (lobe, part) in enumerate(product(lobes, parts)):
                sums[k] = dr.fma(part, lobe, sums[k])
            return (sums,)

        lit = mi.Bool(free & (incident > 0))
        return dr.if_stmt(args=(sums,), cond=lit, true_fn=reflected, false_fn=lambda s: (s,))


@dataclass(frozen=True)
class WideLobes:
    """Lobes of (K,) ascending widths, summed over the visible light of S texels."""

    reach: Reach
    alpha: np.ndarray
    channels: int

    def reflect(self, lane: Any, normal: Any, direction: Any, cosine: Any) -> list[Lobe]:
        """Reflect the visible light towards a camera: the lobe of each width."""
        sums = Sums(self.alpha, self.channels, normal, direction)
        tree = _Tree(self.reach, lane, sums)
        return sums.over(self.reach.cells.coarse.count, tree.coarse, cosine)


class _Depth(NamedTuple):
    """Cells of one size; where the smaller ones begin that each is made of; what adds one."""

    cells: Cells
    first: Any
    below: Callable[..., Any]


class _Tree:
    """Goes through the cells of the light, into small ones where the narrowest lobe asks for it."""

    def __init__(self, reach: Reach, lane: Any, sums: Sums) -> None:
        self.reach, self.lane, self.sums = reach, lane, sums
        # The same cells for any set of widths: one that is known must not change the others.
        self.flat = 1 - NARROW**2
        self.limit = dr.opaque(mi.Float, LARGE)

    def coarse(self, cell: Any, sums: Any) -> tuple[Any, Any]:
        """Add a coarse cell, or the fine ones that it is made of."""
        cells = self.reach.cells
        free = self.reach.coarse.test(cell, self.lane)
        return self._add(_Depth(cells.coarse, cells.first, self.fine), cell, free, sums)

    def fine(self, cell: Any, sums: Any) -> tuple[Any, Any]:
        """Add a fine cell, or its leaves, which are seen if it is."""
        cells, free = self.reach.cells, self.reach.fine.test(cell, self.lane)

        def leaf(below: Any, sums: Any) -> tuple[Any, Any]:
            look = self.sums.look(cells.leaves, below)
            return (below + 1, *self.sums.lit(cells.leaves, below, look, free, sums))

        depth = _Depth(cells.fine, cells.first_leaf, leaf)
        return self._add(depth, cell, free, sums, inside=free)

    def _add(
        self, depth: _Depth, cell: Any, free: Any, sums: Any, inside: Any = True
    ) -> tuple[Any, Any]:
        """Add a cell, or what is below it where it is too large; only if ``inside`` is."""
        cells, first, below = depth
        look = self.sums.look(cells, cell)

        def above(sums: Any) -> tuple[Any]:
            s = dr.fma(-self.flat * look.up, look.up, 1)
            large = look.square > self.limit * look.across * look.across * s

            def smaller(sums: Any) -> tuple[Any, ...]:
                start, end = (dr.gather(mi.UInt32, first, cell + k) for k in (0, 1))
                return fold(start, end, below, sums)

            return dr.if_stmt(
                args=(sums,), cond=large, true_fn=smaller,
                false_fn=lambda sums: self.sums.lit(cells, cell, look, free, sums),
            )  # fmt: skip

        (sums,) = dr.if_stmt(
            args=(sums,), cond=(look.incident > -look.radius) & inside,
            true_fn=above, false_fn=lambda sums: (sums,),
        )  # fmt: skip
        return cell + 1, sums
