"""Textures of band-limited radiance, irradiance and diffuse moments."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.scene import find_light, require_light
from svu_mi.light import latlong
from svu_mi.light.environment import (
    Environment,
    lat_long,
    no_environment,
    read_environment,
    synthesize,
)

MIN_DEGREE, MAX_DEGREE = 24, 64
COSINE_DEGREE, COSINE_ROWS = 16, 97
NEGLIGIBLE = 1e-4  # filter value below which degrees are omitted
TEXELS_PER_WAVE = 24  # rows per period of the highest degree; bilinear error below 1 %


@dataclass(eq=False)
class Lighting:
    """Light of a capture, band-limited for v views; maps are computed lazily.

    Attributes:
        prefilter: Width alpha' = v^(-1/2) of the band limit.
        to_local: Rotation from world space to the light's frame, Matrix3f.
        lobes: Cache of ``filter_light``, with a Texture2f for each lobe.
    """

    environment: Environment
    prefilter: float
    to_local: Any
    lobes: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def degree(self) -> int:
        """Highest degree that is not negligible after band-limiting, exp(-(alpha' l)^2)."""
        degree = int(np.ceil(np.sqrt(-np.log(NEGLIGIBLE)) / self.prefilter))
        return int(np.clip(degree, MIN_DEGREE, MAX_DEGREE))

    @cached_property
    def coefficients(self) -> np.ndarray:
        """SH coefficients *before* band-limiting, ((degree + 1)^2, 3)."""
        return self.environment.coefficients(self.degree)

    @cached_property
    def filtered(self) -> Any:
        """Texture2f of the band-limited radiance."""
        smooth = np.exp(-((self.prefilter * degrees(self.degree)) ** 2))
        return _texture(self.coefficients * smooth[:, None])

    @cached_property
    def irradiance_map(self) -> Any:
        """Texture2f of the irradiance."""
        # Cosine lobes fall off as l^-2, and odd degrees above 1 vanish: beyond 16, 0.2 %.
        cosine = zonal_cosine(COSINE_DEGREE)[degrees(COSINE_DEGREE)]
        coefficients = self.environment.coefficients(COSINE_DEGREE) * cosine[:, None]
        return lat_long_texture(synthesize(coefficients, 2 * (COSINE_ROWS - 1), COSINE_ROWS))

    def radiance(self, direction: Any) -> Any:
        """Look up the band-limited radiance *from* a world direction, Color3f."""
        return self._look_up(self.filtered, direction)

    def irradiance(self, normal: Any) -> Any:
        """Look up the unoccluded irradiance by world normal, Color3f."""
        return self._look_up(self.irradiance_map, normal)

    def _look_up(self, texture: Any, direction: Any) -> Any:
        return mi.Color3f(*look_up(texture, self.to_local @ mi.Vector3f(direction)))


def look_up(texture: Any, local: Any) -> list[Any]:
    """Look up a lat-long map in a local direction: one Float per channel."""
    u, v = lat_long(local)
    # First and last row of a map are at the poles; Texture2f assumes centres (j + 0.5) / H.
    rows = dr.opaque(mi.Float, texture.shape[0])  # a literal would recompile for each map size
    v = (v * (rows - 1) + 0.5) / rows
    return texture.eval(mi.Point2f(u, v))


def read_lighting(capture: Capture, views: int) -> Lighting:
    """Read a capture's distant light; band-limit it by alpha' = v^(-1/2) (Sec. 3.3.2).

    It is black if the scene has lamps or a flash only.
    """
    require_light(capture)
    emitters, name = capture.scene.emitters(), str(capture.source or "scene")
    light = find_light(capture.scene, name) if emitters else None
    environment = no_environment() if light is None else read_environment(light)
    return band_limited_lighting(environment, views)


def band_limited_lighting(environment: Environment, views: int) -> Lighting:
    """Band-limit an environment for v views (see ``read_lighting``)."""
    return Lighting(
        environment=environment,
        prefilter=max(views, 1) ** -0.5,
        to_local=mi.Matrix3f(environment.to_local),
    )


def degrees(degree: int) -> np.ndarray:
    """Return the degree l of each coefficient, ((degree + 1)^2,)."""
    return np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)


def zonal_cosine(degree: int, power: int = 0) -> np.ndarray:
    """Return zonal factors of max(x, 0) (1 - x)^power, x = cos theta.

    A_l = 2 pi times the integral of P_l(x) x (1 - x)^power over [0, 1]. Power 0 is irradiance.
    """
    nodes, weights = np.polynomial.legendre.leggauss(degree // 2 + power + 2)
    x, w = (nodes + 1) / 2, weights / 2
    legendre = np.polynomial.legendre.legvander(x, degree)
    return 2 * np.pi * (w * x * (1 - x) ** power) @ legendre


def _texture(coefficients: np.ndarray) -> Any:
    degree = int(np.sqrt(len(coefficients))) - 1
    rows = int(np.clip(degree * TEXELS_PER_WAVE // 2, 128, 768)) + 1
    return lat_long_texture(synthesize(coefficients, 2 * (rows - 1), rows))


def lat_long_texture(grid: np.ndarray) -> Any:
    """Make a Texture2f from (H, W, C) values on a ``latlong`` grid.

    Texture units of GPUs interpolate with 8 bits, which is too coarse next to a sun.
    """
    return mi.Texture2f(
        mi.TensorXf(np.ascontiguousarray(grid, np.float32)), use_accel=False,
        filter_mode=dr.FilterMode.Linear, wrap_mode=dr.WrapMode.Repeat,
    )  # fmt: skip


MOMENTS = 8  # per channel: two scalars, two vectors


def diffuse_moments(value: Any, cosine: Any, direction: Any) -> list[Any]:
    """Return the moments (``LightVisibility.diffuse``) of one channel of light from a direction.

    ``value`` is its radiance times solid angle, ``cosine`` that of its angle to the normal.
    """
    parts = value * cosine, value * cosine * (1 - cosine) ** 5
    return [x for part in parts for x in (part, *(part * direction))]


@dataclass(frozen=True)
class MomentMap:
    """Diffuse moments (``LightVisibility.diffuse``) of unoccluded light."""

    texture: Any
    to_local: Any
    channels: int

    def at(self, normal: Any) -> list[list[Any]]:
        """Look up moments by world normal: 8 Floats per channel, local frame."""
        flat = look_up(self.texture, self.to_local @ mi.Vector3f(normal))
        return [flat[first : first + MOMENTS] for first in range(0, len(flat), MOMENTS)]

    def in_world(self, normal: Any) -> list[list[Any]]:
        """Look up moments by world normal, and rotate them to world space; evaluated."""
        back, result = self.to_local.T, []
        for c0, x0, y0, z0, c1, x1, y1, z1 in self.at(normal):
            m0, m1 = back @ mi.Vector3f(x0, y0, z0), back @ mi.Vector3f(x1, y1, z1)
            result.append([dr.maximum(c0, 0), *m0, dr.maximum(c1, 0), *m1])
        dr.eval(result)
        return result


def moment_map(environment: Environment, channels: int = 3) -> MomentMap:
    """Convolve the light with the diffuse lobes x and x (1 - x)^5, x = cos theta."""
    factors = zonal_cosine(COSINE_DEGREE, 0), zonal_cosine(COSINE_DEGREE, 5)
    expanded = [environment.coefficients(COSINE_DEGREE)]
    expanded += [_directional(environment, axis).coefficients(COSINE_DEGREE) for axis in range(3)]
    if channels == 1:
        expanded = [c.mean(axis=1, keepdims=True) for c in expanded]
    wide = [c * f[degrees(COSINE_DEGREE)][:, None] for f in factors for c in expanded]
    by_channel = np.stack(wide, axis=-1).reshape(len(wide[0]), -1)  # (lm, channel * moment)
    grid = synthesize(by_channel, 2 * (COSINE_ROWS - 1), COSINE_ROWS)
    return MomentMap(lat_long_texture(grid), mi.Matrix3f(environment.to_local), channels)


def _directional(environment: Environment, axis: int) -> Environment:
    """Return the light multiplied by the component ``axis`` of its direction."""
    rows, columns = environment.radiance.shape[:2]
    part = latlong.directions(columns, rows)[..., axis, None]
    return replace(
        environment,
        radiance=environment.radiance * part,
        disk_radiance=environment.disk_radiance * environment.disk_directions[:, axis, None],
    )
