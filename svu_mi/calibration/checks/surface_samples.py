"""Surface points, their samples in photographs and texture, and distant light."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.calibration.checks.thumbnails import Thumbnails, tonemapped
from svu_mi.capture.capture import Capture
from svu_mi.capture.mesh import arrays, faces_at, unit_vectors
from svu_mi.capture.scene import environment_of, has_lamps, is_lit
from svu_mi.core.arrays import evenly_spaced, fibonacci, to_drjit
from svu_mi.geometry.sample_view import TexelLanes, sample_view
from svu_mi.light.band_limited import band_limited_lighting, look_up
from svu_mi.light.environment import basis_at, read_environment
from svu_mi.light.light_tree import LightCells, build_light_tree
from svu_mi.light.light_visibility import is_unoccluded
from svu_mi.light.prefiltered import FilteredLight, filter_light
from svu_mi.reflection.lobes import zonal_profile

COUNT = 2000
SEED = 6151
FACING = 0.25  # minimum cosine to the camera: grazing pixels contain background
OFFSET = 1e-4  # offset of ray origins, relative to the size of the object
FEWEST_VIEWS = 2  # views needed per point to measure agreement
FEWEST = 30  # points needed to compare a texture
PLAIN = 0.01  # standard deviation below which a base colour is constant
GLOSS = 0.04  # reflectance of a black dielectric
DARK = 0.01  # added before logarithms, in units of the photographs
SHADING_DEGREE = 2  # harmonics that contain 99 % of irradiance [Ramamoorthi and Hanrahan 2001]

DIRECTIONS = fibonacci(256)  # of visibility rays
CELLS, COARSE = 2048, 64  # fine and coarse cells of the light tree
SAME = 1e-3  # relative variation up to which a map is constant
WIDTHS = (0.06, 0.18, 0.4)  # alpha of the lobes for highlights


@dataclass(frozen=True)
class Points:
    """N points, evenly distributed over the surface of a mesh.

    Attributes:
        position: (N, 3) float64.
        normal: (N, 3) float64, unit shading normals.
        facing: (N, 3) float64, unit face normals, oriented like the shading normals.
        uv: (N, 2) float64; None if the mesh has no UVs.
        offset: Distance of ray origins from the surface.
    """

    position: np.ndarray
    normal: np.ndarray
    facing: np.ndarray
    uv: np.ndarray | None
    offset: float

    def subset(self, count: int) -> "Points":
        """Return at most ``count`` of the points, evenly distributed."""
        chosen = evenly_spaced(len(self.position), count)
        uv = None if self.uv is None else self.uv[chosen]
        return replace(self, position=self.position[chosen], normal=self.normal[chosen],
                       facing=self.facing[chosen], uv=uv)  # fmt: skip

    def surface(self, index: Any) -> TexelLanes:
        """Return the points at indices (UInt32) as kernel lanes."""

        def of(kind: Any, values: np.ndarray) -> Any:
            return dr.gather(kind, to_drjit(mi.Float, values.astype(np.float32).ravel()), index)

        return TexelLanes(
            position=of(mi.Point3f, self.position), normal=of(mi.Normal3f, self.normal),
            geometric_normal=of(mi.Normal3f, self.facing), offset=dr.opaque(mi.Float, self.offset),
        )  # fmt: skip


def scatter_points(mesh: Any, count: int = COUNT) -> Points:
    """Sample points on a mesh by area, with a fixed seed."""
    source = arrays(mesh)
    crosses = source.crosses
    random = np.random.default_rng(SEED)
    # Stratified by area.
    face = faces_at(crosses, (np.arange(count) + random.random(count)) / count)
    a, b = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - a, a * (1 - b), a * b], axis=-1)

    def mixed(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nki->ni", weights, values[source.faces[face]])

    flat = unit_vectors(crosses[face])
    normal = flat if source.normals is None else unit_vectors(mixed(source.normals))
    side = np.where(np.einsum("ni,ni->n", flat, normal) < 0, -1, 1)
    return Points(
        position=mixed(source.positions),
        normal=normal,
        facing=flat * side[:, None],
        uv=None if source.uvs is None else mixed(source.uvs),
        offset=OFFSET * float(np.linalg.norm(np.ptp(source.positions, axis=0))),
    )


@dataclass(frozen=True)
class PointSamples:
    """Samples of N points in V photographs.

    Attributes:
        seen: (V, N) bool: inside the image, not occluded, and with usable pixels.
        radiance: (V, N, 3) float32; 0 if not seen.
        toward: (V, N, 3) float32, unit directions to the cameras, in the frame of the mesh.
    """

    seen: np.ndarray
    radiance: np.ndarray
    toward: np.ndarray

    def mirrored(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """Return cosines (V, N) of normals and view directions, and mirror directions (V, N, 3)."""
        cosine = np.einsum("vni,ni->vn", self.toward, points.normal)
        return cosine, 2 * cosine[..., None] * points.normal - self.toward

    def typical(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the median radiance (N, 3) of points over views, and flags (N,) of seen points."""
        known = self.seen.sum(axis=0) >= 1
        values = np.where(self.seen[..., None], self.radiance, np.nan)
        result = np.zeros(values.shape[1:])
        result[known] = np.nanmedian(values[:, known], axis=0)
        return result, known


