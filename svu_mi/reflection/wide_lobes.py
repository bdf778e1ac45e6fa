"""Wide specular lobes: sums over light cells with the exact BRDF.

Within a cell of radius rho, the half vector rotates by up to rho / (2 cos theta_d), where theta_d
is its angle with the light. GGX is proportional to 1 / s^2 with s = sin^2 theta_h + alpha^2 cos^2
theta_h. Cells with large rho^2 / (s cos^2 theta_d), near the mirror direction, are subdivided,
bright cells earlier than dim ones, and coarse cells that are partly hidden earlier than others. If
not subdivided, these have the visible part of their light.

Where normals vary within a texel, lobes narrower than ``BENT`` are averaged over three normals.
"""

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold
from svu_mi.light.light_tree import LightCells
from svu_mi.light.light_visibility import LightVisibility
from svu_mi.reflection.lobes import Normals, dielectric_fresnel, disk_ggx, smith_g1

NARROW = 0.03  # maximum alpha of narrow lobes; about the distance of leaf cells
BENT = 0.1  # maximum alpha of lobes that are averaged over normals
LARGE = 1.8  # rho^2 / (s cos^2 theta_d) above which a cell is subdivided
PARTLY = 4.0  # factor of rho^2 of coarse cells that are partly hidden
PLACE, WHOLE = 16, 2**15  # number of bits for the place of a cell, and visible part of whole cells
STRIPS, MOST = 4.0, 16.0  # factor and maximum of the number of strips of a cell
ROOM = 1024  # largest number of leaves in a list; beyond, a fine cell stays whole

Lobe = list[tuple[Any, Any, Any]]
"""(p, q, d) per channel: a metal of base colour c reflects c p + q, a dielectric d."""


def added_lobes(first: list[Lobe], second: list[Lobe]) -> list[Lobe]:
    """Return the sums of lobes of the same widths."""
    return [added(*both) for both in zip(first, second, strict=True)]


def added(first: list[Any], second: list[Any]) -> list[Any]:
    """Return the sums of a lobe, or of moments, for each channel."""
    both = zip(first, second, strict=True)
    return [[a + b for a, b in zip(*pair, strict=True)] for pair in both]


class Cells(Protocol):
    """Cells of light as seen from one texel per lane, such as ``LightCells``."""

    def at(self, cell: Any) -> tuple[Any, Any]:
        """Return direction (Vector3f) and radius (Float) of a cell."""

    def light(self, cell: Any, channels: int) -> list[Any]:
        """Return the irradiance by a cell: R, G and B, or their mean if ``channels`` is 1."""


