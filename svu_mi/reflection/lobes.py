"""Specular lobes: profiles, directions and albedos.

A lobe of width alpha is approximated by a rotationally symmetric one, so that light can be
prefiltered (light/prefiltered.py). Its direction and albedo depend on the viewing angle.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.polynomial import legendre

from svu_mi.presets import Fresnel, Lobe
from svu_mi.reflection.principled import F0

INDEX = 1.5  # index of refraction of dielectrics (specular = 0.5)
ALBEDO_NODES = 32  # number of nodes of cos theta_o, at (i + 0.5) / 32
FLAT = 0.01  # alpha below which the sphere under a Gaussian lobe counts as flat
ANGLES = 4097  # number of tabulated angles of Gaussian lobes
SERIES = 6.0  # series of Gaussian lobes end at degree SERIES / alpha, where terms are exp(-36)
_U, _V = 64, 16  # number of stratified samples of visible normals per table entry


class Normals(NamedTuple):
    """Normals of each texel within its pixels.

    Attributes:
        mean: Vector3f, the texel's normal.
        around: three Vector3f with the covariance of the normals; empty if they are equal.
    """

    mean: Any
    around: list[Any]

    @staticmethod
    def of(normal: Any, bend: tuple[Any, Any] | None = None) -> "Normals":
        """Return normals of covariance a a^T + b b^T, with ``bend`` = (a, b); None: equal ones."""
        mean = mi.Vector3f(normal)
        if bend is None:
            return Normals(mean, [])
        a, b = (scale * x for scale, x in zip((2**0.5, 1.5**0.5), bend, strict=True))
        return Normals(mean, [dr.normalize(mean + way) for way in (a, b - a / 2, -b - a / 2)])


def zonal_profile(lobe: Lobe, alpha: float, cosine: np.ndarray) -> np.ndarray:
    """Return a lobe's unnormalised weight at angles from its centre, given their cosines.

    ``gaussian`` scales degree l by exp(-(alpha l)^2) (Eq. 6). ``ggx`` is D(theta / 2) G1(theta),
    for a view along the normal [Walter et al. 2007].
    """
    if lobe == "gaussian":
        if alpha < FLAT:
            return np.exp(-((np.arccos(cosine) / (2 * alpha)) ** 2))
        return np.interp(np.arccos(cosine), *_gaussian(alpha))
    distribution = (alpha / ((1 + cosine) / 2 * (alpha**2 - 1) + 1)) ** 2
    return np.where(cosine > 0, distribution * smith_g1(np.maximum(cosine, 1e-6), alpha), 0)


@lru_cache(maxsize=64)
def _gaussian(alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """Return angles in [0, pi], and sum_l (2 l + 1) exp(-(alpha l)^2) P_l divided by its peak."""
    angle = np.pi * np.linspace(0, 1, ANGLES) ** 2  # denser at the centre, for narrow lobes
    l = np.arange(int(np.ceil(SERIES / alpha)) + 1)
    decay = (2 * l + 1) * np.exp(-((alpha * l) ** 2))
    return angle, legendre.legval(np.cos(angle), decay / decay.sum())


@lru_cache
def lobe_profile(lobe: Lobe) -> Callable[[float, np.ndarray], np.ndarray]:
    """Return ``zonal_profile`` of a lobe as a cached function of width and cosine."""
    return partial(zonal_profile, lobe)


def smith_g1(cosine: Any, alpha: Any) -> Any:
    """Return G1 = 2 / (1 + sqrt(1 + alpha^2 tan^2 theta)) (Eq. 6) from the cosine."""
    root = _root(cosine)(cosine * cosine * (1 - alpha * alpha) + alpha * alpha)
    return 2 * cosine / (cosine + root)


def smith_g1_slope(cosine: Any, alpha: Any) -> Any:
    """Return the derivative of ``smith_g1`` with respect to alpha."""
    square = 1 - cosine * cosine
    root = _root(cosine)(cosine * cosine + alpha * alpha * square)
    return -2 * cosine * alpha * square / (root * (cosine + root) ** 2)


def ggx(cosine: Any, alpha: Any) -> Any:
    """Return the GGX distribution of normals D at a cosine [Walter et al. 2007, Eq. 33]."""
    return (alpha / (cosine * cosine * (alpha * alpha - 1) + 1)) ** 2 / np.pi


def disk_ggx(up: Any, incident: Any, widths: list[float], square: Any) -> list[Any]:
    """Return D G1 averaged over a disk of light, for each width.

    Half vectors of the disk fill a disk of half its radius rho. As D is the density of a sphere in
    stereographic projection, its mean over a disk is the area of a cap: with s = sin^2 theta_h +
    alpha^2 cos^2 theta_h, c = s - rho^2 / 4 and l^2 = c^2 + alpha^2 rho^2, it is
    2 alpha^2 / (pi l (l + c)). ``up`` is cos theta_h, ``square`` is rho^2.
    """
    root, means = _root(incident), []
    for a in (alpha * alpha for alpha in widths):
        c = dr.fma(-0.25, square, dr.fma(up * (a - 1), up, 1))
        length = root(dr.fma(c, c, a * square))
        masking = incident + root(dr.fma(incident * (1 - a), incident, a))
        means.append(4 / np.pi * a * incident * dr.rcp(length * (length + c) * masking))
    return means


def dielectric_fresnel(cosine: Any) -> Any:
    """Return the unpolarised Fresnel reflectance of a dielectric of index 1.5."""
    inner = _root(cosine)(1 - (1 - cosine * cosine) / INDEX**2)
    below_s, below_p = cosine + INDEX * inner, INDEX * cosine + inner
    inverse = (dr.rcp if dr.is_array_v(cosine) else np.reciprocal)(below_s * below_p)
    s = (cosine - INDEX * inner) * (inverse * below_p)
    p = (INDEX * cosine - inner) * (inverse * below_s)
    return (s * s + p * p) / 2


def view_albedo(rule: Fresnel, cosine: Any, alpha: Any) -> tuple[Any, Any, Any]:
    """Return (A, B, D) at theta_o (Eq. 6): a metal's albedo is R0 A + B, a dielectric's D."""
    masking = smith_g1(cosine, alpha)
    schlick = (1 - cosine) ** 5 if rule == "schlick" else 0.0
    A, B = masking * (1 - schlick), masking * schlick
    return A, B, F0 * A + B


def _root(like: Any) -> Any:
    """Return a square root function for positive arrays of the type of ``like``."""
    # In Dr.Jit, refined reciprocal square roots take a third of the time of square roots.
    return (lambda x: x * dr.rsqrt(x)) if dr.is_array_v(like) else np.sqrt


def dominance(alpha: Any) -> Any:
    """Return the weight of the mirror direction in a lobe's centre [Lagarde, de Rousiers 2014]."""
    if not dr.is_array_v(alpha):
        return (1 - alpha) * (np.sqrt(np.maximum(1 - alpha, 0)) + alpha)
    # Clamped, because the derivative of the root is infinite at alpha = 1.
    return (1 - alpha) * (dr.sqrt(dr.maximum(1 - alpha, 1e-12)) + alpha)


