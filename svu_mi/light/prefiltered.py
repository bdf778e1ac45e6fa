"""Environment light prefiltered by specular lobes of several widths.

A ``LightStack`` stores the maps of all roughness levels in one table and interpolates between
levels. The resolution of a level depends on its lobe width, so wide lobes need little memory.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.core.arrays import to_drjit
from svu_mi.light.band_limited import Lighting, lat_long_texture, look_up
from svu_mi.light.environment import Environment, lat_long, nearest_node
from svu_mi.light.latlong import column_weights, quadrature, row_weights

DELTA = 2e-3  # width [rad] below which a lobe is treated as a mirror
NEGLIGIBLE = 1e-5  # cut-off of a lobe, relative to its peak
COARSE = 10.0  # the coarsest map for a lobe of width alpha has COARSE / alpha + 1 rows
FEWEST = 33  # smallest number of rows

Profile = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class FilteredLight:
    """Light filtered by R lobes: one lat-long Texture2f of 1 or 3 channels for each."""

    textures: tuple[Any, ...]
    to_local: Any

    @property
    def count(self) -> int:
        """Number of levels R."""
        return len(self.textures)

    def radiance(self, level: int, direction: Any) -> list[Any]:
        """Look up one level *from* a world direction: one Float per channel."""
        return look_up(self.textures[level], self.to_local @ mi.Vector3f(direction))


def filter_light(
    lighting: Lighting,
    widths: Sequence[float],
    profile: Callable[[float, np.ndarray], np.ndarray],
    grey: bool = False,
    disk: bool = True,
) -> FilteredLight:
    """Convolve the light with lobes ``profile(alpha, cosine)``; cached."""
    cache = lighting.lobes
    keys = [(float(width), profile, grey, disk) for width in widths]
    missing = [key for key in keys if key not in cache]
    if missing:
        environment = lighting.environment
        grid = rasterized(environment) if disk else environment.radiance
        grid = grid.mean(axis=2, keepdims=True) if grey else grid
        for key in missing:
            cache[key] = lat_long_texture(convolve(grid, key[0], partial(profile, key[0])))
    return FilteredLight(textures=tuple(cache[key] for key in keys), to_local=lighting.to_local)


def rasterized(environment: Environment) -> np.ndarray:
    """Return the lat-long grid (H, W, 3) including the sun's disk."""
    grid = environment.radiance
    if not len(environment.disk_weights):
        return grid
    rows, columns = grid.shape[:2]
    solid = quadrature(rows) * (2 * np.pi / columns)
    row, column = nearest_node(environment.disk_directions, rows, columns)
    flux = environment.disk_radiance * environment.disk_weights[:, None]
    grid = grid.copy()
    np.add.at(grid, (row, column), flux / solid[row, None])
    return grid


