"""Environment light: sampling and spherical harmonics (NumPy).

Directions are in the emitter's *local* frame, where lat-long maps have their pole on +Y:
theta = acos(y), phi = atan2(x, -z) in [0, 2 pi). Spherical harmonics are real and orthonormal, in
the order l*l + l + m of ``drjit.sh_eval``, in the *polar* frame (z, x, y).
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import scene
from svu_mi.capture.image_io import clamp_negative
from svu_mi.errors import SceneError, warn
from svu_mi.light import latlong
from svu_mi.light.latlong import directions, emitter_label, quadrature, radiance_from

GREY = 1e-6  # largest difference of grey channels, relative to the brightest
POLE = 1e-12  # squared sine of theta below which phi is arbitrary
BAND = 2**18  # values of a map that are transformed at once
NO_DISK = np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
SUN_RINGS, SUN_SPOKES = 16, 64  # nodes on the sun's disk; finer than the sky grid


@dataclass(frozen=True)
class Environment:
    """Distant light: lat-long nodes, plus nodes on a small disk (a sun).

    Attributes:
        radiance: (H, W, 3) float64 at theta_j = j pi / (H - 1), phi_i = (i + 0.5) 2 pi / W, at most
            1025 x 2048. The first and last rows are the poles.
        disk_directions: (N, 3) float64, local directions.
        disk_weights: (N,) float64, solid angles [sr].
        disk_radiance: (N, 3) float64, added to ``radiance``.
        to_local: (3, 3) float64, world to local rotation (may mirror).
    """

    radiance: np.ndarray
    disk_directions: np.ndarray
    disk_weights: np.ndarray
    disk_radiance: np.ndarray
    to_local: np.ndarray

    @property
    def grey(self) -> bool:
        """True if channels are equal in every direction (tolerance 1e-6)."""
        return all(
            bool((np.ptp(values, axis=-1) <= GREY * values.max(axis=-1)).all())
            for values in (self.radiance, self.disk_radiance)
        )

    def coefficients(self, degree: int) -> np.ndarray:
        """Project the light onto spherical harmonics, ((degree + 1)^2, 3) float64."""
        result = analyze(self.radiance, degree)
        if len(self.disk_weights):
            basis = basis_at(polar_from_local(self.disk_directions), degree)
            result += basis.T @ (self.disk_weights[:, None] * self.disk_radiance)
        return result


def read_environment(emitter: Any) -> Environment:
    """Sample an environment emitter; raise if it is invalid or black."""
    to_world = scene.to_world(emitter)[:3, :3]
    if not np.allclose(to_world.T @ to_world, np.eye(3), atol=1e-3):
        raise SceneError(
            f"Emitter '{emitter.id()}': to_world must be a rotation; remove its scale or shear."
        )
    grid = latlong.sample_emitter(emitter, to_world, *latlong.grid_size(emitter))
    disk = NO_DISK
    if emitter.class_name() == "SunskyEmitter":
        grid, disk = _split_sun(emitter, grid, directions(*latlong.SKY_GRID), to_world)
    if not np.isfinite(grid).all():
        raise SceneError(f"{emitter_label(emitter)} has NaN or infinite radiance; repair its map.")
    pixels = latlong.envmap_pixels(emitter, grid)
    for note in clamp_negative(pixels, emitter_label(emitter), SceneError)[1]:
        warn(note)
    grid = np.maximum(grid, 0)
    if not (grid.max() > 0 or disk[2].max(initial=0) > 0):
        raise SceneError(f"Emitter '{emitter.id()}' is black; check its map or radiance.")
    return Environment(grid, *disk, to_local=to_world.T)


def no_environment() -> Environment:
    """Return a black environment, of scenes that have lamps only."""
    return Environment(np.zeros((9, 16, 3)), *NO_DISK, to_local=np.eye(3))


def lat_long(local: Any) -> tuple[Any, Any]:
    """Return phi / 2 pi in [0, 1) and theta / pi of local directions; derivatives are finite."""
    if dr.is_array_v(local):
        # At a pole, phi has no derivative; acos(y) has an infinite one where y rounds to 1.
        square = dr.fma(local.x, local.x, local.z * local.z)
        pole = square < POLE
        u = dr.atan2(local.x, dr.select(pole, 1, -local.z)) * dr.inv_two_pi
        sine = dr.sqrt(dr.select(pole, POLE, square))
        return u - dr.floor(dr.detach(u)), dr.atan2(sine, local.y) * dr.inv_pi
    x, y, z = np.moveaxis(local, -1, 0)
    return np.arctan2(x, -z) / (2 * np.pi) % 1, np.arccos(np.clip(y, -1, 1)) / np.pi


def nearest_node(local: np.ndarray, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column of the map node nearest to local directions (..., 3)."""
    u, v = lat_long(local)
    return np.rint(v * (rows - 1)).astype(int), (u * columns).astype(int) % columns


