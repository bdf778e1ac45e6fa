"""Wide specular lobes: sums over light cells with the exact BRDF.

Within a cell of radius rho, the half vector rotates by up to rho / (2 cos theta_d), where theta_d
is its angle with the light. GGX is proportional to 1 / s^2 with s = sin^2 theta_h + alpha^2 cos^2
theta_h. Cells with large rho^2 / (s cos^2 theta_d), near the mirror direction, are subdivided.

Where normals vary within a texel, lobes narrower than ``BENT`` are averaged over three normals.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.geometry.sample_view import fold
from svu_mi.light.light_tree import LightCells
from svu_mi.light.light_visibility import LightVisibility
from svu_mi.reflection.lobes import Normals, blurred_ggx, dielectric_fresnel, smith_g1

NARROW = 0.03  # maximum alpha of narrow lobes; about the distance of leaf cells
BENT = 0.1  # maximum alpha of lobes that are averaged over normals
LARGE = 1.6  # rho^2 / (s cos^2 theta_d) above which a cell is subdivided

Lobe = list[tuple[Any, Any, Any]]
"""(p, q, d) per channel: a metal of base colour c reflects c p + q, a dielectric d."""


def added_lobes(first: list[Lobe], second: list[Lobe]) -> list[Lobe]:
    """Return the sums of lobes of the same widths."""
    return [
        [tuple(a + b for a, b in zip(*pair, strict=True)) for pair in zip(*both, strict=True)]
        for both in zip(first, second, strict=True)
    ]  # type: ignore[misc]


class _CellAngles(NamedTuple):
    """Radius of a cell, its square, and cosines (normal, light), (normal, half), (light, half).

    ``half`` is the half vector.
    """

    radius: Any
    square: Any
    incident: Any
    up: Any
    across: Any
    half: Any


class Cells(Protocol):
    """Interface of light cells (``LightCells``)."""

    def at(self, cell: Any) -> tuple[Any, Any]:
        """Return direction and radius of a cell."""

    def light(self, cell: Any, channels: int) -> list[Any]:
        """Return the irradiance by a cell, per channel."""


class LobeSums:
    """Sums of cells under lobes of K ascending widths."""

    # Not a dataclass, because Dr.Jit would treat the fields as loop state.

    def __init__(
        self, alpha: np.ndarray, channels: int, normals: Normals, direction: Any,
        profile: Callable[..., list[Any]] = blurred_ggx,
    ) -> None:  # fmt: skip
        self.alpha, self.channels = alpha.tolist(), channels
        self.normals, self.direction, self.profile = normals, direction, profile

    def integrate(self, count: Any, add: Callable[..., Any], cosine: Any) -> list[Lobe]:
        """Sum lobes over all cells; ``add(cell, sums)`` returns the next cell and new sums."""
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

    def angles(self, cells: Cells, cell: Any) -> _CellAngles:
        """Return the radius and angles of a cell."""
        toward, radius = cells.at(cell)
        half = dr.normalize(toward + self.direction)
        return _CellAngles(
            radius, dr.square(radius), incident=dr.dot(self.normals.mean, toward),
            up=dr.dot(self.normals.mean, half), across=dr.dot(toward, half), half=half,
        )  # fmt: skip

    def add(self, cells: Cells, cell: Any, angles: _CellAngles, free: Any, sums: Any) -> tuple[Any]:
        """Add one cell to the lobe of each width, only in lanes where it is visible (``free``)."""
        _, square, _, _, across, _ = angles

        def reflected(sums: Any) -> tuple[Any]:
            schlick, dielectric = (1 - across) ** 5, dielectric_fresnel(across)
            parts = [
                value * factor
                for value in cells.light(cell, self.channels)
                for factor in (1 - schlick, schlick, dielectric)
            ]
            # Perpendicular to the plane of incidence, the rotation is 1 / cos theta_d as large.
            spread = 0.5 * square * (1 + dr.rcp(across * across))
            lobes = self._averaged(angles, spread)
            for k, (lobe, part) in enumerate(product(lobes, parts)):
                sums[k] = dr.fma(part, lobe, sums[k])
            return (sums,)

        lit = mi.Bool(free & (angles.incident > 0))
        return dr.if_stmt(args=(sums,), cond=lit, true_fn=reflected, false_fn=lambda s: (s,))

    def _averaged(self, angles: _CellAngles, spread: Any) -> list[Any]:
        """Return the profile of each width for a disk of light, averaged over normals."""
        around = self.normals.around
        split = int(np.searchsorted(self.alpha, BENT)) if around else 0
        several = [
            self.profile(dr.dot(normal, angles.half), angles.incident, self.alpha[:split], spread)
            for normal in around if split
        ]  # fmt: skip
        means = [sum(values) / len(around) for values in zip(*several, strict=True)]
        if split == len(self.alpha):
            return means
        return means + self.profile(angles.up, angles.incident, self.alpha[split:], spread)


@dataclass(frozen=True)
class WideLobes:
    """Lobes of (K,) ascending widths, as sums over the visible light of S texels."""

    visibility: LightVisibility
    alpha: np.ndarray
    channels: int

    def reflect(self, lane: Any, normals: Normals, direction: Any, cosine: Any) -> list[Lobe]:
        """Return the visible light reflected towards a camera by the lobe of each width."""
        sums = LobeSums(self.alpha, self.channels, normals, direction)
        traversal = _Traversal(self.visibility, lane, sums)
        return sums.integrate(self.visibility.tree.coarse.count, traversal.coarse, cosine)


class _TreeLevel(NamedTuple):
    """Cells of one level, indices of first children, and function to add a child."""

    cells: LightCells
    first: Any
    below: Callable[..., Any]


class _Traversal:
    """Traversal of the light tree to the depth that the narrowest wide lobe needs."""

    def __init__(self, visibility: LightVisibility, lane: Any, sums: LobeSums) -> None:
        self.visibility, self.lane, self.sums = visibility, lane, sums
        # Independent of the widths, so that a known roughness does not change other results.
        self.flat = 1 - NARROW**2
        self.limit = dr.opaque(mi.Float, LARGE)

    def coarse(self, cell: Any, sums: Any) -> tuple[Any, Any]:
        """Add a coarse cell or its fine cells; return next cell and sums."""
        cells = self.visibility.tree
        free = self.visibility.coarse.test(cell, self.lane)
        return self._add(_TreeLevel(cells.coarse, cells.first, self.fine), cell, free, sums)

    def fine(self, cell: Any, sums: Any) -> tuple[Any, Any]:
        """Add a fine cell or its leaves, which inherit its visibility."""
        cells, free = self.visibility.tree, self.visibility.fine.test(cell, self.lane)

        def leaf(below: Any, sums: Any) -> tuple[Any, Any]:
            angles = self.sums.angles(cells.leaves, below)
            return (below + 1, *self.sums.add(cells.leaves, below, angles, free, sums))

        depth = _TreeLevel(cells.fine, cells.first_leaf, leaf)
        return self._add(depth, cell, free, sums, inside=free)

    def _add(
        self, depth: _TreeLevel, cell: Any, free: Any, sums: Any, inside: Any = True
    ) -> tuple[Any, Any]:
        """Add a cell, or its children if it is too large; only where ``inside``."""
        cells, first, below = depth
        angles = self.sums.angles(cells, cell)

        def above(sums: Any) -> tuple[Any]:
            s = dr.fma(-self.flat * angles.up, angles.up, 1)
            large = angles.square > self.limit * angles.across * angles.across * s

            def smaller(sums: Any) -> tuple[Any, ...]:
                start, end = (dr.gather(mi.UInt32, first, cell + k) for k in (0, 1))
                return fold(start, end, below, sums)

            return dr.if_stmt(
                args=(sums,), cond=large, true_fn=smaller,
                false_fn=lambda sums: self.sums.add(cells, cell, angles, free, sums),
            )  # fmt: skip

        (sums,) = dr.if_stmt(
            args=(sums,), cond=(angles.incident > -angles.radius) & inside,
            true_fn=above, false_fn=lambda sums: (sums,),
        )  # fmt: skip
        return cell + 1, sums
