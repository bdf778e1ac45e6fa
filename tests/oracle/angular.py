"""The model of Eq. 6 with its refinements: lobes, albedo, diffuse, and the grid of cells."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import eval_legendre

# --- the model ------------------------------------------------------------------------------


def modelled(columns: Sequence[np.ndarray], c, m) -> np.ndarray:
    """Radiance of a dielectric and a metal, mixed: r = (1 - m) (c e + d) + m (c p + q)."""
    e, p, q, d = columns
    return (1 - m) * (c * e + d) + m * (c * p + q)


# --- sums over views ------------------------------------------------------------------------


def products(w: np.ndarray, columns: Sequence[np.ndarray], b: np.ndarray) -> np.ndarray:
    """(10, ...) sums over the last axis of w x y of (e, p, q - d, d - b), pair by pair."""
    e, p, q, d = columns
    x = (e, p, q - d, d - b)
    return np.stack([(w * x[i] * x[j]).sum(axis=-1) for i in range(4) for j in range(i, 4)])


# --- errors of every cell: Eq. 6 -----------------------------------------------------------


def mean_squared_error(w: np.ndarray, r: np.ndarray, b: np.ndarray) -> float:
    """1/n sum w (b - r)^2 of n samples; 0 without any."""
    return float((w * (b - r) ** 2).sum() / max(len(w), 1))


def principled_errors(
    w: np.ndarray, e: np.ndarray, p: np.ndarray, q: np.ndarray, d: np.ndarray, b: np.ndarray,
    metallic: np.ndarray, base_color: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Mean squared errors of r = (1 - m) (c e + d) + m (c p + q) (Eq. 6), in double precision.

    Args:
        w: (V,) weights.
        e: (R, V) diffuse shading by roughness; p, q and d alike.
        p: part of a metal's lobe that base colour scales.
        q: part that Fresnel adds.
        d: lobe of a dielectric.
        b: (V,) radiance.
        metallic: (M,) nodes.
        base_color: (S,) nodes.

    Returns:
        (R, M, S).
    """
    w, e, p, q, d, b = (np.asarray(x, np.float64) for x in (w, e, p, q, d, b))
    errors = np.zeros((len(e), len(metallic), len(base_color)))
    for r, j, k in itertools.product(*(range(n) for n in errors.shape)):
        m, c = metallic[j], base_color[k]
        modelled = (1 - m) * (c * e[r] + d[r]) + m * (c * p[r] + q[r])
        errors[r, j, k] = mean_squared_error(w, modelled, b)
    return errors


def specular_errors(
    w: np.ndarray, e: np.ndarray, p: np.ndarray, q: np.ndarray, b: np.ndarray, specular: np.ndarray
) -> np.ndarray:
    """Errors on the (roughness, Ks) grid, each with the Kd in [0, 1] that fits best."""
    w, e, p, q, b = (np.asarray(x, np.float64) for x in (w, e, p, q, b))
    d = np.zeros((len(e), len(specular)))
    for r, j in itertools.product(*(range(n) for n in d.shape)):
        rest = b - specular[j] * p[r] - q[r]
        square = (w * e[r] ** 2).sum()
        # A parabola in Kd: its lowest point, or the end of [0, 1] that is nearer to it.
        Kd = np.clip((w * e[r] * rest).sum() / square, 0, 1) if square > 0 else 0.0
        d[r, j] = mean_squared_error(w, Kd * e[r], rest)
    return d


# --- lobes ----------------------------------------------------------------------------------


def g1(cosine, alpha):
    """Smith's masking of one direction, G1 = 1 / (1 + Lambda)."""
    tangent = np.sqrt(np.maximum(1 - cosine**2, 0)) / cosine
    return 1 / (1 + (np.sqrt(1 + (alpha * tangent) ** 2) - 1) / 2)


def ggx(cosine, alpha):
    """GGX's distribution of normals, normalised: its integral with the cosine is 1."""
    return alpha**2 / (np.pi * (cosine**2 * (alpha**2 - 1) + 1) ** 2)