@lru_cache(maxsize=256)
def _albedo(alpha: float) -> np.ndarray:
    """Return A, B and D of a GGX lobe by importance sampling, (3, ALBEDO_NODES)."""
    mu = (np.arange(ALBEDO_NODES) + 0.5)[:, None] / ALBEDO_NODES
    view = np.stack([np.sqrt(1 - mu**2), np.zeros_like(mu), mu], axis=-1)
    half = _visible_normals(view, alpha)
    cosine = np.einsum("isk,iok->is", half, view)
    light = 2 * cosine[..., None] * half - view
    masking = smith_g1(np.maximum(light[..., 2], 1e-6), alpha)
    weight = np.where(light[..., 2] > 0, masking, 0.0)
    cosine = np.clip(cosine, 0, 1)
    fresnel = (1 - cosine) ** 5
    parts = (1 - fresnel, fresnel, dielectric_fresnel(cosine))
    return np.stack([(weight * part).mean(axis=1) for part in parts])


def split_sum(alpha: np.ndarray) -> np.ndarray:
    """Return A, B and D of GGX lobes, (R, ALBEDO_NODES, 3) [Karis 2013].

    The albedo of a metal is R0 A + B, that of a dielectric, with exact Fresnel, D.
    """
    return np.stack([_albedo(float(a)).T for a in alpha])


def mean_albedo(alpha: np.ndarray) -> np.ndarray:
    """Return the albedo of lobes with R0 = 1, averaged over cos theta_o, (R,)."""
    return split_sum(alpha)[..., :2].sum(axis=2).mean(axis=1)


def _visible_normals(view: np.ndarray, alpha: float) -> np.ndarray:
    """Sample visible half vectors, (views, samples, 3) [Heitz 2018]."""
    u = np.repeat((np.arange(_U) + 0.5) / _U, _V)
    phi = 2 * np.pi * (np.tile(np.arange(_V), _U) + (np.repeat(np.arange(_U), _V) % 7) / 7) / _V
    stretched = view * [alpha, alpha, 1.0]
    stretched = stretched / np.linalg.norm(stretched, axis=-1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0])  # views lie in the xz plane
    up = np.cross(stretched, side)
    s = 0.5 * (1 + stretched[..., 2])
    x = np.sqrt(u) * np.cos(phi)
    y = np.sqrt(u) * np.sin(phi)
    y = (1 - s) * np.sqrt(np.maximum(1 - x * x, 0)) + s * y
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    normal = x[..., None] * side + y[..., None] * up + z[..., None] * stretched
    normal = normal * [alpha, alpha, 1.0]
    normal[..., 2] = np.maximum(normal[..., 2], 1e-9)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)
