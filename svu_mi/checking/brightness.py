"""Photographs that are too bright for the light: a gain that all of them share.

No opaque surface shows more than all the light that reaches it, in every direction: where nearly
all of several views are brighter than a white diffuse surface would be, photographs and light do
not have the same unit. What is too dark cannot be told from dark paint.

Constants are chosen on our own objects and lights, and eight uniform materials, in 8 to 24
views. As they are, our own textures reach .3 % of the surface, white paint (base colour .9, in
the sun) 8 %. Twice as bright, our own textures reach 14 to 80 %, and 4 to 80 % in 8 views.

Whiter paint reaches more of the surface, 16 % at .95 and 40 % at 1, but is at most 1.14 and 1.15
times as bright as white. Twice as bright in 24 views, our own textures reach 1.18 to 1.76, but for
the knot by the window with 1.11, which nothing tells from paint. Polished metal is three times as
bright as white where it mirrors a window: what is seen from one side only is not judged. All of
that is of 512 cells of the light; with 1024, factors differ by .002 at most, and parts by .001.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from svu_mi.checking.frames import Frames
from svu_mi.checking.points import Points, Sightings, look, open_cosines, scatter_points
from svu_mi.checking.sky import COARSE, DIRECTIONS, read_cells
from svu_mi.errors import SvuWarning
from svu_mi.light.cells import Cells, light_cells

if TYPE_CHECKING:
    from svu_mi.capture import Capture
    from svu_mi.light.environment import Environment
    from svu_mi.pipeline import Estimate

CELLS = 1024  # of the light, as many as are traced by default; smaller where it is brighter
FACING = 0.5  # cosine to the camera: towards the rim, gloss reflects more than it should
LEAST = 3  # views that see a point
NARROW = 0.95  # length of the mean of unit directions to them; of a cone of 50 degrees
DIMMER = 5  # one of so many views may be dimmer than white: of many, noise makes one dim
LIT = 0.8  # of the median light: in shadow, most light comes from the object itself
OPEN = 0.9  # of the sky that is free, weighted by the cosine, for the same reason
AROUND = 2.0  # brightness of what hides the rest, in the mean of what is seen of the object
FEWEST = 50  # points
MOST = 0.1  # of the points, that may be brighter than white
WHITEST = 1.16  # times white, that gloss and light from the object itself make of white paint
BRIGHT = 0.98  # of the points, that are less bright than the factor that is told


@dataclass(frozen=True)
class Arriving:
    """What of the light reaches N points.

    Attributes:
        white: (N, 3) radiance of a white diffuse surface there, irradiance / pi.
        free: (N,) part of the sky that nothing hides, weighted by the cosine.
    """

    white: np.ndarray
    free: np.ndarray

    @staticmethod
    def of(
        scene: Any, points: Points, environment: Environment, cells: Cells | None = None
    ) -> Arriving:
        """Sum the light's cells; what hides them is traced in a few even directions.

        Args:
            scene: what hides.
            points: N points.
            environment: the light.
            cells: of it, where they have been gathered.
        """
        cells = cells or light_cells(environment, COARSE, CELLS).fine
        flux, toward = read_cells(cells)
        cosines = open_cosines(scene, points, DIRECTIONS)
        whole = np.maximum(points.normal @ DIRECTIONS.T, 0)
        # A cell is hidden if the direction next to it is; what lies below the horizon hides none.
        free = (cosines > 0) | (whole <= 0)
        nearest = scipy.spatial.cKDTree(DIRECTIONS).query(toward)[1]
        arriving = points.normal.astype(np.float32) @ toward.T  # fresh memory takes time: once
        np.maximum(arriving, 0, out=arriving)
        arriving *= free[:, nearest]
        white = (arriving @ flux).astype(np.float64) / np.pi
        return Arriving(white, cosines.sum(axis=1) / whole.sum(axis=1))


@dataclass(frozen=True)
class Excess:
    """How much is brighter than white.

    Attributes:
        part: of the points that can be judged, in [0, 1].
        factor: that photographs are too bright by at least, if any are.
    """

    part: float
    factor: float

    @property
    def sentence(self) -> str | None:
        """What is wrong, and what to do; None if nothing is."""
        if self.part <= MOST or self.factor <= WHITEST:
            return None
        return (
            f"{100 * self.part:.0f} % of the surface reflects more than all the light that reaches "
            f"it: the photographs are too bright for this light, by a factor of {self.factor:.1f} "
            "or more; check their gain (svu import --exposures, or divide the "
            "photographs) and the light's (--environment-scale, or scale in the scene)."
        )

    @property
    def of_found_light(self) -> str | None:
        """The same where the light was found in these photographs, up to its brightness."""
        if self.sentence is None:
            return None
        return (
            f"{100 * self.part:.0f} % of the surface reflects more than all the light that was "
            f"found, which is too dark by a factor of {self.factor:.1f} or more; fix its "
            "brightness with --grey-card, --mean-albedo or --light-scale of svu light."
        )


def excess(sightings: Sightings, points: Points, arriving: Arriving, unit: float) -> Excess | None:
    """Hold what views show against the light; None if too few points can be judged.

    Args:
        sightings: what V views show of N points.
        points: those.
        arriving: the light there.
        unit: radiance of a sighting of 1.
    """
    seen = sightings.seen & (_cosine(sightings, points) > FACING)
    views, brightness = seen.sum(axis=0), arriving.white.mean(axis=1)
    judged = (views >= LEAST) & (arriving.free > OPEN) & _around(sightings, seen)
    judged &= (brightness >= LIT * np.median(brightness)) & (brightness > 0)
    if judged.sum() < FEWEST:
        return None
    around = AROUND * unit * sightings.radiance[sightings.seen].mean(axis=0)
    white = arriving.white + np.clip(1 - arriving.free, 0, 1)[:, None] * around
    shown = np.where(seen[..., None], unit * sightings.radiance, np.inf)[:, judged]
    dim = views[judged] // DIMMER
    dimmest = np.take_along_axis(np.sort(shown, axis=0), dim[None, :, None], axis=0)[0]
    ratio = (dimmest / np.maximum(white[judged], 1e-300)).max(axis=1)
    return Excess(float((ratio > 1).mean()), float(np.quantile(ratio, BRIGHT)))


def _around(sightings: Sightings, seen: np.ndarray) -> np.ndarray:
    """Return which points (N,) are seen from many sides: all might mirror one lamp otherwise."""
    total = np.einsum("vn,vni->ni", seen, sightings.toward)
    return np.linalg.norm(total, axis=1) < NARROW * seen.sum(axis=0)


def _cosine(sightings: Sightings, points: Points) -> np.ndarray:
    return np.einsum("vni,ni->vn", sightings.toward, points.normal)


def unit_of(capture: Capture, small: Capture) -> float:
    """Return the radiance that a pixel of 1 in a reduced capture stands for."""
    view = capture.used.index(True)
    return small.exposures[view] / capture.exposures[view]


def too_bright(estimate: Estimate) -> str | None:
    """Return what is wrong if an estimate's photographs are too bright for its light, or None."""
    seen = estimate.observed
    if seen is None:
        return None
    points = scatter_points(seen.capture.shape)
    sightings = look(points, Frames(seen.capture, seen.views, np.zeros((0, 4, 4))))
    light = seen.lighting.environment, seen.cells(CELLS).fine
    arriving = Arriving.of(seen.capture.scene, points, *light)
    found = excess(sightings, points, arriving, 1.0)
    if found is None:
        return None
    return found.sentence if seen.capture.found_light is None else found.of_found_light


def warn_if_too_bright(estimate: Estimate) -> None:
    """Warn of what ``too_bright`` says."""
    sentence = too_bright(estimate)
    if sentence is not None:
        warnings.warn(sentence, SvuWarning, stacklevel=2)
