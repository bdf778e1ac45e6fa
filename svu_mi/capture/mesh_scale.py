"""Meshes in another unit than the poses, detected by their extent in the photographs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import film_size, projected
from svu_mi.core.arrays import evenly_spaced

# Quotients of usual units, and of wrong conversions: mm, cm, m, km, inch.
RATIOS = (10.0, 25.4, 39.37, 100.0, 1000.0)
FACTORS = tuple(1 / ratio for ratio in RATIOS) + RATIOS
X90 = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # rotation about +X
TURNS = [np.linalg.matrix_power(X90, number) for number in (1, 2, 3)]  # to other up axes
VERTICES, VIEWS = 400, 16  # sample sizes
INSIDE = 0.5  # share of cameras in the bounding box of the mesh that is suspicious
HIDDEN = 0.25  # share of visible vertices below which a mesh is not framed by its cameras
FRAMED = 0.5  # share of visible vertices from which it is
UNSEEN = 0.5  # share of cameras that see nothing of the mesh, from which that is suspicious
TINY, SMALL, LARGE = 0.03, 0.1, 2.0  # extent in the photographs, relative to their sides
ALIKE = 2.0  # ratio of factors that the photographs hardly distinguish
APART = 6.0  # ratio of bounding boxes of points and mesh that is suspicious


@dataclass(frozen=True)
class WrongScale:
    """Evidence for another unit, and factors of the mesh that may correct it, the best first."""

    problem: str
    factors: Sequence[float]

    @property
    def factor(self) -> float | None:
        """Best factor; None if unknown."""
        return self.factors[0] if self.factors else None

    def sentence(self, imported: float | None) -> str:
        """Return the problem and its remedy.

        ``imported`` is the scale that the mesh was imported with; None for a Mitsuba scene.
        """
        if not self.factors:
            return f"{self.problem}: check that mesh and poses have one unit and one origin."
        by = " or ".join(f"{each * (imported or 1):.4g}" for each in self.factors)
        remedy = "scale the shape by" if imported is None else "import with --mesh-scale"
        return f"{self.problem}: mesh and poses have different units, or frames; {remedy} {by}."


def wrong_scale(
    positions: np.ndarray, sensors: Sequence[Any], points: np.ndarray | None = None
) -> WrongScale | None:
    """Compare the unit of a mesh with that of its cameras; return None without contradiction.

    Args:
        positions: (N, 3) vertices of the mesh.
        sensors: Cameras around the object.
        points: (P, 3) reconstructed points of the object and its surroundings, if available.
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    width = float(np.linalg.norm(high - low))
    if not sensors or not 0 < width < np.inf:
        return None
    eyes = np.array([to_world(sensor)[:3, 3] for sensor in sensors])
    around = float(np.linalg.norm(np.ptp(eyes, axis=0)))
    inside = int(((eyes > low) & (eyes < high)).all(axis=1).sum())
    some = [sensors[view] for view in evenly_spaced(len(sensors), VIEWS)]
    vertices = positions[evenly_spaced(len(positions), VERTICES)]
    vertices = np.concatenate([vertices, [(low + high) / 2]])  # of a large triangle
    share, size, blind = framing(vertices, some)
    ratio = 1.0 if points is None else _ratio_of_points(points, width)
    needs_factor = False
    if inside >= INSIDE * len(sensors) and share < HIDDEN:
        problem = (
            f"{inside} of {len(sensors)} cameras are inside the bounding box of the mesh, whose "
            f"diagonal is {width:.3g}; that of the cameras is {around:.3g}"
        )
    elif max(ratio, 1 / ratio) > APART and (share < HIDDEN or size < SMALL):
        problem = (
            f"the bounding box of COLMAP's points is {ratio:.2g} times as large as that of the mesh"
        )
    elif size < TINY:
        problem = f"the mesh covers {size:.1g} of the width of the photographs"
    elif blind > UNSEEN:
        problem = f"the mesh is outside of {blind:.0%} of the photographs"
        needs_factor = True  # otherwise, the axes may be wrong
    else:
        return None
    factors = _best_factors(vertices, some, None if points is None else ratio)
    return None if needs_factor and not factors else WrongScale(problem, factors)


def _best_factors(vertices: np.ndarray, sensors: Sequence[Any], ratio: float | None) -> list[float]:
    """Return the usual factor with which the cameras frame the mesh best, and similar ones.

    Without such a factor, the mesh may also have another up axis.
    """
    sizes = _framed_sizes(vertices, sensors, FACTORS)
    for turn in TURNS:
        sizes = sizes or _framed_sizes(vertices @ turn.T, sensors, (1.0, *FACTORS))
    if 1.0 in sizes:  # the axes are wrong, but not the unit
        return []

    def unlikely(factor: float) -> tuple[bool, float]:
        size = sizes[factor]
        return (size > 1, -size) if ratio is None else (False, abs(np.log(factor / ratio)))

    order = sorted(sizes, key=unlikely)
    return [factor for factor in order if 1 / ALIKE < factor / order[0] < ALIKE]


def _framed_sizes(
    vertices: np.ndarray, sensors: Sequence[Any], factors: Sequence[float]
) -> dict[float, float]:
    """Return the extent in the photographs by factor, for factors with a well-framed mesh."""
    sizes = {}
    for factor in factors:
        share, size, _ = framing(vertices * factor, sensors)
        if share >= FRAMED and SMALL <= size <= LARGE:
            sizes[factor] = size
    return sizes


def framing(vertices: np.ndarray, sensors: Sequence[Any]) -> tuple[float, float, float]:
    """Return how cameras frame (N, 3) ``vertices``.

    These are the mean share of visible vertices, their median extent relative to the film, and the
    share of cameras that see none.
    """
    shares, sizes = [], []
    for sensor in sensors:
        film = np.array(film_size(sensor))
        pixels, depth = projected(sensor, vertices)
        ahead = depth > 0
        shares.append((ahead & (pixels > 0).all(axis=1) & (pixels < film).all(axis=1)).mean())
        if ahead.any():
            sizes.append((np.ptp(pixels[ahead], axis=0) / film).max())
    extent = float(np.median(sizes)) if sizes else np.inf
    return float(np.mean(shares)), extent, float(np.mean(np.equal(shares, 0)))


def _ratio_of_points(points: np.ndarray, width: float) -> float:
    """Return the diagonal of the points' bounding box, without outliers, relative to the mesh."""
    with np.errstate(all="ignore"):  # damaged points may be huge
        diagonal = float(np.linalg.norm(np.ptp(np.quantile(points, [0.02, 0.98], axis=0), axis=0)))
    return diagonal / width if 0 < diagonal < np.inf else 1.0