def sample_points(points: Points, frames: Thumbnails) -> PointSamples:
    """Sample all points in all photographs; poses are relative to the mesh of the scene."""
    shape = frames.views.number, len(points.position)
    view, point = _pairs(shape)
    surface = points.surface(point)
    sample = sample_view(frames.views, surface, view)
    facing = dr.minimum(sample.cosine, dr.dot(surface.geometric_normal, sample.direction)) > FACING
    seen = sample.seen & facing
    return PointSamples(
        seen=seen.numpy().reshape(shape),
        radiance=dr.select(seen, sample.radiance, 0).numpy().T.reshape(*shape, 3),
        toward=sample.direction.numpy().T.reshape(*shape, 3),
    )


def open_cosines(scene: Any, points: Points, directions: np.ndarray) -> np.ndarray:
    """Return cosines (N, K) of normals and directions (K, 3), float32; 0 if occluded."""
    shape = len(points.position), len(directions)
    point, cell = _pairs(shape)
    surface = points.surface(point)
    toward = to_drjit(mi.Float, directions.astype(np.float32).ravel())
    direction = dr.gather(mi.Vector3f, toward, cell)
    cosine = dr.dot(surface.normal, direction)
    above = (cosine > 0) & (dr.dot(surface.geometric_normal, direction) > 0)
    free = is_unoccluded(scene, surface, direction, above, coherent=False)
    return dr.select(free, cosine, 0).numpy().reshape(shape)


def _pairs(shape: tuple[int, int]) -> tuple[Any, Any]:
    """Return row and column (UInt32) of each entry of a table."""
    place, width = dr.arange(mi.UInt32, shape[0] * shape[1]), dr.opaque(mi.UInt32, shape[1])
    row = place // width
    return row, place - row * width


def agreement(sightings: PointSamples, spread: float) -> float:
    """Return the intraclass correlation of points over tone-mapped photographs, in [0, 1].

    It is 1 if points differ and each looks the same in all views. ``spread``: variance of the
    pixels; it prevents a high correlation for a constant background.
    """
    kept = sightings.seen.sum(axis=0) >= FEWEST_VIEWS
    if not kept.any():
        return 0.0
    seen, shown = sightings.seen[:, kept, None], tonemapped(sightings.radiance[:, kept])
    count = seen.sum(axis=0)
    mean = np.where(seen, shown, 0).sum(axis=0) / count
    within = np.where(seen, (shown - mean) ** 2, 0).sum(axis=0) / (count - 1)
    between = max(float((mean.var(axis=0) - (within / count).mean(axis=0)).mean()), 0.0)
    return between / (between + float(within.mean()) + 0.02 * spread + 1e-12)


@dataclass(frozen=True)
class Texture:
    """Base colour (N, 3) of the material at N points, as given and with V flipped."""

    albedo: np.ndarray
    flipped: np.ndarray

    def turned(self) -> "Texture":
        """Return the texture with V flipped."""
        return Texture(self.flipped, self.albedo)

    def fits(self, sightings: PointSamples, points: Points) -> list[tuple[float, np.ndarray]]:
        """Return ``texture_fit`` of the given and the flipped texture."""
        return [texture_fit(sightings, points, albedo) for albedo in (self.albedo, self.flipped)]


def read_texture(capture: Capture, points: Points) -> Texture | None:
    """Return the texture of the object; None if it is missing or constant."""
    if points.uv is None or capture.shape.bsdf() is None:
        return None
    albedo = base_color(capture.shape, points.uv)
    if not np.isfinite(albedo).all() or albedo.std(axis=0).mean() < PLAIN:
        return None
    return Texture(albedo, base_color(capture.shape, points.uv * [1, -1] + [0, 1]))