class LobeSums:
    """Sums of light cells under lobes of K ascending widths: 3 K Floats per channel."""

    # Not a dataclass, because Dr.Jit would treat the fields as loop state.

    def __init__(self, alpha: np.ndarray, channels: int, normals: Normals, direction: Any) -> None:
        self.alpha, self.channels = alpha.tolist(), channels
        self.normals, self.direction = normals, direction

    def zeros(self) -> list[Any]:
        """Return empty sums."""
        return [0 * self.direction.x for _ in range(3 * self.channels * len(self.alpha))]

    def add(self, cell: tuple[Any, ...], sums: list[Any], ratio: Any = 1) -> list[Any]:
        """Add a cell, given by its direction, radius and irradiance per channel.

        ``ratio`` is that of its squared radii across and along the plane of incidence.
        """
        toward, radius, light = cell
        both = toward + self.direction  # along the half vector
        square = dr.squared_norm(both)
        inverse = dr.rsqrt(square)
        across = 0.5 * square * inverse  # cosine of light and half vector
        schlick, dielectric = (1 - across) ** 5, dielectric_fresnel(across)
        parts = [value * factor for value in light for factor in (1 - schlick, schlick, dielectric)]
        # Perpendicular to the plane of incidence, the rotation is 1 / cos theta_d as large.
        spread = dr.square(radius) * dr.fma(2 * inverse, inverse * ratio, 0.5)
        lobes = self._averaged(both, inverse, dr.dot(self.normals.mean, toward), spread)
        pairs = zip(sums, product(lobes, parts), strict=True)
        return [dr.fma(part, lobe, old) for old, (lobe, part) in pairs]

    def of_cells(
        self, cells: Cells, end: Any, free: Any, cosine: Any, first: Any = 0, step: Any = 1
    ) -> list[Lobe]:  # fmt: skip
        """Return the lobes of each ``step``-th cell from ``first`` to ``end``, where ``free``."""

        def add(cell: Any, sums: list[Any]) -> tuple[Any, Any]:
            toward, radius = cells.at(cell)
            lit = mi.Bool(free & (dr.dot(self.normals.mean, toward) > 0))
            number = self._strips(toward, radius)
            part = dr.rcp(mi.Float(number))
            light = [part * value for value in cells.light(cell, self.channels)]
            across = dr.cross(toward, self.direction)
            across *= np.pi**0.5 * radius * dr.rsqrt(dr.maximum(dr.squared_norm(across), 1e-12))

            def strip(k: Any, sums: list[Any]) -> tuple[Any, Any]:
                center = dr.normalize(toward + ((mi.Float(k) + 0.5) * part - 0.5) * across)
                return k + 1, self.add((center, radius, light), sums, dr.square(part))

            (sums,) = fold(0, dr.select(lit, number, 0), strip, sums)
            return cell + step, sums

        (sums,) = fold(first, end, add, self.zeros())
        return self.lobes(sums, cosine)

    def _strips(self, toward: Any, radius: Any) -> Any:
        """Return the number of strips, UInt32, into which a cell is divided.

        In half vectors, a cell is 1 / cos theta_d as wide across the plane of incidence as along
        it. Near the mirror direction, strips are as wide as long.
        """
        both = toward + self.direction
        square, up = dr.squared_norm(both), dr.dot(self.normals.mean, both)
        near = STRIPS * radius * dr.rsqrt(dr.fma((NARROW**2 - 1) * up, up, square))
        # |both| = 2 cos theta_d; the argument of the second root is s |both|^2.
        return mi.UInt32(dr.clip(2 * dr.minimum(dr.rsqrt(square), near) + 0.5, 1, MOST))

    def lobes(self, sums: list[Any], cosine: Any) -> list[Lobe]:
        """Return the lobes from their sums; ``cosine`` is that of the viewing angle."""
        size, result = 3 * self.channels, []
        for k, alpha in enumerate(self.alpha):
            scale = smith_g1(cosine, alpha) / (4 * cosine)
            own = [scale * sums[size * k + part] for part in range(size)]
            result.append([tuple(own[3 * c : 3 * c + 3]) for c in range(self.channels)])
        return result

    def _averaged(self, both: Any, inverse: Any, incident: Any, spread: Any) -> list[Any]:
        """Return ``disk_ggx`` of each width, averaged over normals."""
        around, incident = self.normals.around, dr.maximum(incident, 0)
        split = int(np.searchsorted(self.alpha, BENT)) if around else 0
        several = [
            disk_ggx(dr.dot(normal, both) * inverse, incident, self.alpha[:split], spread)
            for normal in around if split
        ]  # fmt: skip
        means = [sum(values) / len(around) for values in zip(*several, strict=True)]
        up = dr.dot(self.normals.mean, both) * inverse
        return means + disk_ggx(up, incident, self.alpha[split:], spread)


@dataclass(frozen=True)
class WideLobes:
    """Lobes of (K,) ascending widths, as sums over the visible light of S texels."""

    visibility: LightVisibility
    alpha: np.ndarray
    channels: int

    def reflect(self, lane: Any, normals: Normals, direction: Any, cosine: Any) -> list[Lobe]:
        """Return the visible light reflected towards a camera by the lobe of each width."""
        sums = LobeSums(self.alpha, self.channels, normals, direction)
        every = self.visibility.tree.every
        listed, count = _Traversal(self.visibility, lane, normals.mean, direction).visible_cells()

        def read(listed: Any, place: Any) -> tuple[Any, ...]:
            entry = listed.read(place, place < count)
            cell, part = entry % 2**PLACE, mi.Float(entry >> PLACE) / WHOLE
            return *every.at(cell), [part * x for x in every.light(cell, self.channels)]

        def add(place: Any, listed: Any, cell: Any, totals: list[Any]) -> tuple[Any, ...]:
            # The next cell is read in advance, which takes as long as to add one.
            following = read(listed, place + 1)
            return place + 1, listed, following, sums.add(cell, totals)

        start = mi.UInt32(0)
        *_, totals = fold(start, count, add, listed, read(listed, start), sums.zeros())
        return sums.lobes(totals, cosine)