def fresnel(cosine, index: float = 1.5):
    """Unpolarised reflectance of a dielectric, by Snell's law and the angles of both sides."""
    outside = np.arccos(np.clip(cosine, 0, 1))
    inside = np.arcsin(np.sin(outside) / index)
    s = (cosine - index * np.cos(inside)) / (cosine + index * np.cos(inside))
    p = (index * cosine - np.cos(inside)) / (index * cosine + np.cos(inside))
    return (s**2 + p**2) / 2


def disk_mean(cosine, alpha, square, nodes: int = 400):
    """GGX averaged over half vectors in a disk of radius rho / 2, by quadrature over its rings.

    On a plane D is alpha^2 / (pi (alpha^2 + u^2)^2). On a ring of radius r around u, alpha^2 + u^2
    is A + B cos phi with A = s + r^2 and B = 2 u r, and 1 / (A + B cos phi)^2 has the mean
    A / (A^2 - B^2)^(3 / 2).
    """
    s = (1 - cosine**2 + alpha**2 * cosine**2)[..., None]
    node, weight = np.polynomial.legendre.leggauss(nodes)
    ring = np.asarray(square)[..., None] / 4 * ((1 + node) / 2)  # r^2, uniform over the disk
    squares = (s + ring) ** 2 - 4 * np.maximum(s - alpha**2, 0) * ring
    return alpha**2 / np.pi * ((s + ring) / squares**1.5) @ (weight / 2)


def normals_around(n, a, b) -> np.ndarray:
    """(3, 3) unit normals: n, moved to the corners of a triangle of covariance a a^T + b b^T."""
    turn = 2 * np.pi * np.arange(3)[:, None] / 3
    moved = n + np.sqrt(2) * (np.cos(turn) * a + np.sin(turn) * b)
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def reflected(toward, flux, radius, o, n, alpha: float, bend=None) -> np.ndarray:
    """(3, C) p, q and d of light from small disks: D G1(i) G1(o) F / (4 cos_o), summed.

    A metal of base colour c reflects c p + q, Schlick's Fresnel term; a dielectric d.

    Args:
        toward: (N, 3) unit directions to the light.
        flux: (N, C), radiance times solid angle.
        radius: (N,) of the disks.
        o: unit direction to the camera.
        n: unit normal.
        alpha: width of the lobe.
        bend: (2, 3) a and b. D of lobes narrower than .1 is averaged over ``normals_around``.
    """
    bend = np.zeros((2, 3)) if bend is None else bend
    above = toward @ n > 0
    toward, flux = toward[above], flux[above]
    half = toward + o
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    along = np.clip(half @ o, 0, 1)
    # In the plane of incidence the half vector turns by half the angle, across it by more.
    square = radius[above] ** 2 * (1 + 1 / along**2) / 2
    normals = normals_around(n, *bend) if alpha < 0.1 else n[None]
    lobe = np.mean([disk_mean(half @ each, alpha, square) for each in normals], axis=0)
    lobe = lobe * g1(toward @ n, alpha) * g1(o @ n, alpha) / (4 * o @ n)
    schlick = (1 - along) ** 5
    return np.stack([(lobe * part) @ flux for part in (1 - schlick, schlick, fresnel(along))])


def lobe(kind: str, alpha: float, angle: np.ndarray) -> np.ndarray:
    """Weight of light at an angle from a lobe's centre, seen along the normal; any scale.

    Degree l of the Gaussian is exp(-(alpha l)^2) times that of a direction (Eq. 6).
    """
    if kind == "gaussian":
        x, total = np.cos(angle), np.zeros(np.shape(angle))
        for l in range(int(7 / alpha) + 2):
            total = total + (2 * l + 1) * np.exp(-((alpha * l) ** 2)) * eval_legendre(l, x)
        return total
    up = angle < np.pi / 2 - 1e-9
    masking = g1(np.cos(np.where(up, angle, 0)), alpha)
    return np.where(up, ggx(np.cos(angle / 2), alpha) * masking, 0)