def convolve(grid: np.ndarray, width: float, profile: Profile) -> np.ndarray:
    """Convolve a lat-long grid with a lobe; wide lobes reduce its size.

    Rows within the lobe's support are convolved along the azimuth by FFT.
    """
    if width < DELTA:
        return grid
    if (grid == grid[:1, :1]).all():
        return grid[:2, :2]
    flux = _coarsened(grid, width)
    rows, columns = flux.shape[:2]
    # Without coarsening, solid angle and norm of the lobe are constant along a row.
    even = flux.shape[:2] == grid.shape[:2]
    solid = flux[:, 0, -1]
    flux = flux[..., :-1] if even else flux
    theta = np.pi * np.arange(rows) / (rows - 1)
    turn = np.cos(2 * np.pi * np.arange(columns // 2 + 1) / columns)  # half, by symmetry
    weight = profile(np.cos(theta))
    reach = int(np.flatnonzero(np.abs(weight) > NEGLIGIBLE * weight[0])[-1]) + 1
    waves = np.fft.rfft(flux, axis=1)
    summed_waves = np.empty_like(waves)
    # By symmetry of the poles, one kernel is used for two rows.
    pairs = np.stack([waves, waves[::-1]], axis=2).view(np.float64).reshape(rows, len(turn), -1)
    pairs = np.ascontiguousarray(np.moveaxis(pairs, 1, 0))
    for i in range((rows + 1) // 2):
        near = slice(max(i - reach, 0), i + reach + 1)
        cosine = np.sin(theta[i]) * np.sin(theta[near, None]) * turn
        cosine += np.cos(theta[i]) * np.cos(theta[near, None])
        kernel = _even_spectrum(profile(np.clip(cosine, -1, 1)), columns)
        if even:
            kernel /= kernel[:, 0] @ solid[near]
        summed = np.ascontiguousarray(kernel.T)[:, None] @ pairs[:, near]
        both = summed.view(np.complex128).reshape(len(turn), 2, -1)
        summed_waves[i], summed_waves[rows - 1 - i] = both[:, 0], both[:, 1]
    result = np.fft.irfft(summed_waves, n=columns, axis=1)
    # Rounding of the FFT, and lobes with negative parts, may cause negative values.
    return np.maximum(result if even else result[..., :-1] / result[..., -1:], 0)


def _even_spectrum(half: np.ndarray, columns: int) -> np.ndarray:
    """Return the spectra of rows that are even functions of the azimuth, given by one half."""
    if columns % 2:
        return np.fft.hfft(half, n=columns, axis=1)[:, : half.shape[1]]
    return np.asarray(scipy.fft.dct(half, type=1, axis=1))


def _coarsened(grid: np.ndarray, width: float) -> np.ndarray:
    """Return flux and solid angle (H', W', C + 1) on a coarser grid."""
    rows, columns, channels = grid.shape
    solid, own = quadrature(rows), np.ones(columns)
    fewer = scipy.fft.next_fast_len(max(int(np.ceil(COARSE / width)), FEWEST - 1), real=True) + 1
    if fewer >= rows:
        flux = grid * solid[:, None, None]
    else:
        down = row_weights(fewer, rows) * solid[None]
        flux = (down @ grid.reshape(rows, -1)).reshape(fewer, columns, channels)
        solid, across = down.sum(axis=1), 2 * (fewer - 1)
        if across < columns:
            around = column_weights(across, columns)
            turned = np.moveaxis(flux, 1, 0)
            shared = (around @ turned.reshape(columns, -1)).reshape(across, fewer, channels)
            flux, own = np.moveaxis(shared, 0, 1), around.sum(axis=1)
    return np.concatenate([flux, np.outer(solid, own)[..., None]], axis=2)


PADDED = {1: 1, 3: 4}  # floats per node, by channels; colours are gathered as Vector4f


@dataclass(frozen=True)
class LightStack:
    """R lat-long maps of different sizes in one array.

    Attributes:
        values: Float, nodes of all maps in row-major order, with a wrapped column on each side;
            1 float per node, or 4 (R, G, B, 0).
        tables: (3 R,) UInt32: first node, rows and columns of each map.
    """

    values: Any
    tables: Any
    count: int
    channels: int
    to_local: Any

    def radiance(self, place: Any, direction: Any) -> list[Any]:
        """Look up light *from* a world direction, interpolated between levels."""
        u, v = lat_long(self.to_local @ mi.Vector3f(direction))
        level = dr.clip(mi.Int32(dr.detach(place)), 0, self.count - 2)
        here, above = (self._at(mi.UInt32(level + step), u, v) for step in (0, 1))
        part = place - level
        return [dr.lerp(a, b, part) for a, b in zip(here, above, strict=True)]

    def _at(self, level: Any, u: Any, v: Any) -> list[Any]:
        """Interpolate in one map, whose first and last rows are at the poles."""
        first, rows, columns = (dr.gather(mi.UInt32, self.tables, 3 * level + k) for k in range(3))
        x = u * columns + 0.5  # column 0 is the wrapped one
        y = v * (rows - 1)
        left = dr.minimum(mi.UInt32(dr.detach(x)), columns)
        top = dr.minimum(mi.UInt32(dr.detach(y)), rows - 2)
        fx, fy = x - left, y - top
        width = columns + 2
        node = first + top * width + left
        a, b, c, d = (self._node(node + step) for step in (0, 1, width, width + 1))
        return [
            dr.lerp(dr.lerp(a[k], b[k], fx), dr.lerp(c[k], d[k], fx), fy)
            for k in range(self.channels)
        ]

    def _node(self, index: Any) -> list[Any]:
        if self.channels == 1:
            return [dr.gather(mi.Float, self.values, index)]
        return list(dr.gather(mi.Vector4f, self.values, index))[:3]


def stack_levels(light: FilteredLight) -> LightStack:
    """Copy the maps of at least two levels, (H, W, C) with C = 1 or 3, into one table."""
    maps = [np.array(texture.tensor()) for texture in light.textures]
    channels = maps[0].shape[2]
    tables, flat, first = [], [], 0
    for grid in maps:
        rows, columns = grid.shape[:2]
        around = np.pad(grid, ((0, 0), (1, 1), (0, 0)), "wrap")
        padded = np.pad(around, ((0, 0), (0, 0), (0, PADDED[channels] - channels)))
        tables += [first, rows, columns]
        flat.append(padded.ravel())
        first += rows * (columns + 2)
    return LightStack(
        values=to_drjit(mi.Float, np.concatenate(flat)),
        tables=to_drjit(mi.UInt32, np.array(tables, np.uint32)),
        count=len(maps),
        channels=channels,
        to_local=light.to_local,
    )