class _Traversal:
    """Traversal of the light tree to the depth that the narrowest wide lobe needs.

    Visible cells are listed first and added later, because neighbouring texels need different
    ones: a loop over a list has as many steps as the longest list, a sum during the traversal one
    for each cell that any texel needs.
    """

    def __init__(self, visibility: LightVisibility, lane: Any, normal: Any, direction: Any) -> None:
        self.visibility, self.tree = visibility, visibility.tree
        self.place = dr.gather(mi.UInt32, visibility.place, lane)
        self.normal, self.direction = normal, direction
        # Independent of the widths, so that a known roughness does not change other results.
        self.flat = 1 - NARROW**2
        self.limit = dr.opaque(mi.Float, LARGE / 4)

    def visible_cells(self) -> tuple[Any, ...]:
        """Return local memory with entries, and their number.

        An entry is an index in ``tree.every`` and, from bit ``PLACE`` on, the visible part of the
        cell times ``WHOLE``.
        """
        listed = dr.alloc_local(mi.UInt32, self.tree.fine.number + ROOM)
        return fold(0, self.tree.coarse.count, self._coarse, listed, 0 * self.place)

    def _coarse(self, cell: Any, listed: Any, count: Any) -> tuple[Any, ...]:
        """List a coarse cell or its fine cells; return the next cell, the list and its length."""
        start, end = (dr.gather(mi.UInt32, self.tree.first, cell + k) for k in (0, 1))
        free = self.visibility.fine.several(start, end, self.place)
        part = mi.Float(dr.popcnt(free)) / mi.Float(end - start)
        above, lit, size, limit = self._tests(self.tree.coarse, cell)
        large = dr.select(part < 1, PARTLY, 1) * size > limit

        def smaller(listed: Any, count: Any) -> tuple[Any, ...]:
            def add(cell: Any, listed: Any, count: Any) -> tuple[Any, ...]:
                seen, fine = (free >> (cell - start)) & 1 != 0, partial(self._fine, cell)
                return cell + 1, *dr.if_stmt((listed, count), seen, fine, lambda *state: state)

            return fold(start, end, add, listed, count)

        def itself(listed: Any, count: Any) -> tuple[Any, ...]:
            listed.write(cell | mi.UInt32(WHOLE * part) << PLACE, count, lit)
            return listed, count + dr.select(lit, mi.UInt32(1), 0)

        return cell + 1, *dr.if_stmt(
            args=(listed, count), cond=above & (free > 0), false_fn=lambda *state: state,
            true_fn=lambda *state: dr.if_stmt(state, large, smaller, itself),
        )  # fmt: skip

    def _fine(self, cell: Any, listed: Any, count: Any) -> tuple[Any, ...]:
        """List a visible fine cell or its leaves, which inherit its visibility."""
        above, lit, size, limit = self._tests(self.tree.fine, cell)
        start, end = (dr.gather(mi.UInt32, self.tree.first_leaf, cell + k) for k in (0, 1))
        # An entry remains for each of the following fine cells. Numbers are literals, because
        # Dr.Jit 1.5 does not distinguish kernels by the size of local memory.
        large = (size > limit) & (count + end <= start + cell + ROOM)
        before = self.tree.coarse.number
        leaves = before + self.tree.fine.number
        first = dr.select(large, leaves + start, before + cell)
        number = dr.select(large, end - start, dr.select(lit, mi.UInt32(1), 0))

        def add(below: Any, listed: Any, count: Any) -> tuple[Any, ...]:
            listed.write(below | WHOLE << PLACE, count)
            return below + 1, listed, count + 1

        return fold(first, first + dr.select(above, number, 0), add, listed, count)

    def _tests(self, cells: LightCells, cell: Any) -> tuple[Any, ...]:
        """Return whether a cell is partly above the horizon, its centre is, its size and limit."""
        toward, radius = cells.at(cell)
        incident, both = dr.dot(self.normal, toward), toward + self.direction
        up = dr.dot(self.normal, both)
        # |both| = 2 cos theta_d; both / |both| is the half vector.
        s = dr.fma(-self.flat * up, up, dr.squared_norm(both))
        size = dr.gather(mi.Float, cells.size, cell)
        return incident > -radius, incident > 0, size, self.limit * s
