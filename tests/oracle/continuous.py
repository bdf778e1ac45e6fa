"""The reflection model at any roughness, the losses of recovery, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from oracle import angular


def lat_long(grid: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Interpolate (H, W, C) at local unit directions (N, 3): rows on poles, columns centred."""
    rows, columns = grid.shape[:2]
    x, y, z = direction.T
    u = np.arctan2(x, -z) / (2 * np.pi) % 1 * columns - 0.5
    v = np.arccos(np.clip(y, -1, 1)) / np.pi * (rows - 1)
    left, top = np.floor(u).astype(int), np.minimum(np.floor(v).astype(int), rows - 2)
    fx, fy = (u - left)[:, None], (v - top)[:, None]

    def row(j):
        return (1 - fx) * grid[j, left % columns] + fx * grid[j, (left + 1) % columns]

    return (1 - fy) * row(top) + fy * row(top + 1)


def width(roughness: np.ndarray) -> np.ndarray:
    return np.maximum(roughness**2, 1e-3)


def between(tables: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Interpolate the first axis of (R, N, ...) at one place per N."""
    level = np.clip(np.floor(place).astype(int), 0, len(tables) - 2)
    part = (place - level).reshape(-1, *(1,) * (tables.ndim - 2))
    lane = np.arange(len(place))
    return (1 - part) * tables[level, lane] + part * tables[level + 1, lane]


def columns(
    roughness: np.ndarray,
    grids: list[np.ndarray],
    albedo: np.ndarray,
    to_local: np.ndarray,
    normal: np.ndarray,
    direction: np.ndarray,
    moments: np.ndarray,
    *,
    paper: bool,
    narrow: bool,
    visible: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, ...]:
    """e, p, q, d of N samples, each (N, 3).

    Args:
        roughness: (N,).
        grids: light of R levels, (H, W, 3) of any size.
        albedo: (R, nodes, 3) of A, B and D at cosines (i + 0.5) / nodes.
        to_local: (3, 3), world to local.
        normal: (N, 3), unit.
        direction: (N, 3), unit, to the camera.
        moments: (N, 3, 8) of the diffuse light.
        paper: Lambert, Schlick at theta_o, lobes around the mirror direction; or Disney, split
            sum, lobes that lean towards the normal.
        narrow: lobes seen obliquely are narrower.
        visible: of mirror directions and alpha.
    """  # fmt: skip
    cosine = np.minimum(np.einsum("ni,ni->n", normal, direction), 1)
    alpha = width(roughness)
    mirror = 2 * cosine[:, None] * normal - direction
    center = mirror
    if not paper:
        lean = ((1 - alpha) * (np.sqrt(1 - alpha) + alpha))[:, None]
        center = (1 - lean) * normal + lean * mirror
        center = center / np.linalg.norm(center, axis=1, keepdims=True)
    place, along = roughness * (len(grids) - 1), np.ones(len(roughness))
    if narrow:
        along = np.einsum("ni,ni->n", center, direction)
    half = np.arccos(np.clip(along, -1, 1)) / 2
    # alpha sqrt(cos theta_h), and alpha is the square of roughness.
    seen = place * np.cos(half) ** 0.25
    lobe = between(np.stack([lat_long(grid, center @ to_local.T) for grid in grids]), seen)
    if visible is not None:
        lobe = lobe * visible(mirror, alpha)[:, None]
    grazing = (1 - cosine) ** 5
    c0, m0, c1, m1 = moments[..., 0], moments[..., 1:4], moments[..., 4], moments[..., 5:8]
    if paper:
        masking = angular.g1(cosine, alpha)
        A, B = masking * (1 - grazing), masking * grazing
        D, e = 0.04 * A + B, c0 / np.pi
    else:
        nodes = albedo.shape[1]
        column = np.clip(cosine * nodes - 0.5, 0, nodes - 1)
        first = np.minimum(np.floor(column).astype(int), nodes - 2)
        part = (column - first)[:, None]
        table = (1 - part) * albedo[:, first] + part * albedo[:, first + 1]
        A, B, D = between(table, place).T
        f = grazing[:, None]
        along = [c + np.einsum("nci,ni->nc", m, direction) for c, m in ((c0, m0), (c1, m1))]
        retro = f * along[0] + (1 - f) * along[1]
        e = ((1 - f / 2) * (c0 - c1 / 2) + roughness[:, None] * retro) / np.pi
    return e, A[:, None] * lobe, B[:, None] * lobe, D[:, None] * lobe


def radiance(parts: tuple[np.ndarray, ...], base_color: np.ndarray, metallic: np.ndarray):
    """(N, 3): a dielectric and a metal, mixed."""
    e, p, q, d = parts
    m = metallic[:, None]
    return (1 - m) * (base_color * e + d) + m * (base_color * p + q)


def slopes(function: Callable[..., np.ndarray], values: np.ndarray, step: float = 1e-6):
    """Central differences of function(values (N, P)) -> (N, ...) for every P: (P, N, ...)."""
    result = []
    for k in range(values.shape[1]):
        moved = [values + sign * step * (np.arange(values.shape[1]) == k) for sign in (1, -1)]
        result.append((function(moved[0]) - function(moved[1])) / (2 * step))
    return np.stack(result)


def spectral_error(
    values: np.ndarray,
    outgoing: np.ndarray,
    incoming: np.ndarray,
    irradiance: np.ndarray,
    albedo: np.ndarray,
    domain: str,
) -> np.ndarray:
    """(N,) sum of absolute differences of coefficients or power spectra.

    Args:
        values: (N, 5) red, green, blue, roughness, metallic.
        outgoing: (N, K, 3) coefficients of the photographs.
        incoming: (N, K, 3), of the light.
        irradiance: (N, 3).
        albedo: (R,) of roughness levels uniform on [0, 1].
        domain: ``coefficients`` or ``spectrum``.
    """  # fmt: skip
    color, roughness, metallic = values[:, :3], values[:, 3], values[:, 4:5]
    degree = np.repeat(np.arange(10), 2 * np.arange(10) + 1)[: outgoing.shape[1]]
    lobe = np.interp(roughness, np.linspace(0, 1, len(albedo)), albedo)
    decay = np.exp(-((width(roughness)[:, None] * degree) ** 2)) * lobe[:, None]
    specular = 0.04 + (color - 0.04) * metallic
    model = specular[:, None, :] * decay[..., None] * incoming
    constant = 2 / np.sqrt(np.pi) * (1 - metallic) * color * irradiance
    if domain == "coefficients":
        model[:, 0] += constant
        return np.abs(outgoing - model).sum(axis=(1, 2))
    total = np.zeros(len(values))
    for l in range(degree[-1] + 1):
        on = degree == l
        power = (model[:, on] ** 2).sum(axis=1)
        if l == 0:
            power = (constant + np.abs(model[:, 0])) ** 2
        total += np.abs((outgoing[:, on] ** 2).sum(axis=1) - power).sum(axis=1)
    return total