def base_color(shape: Any, uv: np.ndarray) -> np.ndarray:
    """Return the diffuse reflectance (N, 3) of a shape's material at texture coordinates."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = to_drjit(mi.Point2f, uv.T.astype(np.float32))
    si.wi = mi.Vector3f(0, 0, 1)
    color = shape.bsdf().eval_diffuse_reflectance(si)
    return np.stack(
        [np.broadcast_to(np.array(channel, float), len(uv)) for channel in color], axis=-1
    )


def texture_fit(
    sightings: PointSamples, points: Points, albedo: np.ndarray
) -> tuple[float, np.ndarray]:
    """Correlate a base colour (N, 3) with the photographs under unknown light.

    Logarithms of both are compared after regression on smooth shading.

    Returns:
        The correlation, and the residual variance (N,) of each point: mean 1 if nothing is
        explained, NaN if not seen.
    """
    shown, known = sightings.typical()
    misfit = np.full(len(albedo), np.nan)
    if known.sum() < FEWEST:
        return 0.0, misfit
    shading = basis_at(points.normal[known], SHADING_DEGREE)
    a, b = np.log(albedo[known] + GLOSS), np.log(shown[known] + DARK)
    # Also compare differences of channels, which depend less on the light.
    a, b = (np.concatenate([x, x - x.mean(axis=1, keepdims=True)], axis=1) for x in (a, b))
    a, b = (x - shading @ np.linalg.lstsq(shading, x, rcond=None)[0] for x in (a, b))
    a, b = (x / max(np.sqrt((x * x).sum()), 1e-12) for x in (a, b))
    correlation = float((a * b).sum())
    misfit[known] = known.sum() * ((b - max(correlation, 0.0) * a) ** 2).sum(axis=1)
    return correlation, misfit


@dataclass(frozen=True)
class DistantLight:
    """Distant light: flux (M, 3) of cells (radiance times solid angle) from unit directions (M, 3)
    in the frame of the map, light filtered by lobes of ``WIDTHS``, and the rotation (3, 3) from
    the mesh to the map."""

    flux: np.ndarray
    toward: np.ndarray
    lobes: FilteredLight
    to_local: np.ndarray

    @staticmethod
    def of(emitter: Any, mesh_turn: np.ndarray) -> "DistantLight":
        """Filter an emitter; ``mesh_turn`` (3, 3) is the rotation of the mesh by corrections."""
        environment = read_environment(emitter)
        flux, toward = read_cells(build_light_tree(environment, COARSE, CELLS).fine)
        return DistantLight(
            flux=flux,
            toward=toward @ environment.to_local.T,
            lobes=filter_light(
                band_limited_lighting(environment, 1), WIDTHS, partial(zonal_profile, "ggx")
            ),
            to_local=environment.to_local @ mesh_turn,
        )

    def arriving(self, matrix: np.ndarray) -> np.ndarray:
        """Return the flux (K, 3) near each of ``DIRECTIONS``; ``matrix`` (3, 3) rotates the map."""
        cell = scipy.spatial.cKDTree(self._local(DIRECTIONS, matrix)).query(self.toward)[1]
        count = len(DIRECTIONS)
        return np.stack([np.bincount(cell, self.flux[:, c], count) for c in range(3)], axis=-1)

    def reflected(self, directions: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Return light (L, S, 3) filtered by lobes around directions (S, 3) in mesh space."""
        local = to_drjit(mi.Vector3f, self._local(directions, matrix).T)
        lobes = [look_up(texture, local) for texture in self.lobes.textures]
        return np.array([[channel.numpy() for channel in one] for one in lobes]).swapaxes(1, 2)

    def _local(self, directions: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        return directions @ (matrix.T @ self.to_local).T


def read_cells(cells: LightCells) -> tuple[np.ndarray, np.ndarray]:
    """Return flux (M, 3) and world-space direction (M, 3) of M cells of the light."""
    flux, toward = (a.numpy().reshape(-1, 4)[:, :3] for a in (cells.flux, cells.toward))
    return flux, toward


def emitter_of(capture: Capture) -> Any:
    """Return the environment emitter of a capture; None without light, and if lamps add light."""
    return environment_of(capture) if is_lit(capture) and not has_lamps(capture) else None


def without_emitter(capture: Capture) -> str:
    """Return the reason why ``emitter_of`` is None."""
    return "light of lamps is not tested" if has_lamps(capture) else "no light was given"


def is_constant(emitter: Any) -> bool:
    """Return whether the light is a constant emitter or a map of one colour."""
    if emitter.class_name() != "EnvironmentMapEmitter":
        return bool(emitter.class_name() == "ConstantBackgroundEmitter")
    pixels = np.array(mi.traverse(emitter)["data"])
    return bool((np.ptp(pixels, axis=(0, 1)) <= SAME * pixels.max(axis=(0, 1))).all())
