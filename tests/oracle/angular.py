"""The model of Eq. 6 with its refinements: lobes, albedo, diffuse, and the grid of cells."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from oracle.posterior import entropy, normalize

F0 = 0.04


# --- errors of all cells --------------------------------------------------------------------


def gram(w, e, p, q, b) -> np.ndarray:
    """Sums of w, w e^2, w e p, w p^2, w e t, w p t, w t^2 over samples, t = b - q."""
    sums = np.zeros(7)
    for W, E, P, Q, B in zip(*(np.float64(x) for x in (w, e, p, q, b)), strict=True):
        t = B - Q
        sums += W * np.array([1, E * E, E * P, P * P, E * t, P * t, t * t])
    return sums


def mean_squared_error(w, e, p, q, b, Kd: float, R0: float) -> float:
    """1/n sum w (b - Kd e - R0 p - q)^2 over n samples, one by one; 0 without any."""
    w, e, p, q, b = (np.float64(x) for x in (w, e, p, q, b))
    total = 0.0
    for W, E, P, Q, B in zip(w, e, p, q, b, strict=True):
        total += W * (B - (Kd * E + R0 * P + Q)) ** 2
    return total / max(len(w), 1)


def principled_errors(w, e, p, q, b, metallic, base_color) -> np.ndarray:
    """Errors on the (roughness, metallic, base_color) grid.

    Args:
        w: (V,) weights.
        e: (R, V) diffuse shading by roughness; p and q alike.
        p: part of the lobe that R0 scales.
        q: part that Fresnel adds.
        b: (V,) radiance.
        metallic: (M,) nodes.
        base_color: (C,) nodes.
    """
    d = np.zeros((len(e), len(metallic), len(base_color)))
    for r, j, k in itertools.product(*(range(n) for n in d.shape)):
        m, c = metallic[j], base_color[k]
        d[r, j, k] = mean_squared_error(
            w, e[r], p[r], q[r], b, (1 - m) * c, F0 + (c - F0) * m
        )
    return d


def specular_errors(w, e, p, q, b, specular) -> np.ndarray:
    """Errors on the (roughness, Ks) grid, each with the Kd in [0, 1] that fits best."""
    d = np.zeros((len(e), len(specular)))
    for r, j in itertools.product(*(range(n) for n in d.shape)):
        rest = b - specular[j] * p[r] - q[r]
        square = (w * e[r] ** 2).sum()
        # A parabola in Kd: its lowest point, or the end of [0, 1] that is nearer to it.
        Kd = np.clip((w * e[r] * rest).sum() / square, 0, 1) if square > 0 else 0.0
        d[r, j] = mean_squared_error(w, e[r], p[r], q[r], b, Kd, specular[j])
    return d


def energies(d: np.ndarray, sigma: float, views: int | None = None) -> np.ndarray:
    """-log p up to a constant; with a number of views, of the unknown-sigma rule d^(-nu/2)."""
    if views is None:
        return d / (2 * sigma**2)
    return max(views - 3, 1) / 2 * np.log(d / sigma**2 + 1)


def joint(channels: list[np.ndarray], prior: np.ndarray | None = None) -> np.ndarray:
    """p of every combination: rows, then one cell for each channel.

    All channels share a row (roughness, or roughness and metallic); the last axis is each
    channel's own.

    Args:
        channels: energies (..., cells) of each channel.
        prior: (..., cells) weights of one channel: of a row, times those of its cells given it.
    """
    shape = channels[0].shape
    flat = [x.reshape(-1, shape[-1]) for x in channels]
    rows, cells = flat[0].shape
    prior = np.ones(shape) if prior is None else prior
    prior = prior.reshape(rows, cells)
    energy = np.zeros((rows, *(cells,) * len(flat)))
    weight = np.zeros_like(energy)
    for place in itertools.product(*(range(n) for n in energy.shape)):
        row, own = place[0], place[1:]
        energy[place] = sum(x[row, k] for x, k in zip(flat, own, strict=True))
        of_row = prior[row].sum()
        if of_row > 0:
            weight[place] = of_row * np.prod([prior[row, k] / of_row for k in own])
    return normalize(energy, weight)


def of_channels(p: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The distribution of each channel with the others summed over: (*shape, channels)."""
    count = p.ndim - 1
    parts = []
    for channel in range(count):
        others = tuple(1 + k for k in range(count) if k != channel)
        parts.append(p.sum(axis=others).reshape(shape))
    return np.stack(parts, axis=-1)


def mean_entropy(p: np.ndarray) -> float:
    """Mean over the last axis (channels) of the normalised entropy."""
    return float(np.mean([entropy(p[..., c]) for c in range(p.shape[-1])]))


# --- lobes ----------------------------------------------------------------------------------


def g1(cosine, alpha):
    """Smith's masking of one direction, G1 = 1 / (1 + Lambda)."""
    tangent = np.sqrt(1 - cosine**2) / cosine
    return 1 / (1 + (np.sqrt(1 + (alpha * tangent) ** 2) - 1) / 2)


def ggx(cosine, alpha):
    """GGX's distribution of normals, normalised: its integral with the cosine is 1."""
    return alpha**2 / (np.pi * (cosine**2 * (alpha**2 - 1) + 1) ** 2)


def lobe(kind: str, alpha: float, angle: np.ndarray) -> np.ndarray:
    """Weight of light at an angle from a lobe's centre, seen along the normal; any scale.

    The Gaussian of variance 2 alpha^2 falls off as exp(-(alpha l)^2) in degree.
    """
    if kind == "gaussian":
        return np.exp(-(angle**2) / (4 * alpha**2))
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
    """(A, B) of the directional albedo R0 A + B of a GGX reflection with Schlick's Fresnel.

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
    fresnel = (1 - np.clip(along, 0, 1)) ** 5
    return float((value * (1 - fresnel) * area).sum()), float((value * fresnel * area).sum())


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