def _split_sun(
    emitter: Any, grid: np.ndarray, local: np.ndarray, to_world: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Replace the sun's disk, which the grid cannot resolve, by separate nodes."""
    # In Mitsuba 3.9, the sun's direction is in world space, independent of to_world.
    sun = np.array(mi.traverse(emitter)["sun_direction"], np.float64).ravel()[:3] @ to_world
    sun /= np.linalg.norm(sun)
    brightest = radiance_from(emitter, sun[None] @ to_world.T)[0]
    radius = _disk_radius(emitter, sun, to_world, brightest)
    if radius == 0:
        return grid, NO_DISK
    inside = local @ sun >= np.cos(radius * 1.05)
    around = (local @ sun >= np.cos(radius * 1.05 + 0.03)) & ~inside
    sky = grid[around].mean(axis=0)
    grid = grid.copy()
    grid[inside] = sky
    # Gauss-Legendre nodes in the cosine of the angle from the centre, uniform in azimuth.
    nodes, weights = np.polynomial.legendre.leggauss(SUN_RINGS)
    height = 1 - np.cos(radius)
    cos = 1 - height * (nodes + 1) / 2
    spokes = 2 * np.pi * (np.arange(SUN_SPOKES) + 0.5) / SUN_SPOKES
    side = np.linalg.svd(sun[None])[2][1:]
    around_sun = np.cos(spokes)[:, None] * side[0] + np.sin(spokes)[:, None] * side[1]
    points = cos[:, None, None] * sun + np.sqrt(1 - cos**2)[:, None, None] * around_sun
    solid = np.repeat(weights / 2 * height * 2 * np.pi / SUN_SPOKES, SUN_SPOKES)
    points = points.reshape(-1, 3)
    excess = np.maximum(radiance_from(emitter, points @ to_world.T) - sky, 0)
    return grid, (points, solid, excess)


def _disk_radius(
    emitter: Any, sun: np.ndarray, to_world: np.ndarray, brightest: np.ndarray
) -> float:
    """Return the sun's angular radius [rad]; 0 if it cannot be detected."""
    side = np.linalg.svd(sun[None])[2][1]

    def lit(angle: np.ndarray) -> np.ndarray:
        ray = np.cos(angle)[:, None] * sun + np.sin(angle)[:, None] * side
        return radiance_from(emitter, ray @ to_world.T).sum(axis=1) > 0.2 * brightest.sum()

    low, high = 0.0, np.radians(20)
    if not lit(np.array([0.0]))[0] or lit(np.array([high]))[0]:
        return 0.0
    for _ in range(4):  # each step reduces the interval by a factor of 64
        angle = np.linspace(low, high, 65)
        edge = int(np.flatnonzero(lit(angle))[-1])
        low, high = angle[edge], angle[edge + 1]
    return float(high)


def polar_from_local(local: np.ndarray) -> np.ndarray:
    """Convert local directions (..., 3) to the polar frame (z, x, y)."""
    return np.roll(local, 1, axis=-1)


def analyze(grid: np.ndarray, degree: int) -> np.ndarray:
    """Project a lat-long grid (H, W, C) onto SH, ((degree + 1)^2, C)."""
    rows, columns = grid.shape[:2]
    # phi is measured from -Z; the azimuth of the polar frame (from +Z) is pi - phi.
    m = np.arange(degree + 1)
    turn = np.exp(-1j * np.pi * m * (1 - 1 / columns)) * (2 * np.pi / columns)
    # In bands of rows, because FFTs convert their input to complex numbers.
    bands = np.array_split(grid, -(-grid.size // BAND))
    rings = np.concatenate([np.fft.ifft(b, axis=1, norm="forward")[:, m % columns] for b in bands])
    rings = np.moveaxis(rings, 1, 0) * turn[:, None, None] * quadrature(rows)[None, :, None]
    legendre = associated_legendre(np.cos(np.pi * np.arange(rows) / (rows - 1)), degree)
    result = np.zeros(((degree + 1) ** 2, grid.shape[2]))
    for order in range(degree + 1):
        part = legendre[order:, order] @ rings[order]  # (degree + 1 - order, C)
        for l in range(order, degree + 1):
            c = part[l - order]
            if order == 0:
                result[l * l + l] = c.real
            else:
                result[l * l + l + order] = np.sqrt(2) * c.real
                result[l * l + l - order] = -np.sqrt(2) * c.imag
    return result


def synthesize(coefficients: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """Evaluate an SH expansion on a lat-long grid, (rows, columns, C)."""
    degree = int(np.sqrt(len(coefficients))) - 1
    azimuth = np.pi - 2 * np.pi * (np.arange(columns) + 0.5) / columns
    legendre = associated_legendre(np.cos(np.pi * np.arange(rows) / (rows - 1)), degree)
    even, odd = np.zeros((2, rows, degree + 1, coefficients.shape[1]))
    for order in range(degree + 1):
        l = np.arange(order, degree + 1)
        table = legendre[order:, order].T * (np.sqrt(2) if order else 1.0)  # (rows, orders of l)
        even[:, order] = table @ coefficients[l * l + l + order]
        if order:
            odd[:, order] = table @ coefficients[l * l + l - order]
    angle = np.outer(np.arange(degree + 1), azimuth)
    # One product for all rows and orders is ten times faster than a loop over orders.
    result = np.tensordot(even, np.cos(angle), (1, 0)) + np.tensordot(odd, np.sin(angle), (1, 0))
    return np.ascontiguousarray(np.moveaxis(result, 2, 1))


def basis_at(polar: np.ndarray, degree: int) -> np.ndarray:
    """Evaluate SH in polar-frame directions (N, 3): (N, (degree + 1)^2)."""
    legendre = associated_legendre(np.clip(polar[:, 2], -1, 1), degree)
    azimuth = np.arctan2(polar[:, 1], polar[:, 0])
    result = np.zeros(((degree + 1) ** 2, len(polar)))
    for m in range(degree + 1):
        l = np.arange(m, degree + 1)
        scaled = legendre[m:, m] * (np.sqrt(2) if m else 1)
        result[l * l + l - m] = scaled * np.sin(m * azimuth)
        result[l * l + l + m] = scaled * np.cos(m * azimuth)
    return np.ascontiguousarray(result.T)


def associated_legendre(x: np.ndarray, degree: int) -> np.ndarray:
    """Return normalised associated Legendre functions P(l, m, x).

    P(l, m, cos theta) e^(i m phi) are orthonormal, with the Condon-Shortley sign of ``dr.sh_eval``.
    """
    table = np.zeros((degree + 1, degree + 1, len(x)))
    sin = np.sqrt(np.maximum(1 - x * x, 0))
    table[0, 0] = np.sqrt(1 / (4 * np.pi))
    for m in range(1, degree + 1):
        table[m, m] = -np.sqrt((2 * m + 1) / (2 * m)) * sin * table[m - 1, m - 1]
    for m in range(degree):
        table[m + 1, m] = np.sqrt(2 * m + 3) * x * table[m, m]
        for l in range(m + 2, degree + 1):
            a = np.sqrt((4 * l * l - 1) / (l * l - m * m))
            b = np.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
            table[l, m] = a * (x * table[l - 1, m] - b * table[l - 2, m])
    return table