def lobe_average(
    radiance: Callable[[np.ndarray], np.ndarray], center: np.ndarray, kind: str, alpha: float
) -> float:
    """Average radiance(directions) around one direction, weighted by a lobe."""
    # Panels that grow from the lobe's width outwards; Gauss-Legendre in each.
    edges = np.concatenate([[0], np.geomspace(alpha / 8, np.pi / 2, 24), [3 * np.pi / 4, np.pi]])
    x, weight = np.polynomial.legendre.leggauss(12)
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    angle = (middle[:, None] + half[:, None] * x).ravel()
    weight = (half[:, None] * weight).ravel() * np.sin(angle) * lobe(kind, alpha, angle)
    spokes = 2 * np.pi * (np.arange(256) + 0.5) / 256
    center = center / np.linalg.norm(center)
    side = np.cross(center, [1.0, 0, 0] if abs(center[0]) < 0.7 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    other = np.cross(center, side)
    ring = np.cos(spokes)[:, None] * side + np.sin(spokes)[:, None] * other
    points = np.cos(angle)[:, None, None] * center + np.sin(angle)[:, None, None] * ring
    return float((weight * radiance(points).mean(axis=1)).sum() / weight.sum())


def albedo(alpha: float, cosine: float, nodes: int = 500) -> tuple[float, float]:
    """(A, B) of the directional albedo R0 A + B of a GGX reflection with Schlick's Fresnel."""
    schlick = reflectance(alpha, cosine, lambda along: (1 - along) ** 5, nodes)
    return reflectance(alpha, cosine, np.ones_like, nodes) - schlick, schlick


def reflectance(alpha: float, cosine: float, fresnel, nodes: int = 500) -> float:
    """Directional albedo of a GGX reflection with a Fresnel term of the cosine h.o.

    The integral over light i of D(h) G1(i) G1(o) F(h.o) / (4 cos_o cos_i) cos_i, taken over
    the half vector h instead: di = 4 (h.o) dh.
    """
    # tan(theta_h) = alpha tan(s) makes the integrand smooth at any width.
    x, weight = np.polynomial.legendre.leggauss(nodes)
    s = (x + 1) * np.pi / 4
    tangent = alpha * np.tan(s)
    cos_h = 1 / np.sqrt(1 + tangent**2)
    jacobian = alpha / np.cos(s) ** 2 * cos_h**2  # d theta_h / d s
    sin_h = tangent * cos_h
    turn = 2 * np.pi * (np.arange(nodes) + 0.5) / nodes
    o = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    along = sin_h[:, None] * np.cos(turn) * o[0] + (cos_h * o[2])[:, None]
    light = 2 * along * cos_h[:, None] - o[2]  # cos_i
    lit = (along > 0) & (light > 0)
    value = ggx(cos_h, alpha)[:, None] * g1(np.where(lit, light, 1), alpha) * g1(cosine, alpha)
    value = np.where(lit, value * along / cosine, 0)
    area = (weight * np.pi / 4 * jacobian * sin_h)[:, None] * (2 * np.pi / nodes)
    return float((value * fresnel(np.clip(along, 0, 1)) * area).sum())


# --- diffuse --------------------------------------------------------------------------------


def disney_diffuse(i, o, n, roughness: float, product: bool = True) -> np.ndarray:
    """Burley's diffuse BRDF of a white surface for lights i (..., 3) and one view o.

    Args:
        i: unit directions to the lights.
        o: unit direction to the camera.
        n: unit normal.
        roughness: of the surface.
        product: with the term R^2 F_o F_i, which matters at grazing angles only.
    """
    F_i, F_o = (1 - np.clip(i @ n, 0, 1)) ** 5, (1 - np.clip(o @ n, 0, 1)) ** 5
    R = roughness * (1 + i @ o)  # 2 roughness cos^2 of the difference angle
    smooth = (1 - F_i / 2) * (1 - F_o / 2)
    retro = R * (F_o + F_i + F_o * F_i * (R - 1))
    if not product:
        retro = retro - R**2 * F_o * F_i
    return (smooth + retro) / np.pi


def diffuse_radiance(lights, flux, o, n, roughness: float, product: bool = True) -> float:
    """Radiance of a white surface under directional lights (N, 3) of irradiance flux (N,)."""
    total = 0.0
    for direction, power in zip(lights, flux, strict=True):
        cosine = direction @ n
        if cosine > 0:
            total += power * cosine * float(disney_diffuse(direction, o, n, roughness, product))
    return total
