"""Checks of the common brightness of photographs, and of saturation.

Seen from many sides, an opaque surface is not brighter than a white diffuse surface.
If photographs exceed this bound (``Excess``), the units of photographs and light differ. Too dark
photographs are not detected: they look like dark paint. The constants were chosen on the included
objects and lights and eight uniform materials, in 8 to 24 views. With correct units, the included
textures exceed the bound on 0.3 % of the surface, white paint (base colour 0.9, in the sun) on 8 %,
whiter paint on 16 % (0.95) and 40 % (1), by factors of at most 1.15. In photographs twice as
bright, the included textures exceed it on 14 to 80 % of the surface (24 views; 8 views: 4 to 80 %)
by factors of 1.18 to 1.76 (1.11 for the knot by the window). Polished metal that mirrors a window
is three times as bright as white, but from one side only.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy

from svu_mi.calibration.checks.surface_samples import (
    COARSE,
    DIRECTIONS,
    Points,
    PointSamples,
    open_cosines,
    read_cells,
    sample_points,
    scatter_points,
)
from svu_mi.calibration.checks.thumbnails import Thumbnails, silhouettes
from svu_mi.capture.scene import has_lamps
from svu_mi.light.light_tree import LightCells, build_light_tree

if TYPE_CHECKING:
    from svu_mi.capture.capture import Capture
    from svu_mi.light.environment import Environment
    from svu_mi.posterior.estimate import Estimate

LEAST = 3  # views needed per point

CELLS = 1024  # cells of the light tree, smaller in bright regions
FACING = 0.5  # minimum cosine to the camera: grazing gloss exceeds the bound
NARROW = 0.95  # length of the mean camera direction: a cone of 50 degrees
DIMMER = 5  # one of 5 views may be below the bound, due to noise
LIT = 0.8  # minimum irradiance relative to the median: interreflection dominates in shadow
OPEN = 0.9  # minimum unoccluded fraction of the sky, cosine-weighted
AROUND = 2.0  # radiance of occluders, relative to the mean of the object
FEWEST = 50  # reliable points needed
MOST = 0.1  # fraction of points that may exceed the bound
# Fraction of the object. In 24 8-bit photographs of vase and knot by studio and window, base colour
# loses 0.4 to 1.8 dB if 11 % are saturated, and 1.0 to 2.9 dB if 31 % are.
SATURATED = 0.1
WHITEST = 1.16  # factor of gloss and interreflection on white paint
BRIGHT = 0.98  # reported quantile of the factors


class Irradiance(NamedTuple):
    """Radiance (N, 3) of a white diffuse surface (irradiance / pi) at N points, and unoccluded
    fraction (N,) of the sky, weighted by the cosine."""

    white: np.ndarray
    free: np.ndarray

    @staticmethod
    def of(
        scene: Any, points: Points, environment: "Environment", cells: LightCells | None = None
    ) -> "Irradiance":
        """Sum irradiance over cells of the light; trace occlusion in a few even directions."""
        cells = cells or build_light_tree(environment, COARSE, CELLS).fine
        flux, toward = read_cells(cells)
        cosines = open_cosines(scene, points, DIRECTIONS)
        whole = np.maximum(points.normal @ DIRECTIONS.T, 0)
        # A cell is occluded if its nearest direction is; directions below the horizon are not.
        free = (cosines > 0) | (whole <= 0)
        nearest = scipy.spatial.cKDTree(DIRECTIONS).query(toward)[1]
        arriving = points.normal.astype(np.float32) @ toward.T  # modified in place, to save memory
        np.maximum(arriving, 0, out=arriving)
        arriving *= free[:, nearest]
        white = (arriving @ flux).astype(np.float64) / np.pi
        return Irradiance(white, cosines.sum(axis=1) / whole.sum(axis=1))


class Excess(NamedTuple):
    """Fraction of points brighter than white; 0.98 quantile of brightness relative to white."""

    part: float
    factor: float

    def sentence(self, *, estimated: bool = False) -> str | None:
        """Return a description of the problem and its remedy; None without a problem.

        ``estimated``: the light was estimated from these photographs, up to its scale.
        """
        if self.part <= MOST or self.factor <= WHITEST:
            return None
        part = f"{100 * self.part:.0f} % of the surface reflects more light than it receives"
        if estimated:
            return (
                f"{part}: the estimated light is too dark by a factor of {self.factor:.1f} or "
                "more; set it with --grey-card, --mean-albedo or --light-scale of svu light."
            )
        return (
            f"{part}: the photographs are too bright for this light, by a factor of "
            f"{self.factor:.1f} or more; check their gain (svu import --exposures, or divide the "
            "photographs) and the scale of the light (--environment-scale, or scale in the scene)."
        )


def excess_of(
    samples: PointSamples, points: Points, light: Irradiance, unit: float
) -> Excess | None:
    """Compare N points in V views with a white surface; None if too few are reliable.

    ``unit``: radiance of a sample value of 1.
    """
    cosine, _ = samples.mirrored(points)
    seen = samples.seen & (cosine > FACING)
    views, brightness = seen.sum(axis=0), light.white.mean(axis=1)
    reliable = (views >= LEAST) & (light.free > OPEN) & _seen_from_many_sides(samples, seen)
    reliable &= (brightness >= LIT * np.median(brightness)) & (brightness > 0)
    if reliable.sum() < FEWEST:
        return None
    around = AROUND * unit * samples.radiance[samples.seen].mean(axis=0)
    white = light.white + np.clip(1 - light.free, 0, 1)[:, None] * around
    shown = np.where(seen[..., None], unit * samples.radiance, np.inf)[:, reliable]
    dim = views[reliable] // DIMMER
    dimmest = np.take_along_axis(np.sort(shown, axis=0), dim[None, :, None], axis=0)[0]
    ratio = (dimmest / np.maximum(white[reliable], 1e-300)).max(axis=1)
    return Excess(float((ratio > 1).mean()), float(np.quantile(ratio, BRIGHT)))


def _seen_from_many_sides(sightings: PointSamples, seen: np.ndarray) -> np.ndarray:
    """Return flags (N,) of points seen from many sides, not only along one reflection."""
    total = np.einsum("vn,vni->ni", seen, sightings.toward)
    return np.linalg.norm(total, axis=1) < NARROW * seen.sum(axis=0)


def unit_of(capture: "Capture", small: "Capture") -> float:
    """Return the radiance of a pixel value of 1 in a reduced capture."""
    view = capture.used.index(True)
    return small.exposures[view] / capture.exposures[view]


def too_bright(estimate: "Estimate") -> str | None:
    """Return a message if the photographs are too bright for the light, else None."""
    seen = estimate.observed
    if seen is None or has_lamps(seen.capture):
        return None
    points = scatter_points(seen.capture.shape)
    sightings = sample_points(points, Thumbnails(seen.capture, seen.views, np.zeros((0, 4, 4))))
    light = seen.lighting.environment, seen.light_tree(CELLS).fine
    arriving = Irradiance.of(seen.capture.scene, points, *light)
    excess = excess_of(sightings, points, arriving, 1.0)
    return excess and excess.sentence(estimated=seen.capture.found_light is not None)


def warn_of_exposure(capture: "Capture", estimate: "Estimate") -> "Capture":
    """Warn of photographs that are too bright for their light or saturated; return the capture with
    these warnings."""
    sentences, seen = [too_bright(estimate)], estimate.observed
    if seen is not None and seen.clipped_coverage is not None:
        share = float(seen.clipped_coverage.sum() / max(seen.shown.sum(), 1))
        sentences.append(saturation_sentence(share, "the samples of texels"))
    return capture.warned(*filter(None, sentences))


def saturated_share(capture: "Capture", small: "Capture") -> float:
    """Return the saturated or unusable part of the object's pixels; ``small``: reduced capture."""
    over, inside = 0, 0
    frames, views = Thumbnails.of(small), np.flatnonzero(capture.used)
    for view, seen, mask in zip(views, silhouettes(frames), frames.masks, strict=True):
        shown, saturation = seen if mask is None else seen & mask, capture.clipped[view]
        inside += shown.sum()
        step = min(capture.images[view].shape[k] // shown.shape[k] for k in (0, 1))
        middle = np.s_[step // 2 :: step, step // 2 :: step]
        lost = ~np.isfinite(capture.images[view][middle]).all(axis=2)
        if saturation is not None:
            lost |= saturation.channels[middle] > 0
        over += lost[: len(shown), : shown.shape[1]][shown].sum()
    return float(over / max(inside, 1))


def saturation_sentence(share: float, of: str = "the object's pixels") -> str | None:
    """Return a warning if a larger share than ``SATURATED`` is saturated, else None."""
    if share <= SATURATED:
        return None
    return (
        f"{100 * share:.0f} % of {of} are saturated or unusable: base colour and "
        "roughness will be off; photograph with a shorter exposure, or in HDR."
    )
