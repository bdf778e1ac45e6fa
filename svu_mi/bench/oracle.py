"""The equations once more: NumPy in double precision, clear over fast, nothing of svu_mi.

``svu bench kernels`` and the tests hold the kernels against these. Sizes: T texels, V views,
C channels; R, M, S nodes of roughness, metallic, and base colour or Ks.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from scipy.special import sph_harm_y

F0 = 0.04


# --- spherical harmonics: Eq. 8 and 12 ------------------------------------------------------


def degrees(lmax: int) -> np.ndarray:
    """Degree l of every coefficient in the order l*l + l + m."""
    return np.array([l for l in range(lmax + 1) for _ in range(2 * l + 1)])


def basis(directions: np.ndarray, lmax: int) -> np.ndarray:
    """Real orthonormal harmonics (..., (lmax + 1)^2) of directions (..., 3).

    Only the angles of a direction count, not its length. From SciPy's complex harmonics, with
    their Condon-Shortley sign:
    Y_l0, sqrt(2) Re Y_lm for m > 0, sqrt(2) Im Y_l|m| for m < 0.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    theta, phi = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    columns = []
    for l in range(lmax + 1):
        middle, *sides = (sph_harm_y(l, m, theta, phi) for m in range(l + 1))
        columns += [math.sqrt(2) * side.imag for side in reversed(sides)]
        columns += [middle.real, *(math.sqrt(2) * side.real for side in sides)]
    return np.stack(columns, axis=-1)


def normal_equations(
    Y: np.ndarray,
    weights: np.ndarray,
    values: np.ndarray,
    regularizer: float,
    penalize_constant: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Y^T W^2 Y + lambda R and Y^T W^2 f of one texel: (N, N) and (N, C), N = (lmax + 1)^2.

    Args:
        Y: (V, N) the basis in the directions of visible views; only these are here.
        weights: (V,) w.
        values: (V, C).
        regularizer: lambda.
        penalize_constant: R_00 = 1, else 0.
    """
    lmax = math.isqrt(Y.shape[1]) - 1
    ridge = np.exp(degrees(lmax).astype(np.float64))
    if not penalize_constant:
        ridge[0] = 0
    w, f = weights.astype(np.float64)[:, None], values.astype(np.float64)
    return Y.T @ (w**2 * Y) + regularizer * np.diag(ridge), Y.T @ (w**2 * f)


def fit(
    directions: np.ndarray,
    weights: np.ndarray,
    values: np.ndarray,
    lmax: int,
    regularizer: float,
    penalize_constant: bool,
) -> np.ndarray:
    """Solve (Y^T W^2 Y + lambda R) c = Y^T W^2 f for every texel (Eq. 12).

    Args:
        directions: (T, V, 3).
        weights: (T, V) w, 0 = not seen.
        values: (T, V, C).
        lmax: highest degree.
        regularizer: lambda.
        penalize_constant: R_00 = 1, else 0.

    Returns:
        (T, (lmax + 1)^2, C); 0 for a texel that sees nothing.
    """
    texels, _, channels = values.shape
    coefficients = np.zeros((texels, (lmax + 1) ** 2, channels))
    Y = basis(directions, lmax)  # of all texels at once: a call of SciPy's costs most
    for t in range(texels):
        seen = weights[t] > 0
        if seen.any():
            normal, right = normal_equations(
                Y[t, seen], weights[t, seen], values[t, seen], regularizer, penalize_constant
            )
            coefficients[t] = np.linalg.solve(normal, right)
    return coefficients


def power(coefficients: np.ndarray) -> np.ndarray:
    """S(l) = sum over m of c_lm^2, (T, lmax + 1, C) (Eq. 8)."""
    lmax = math.isqrt(coefficients.shape[1]) - 1
    return np.stack(
        [(coefficients[:, l * l : (l + 1) ** 2] ** 2).sum(axis=1) for l in range(lmax + 1)], axis=1
    )


# --- errors of every cell: Eq. 7 and 11 from spectra, Eq. 6 from samples --------------------


def nodes(roughness: int, specular: int, spacing: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes of roughness and Ks."""
    t = np.linspace(0, 1, specular)
    return np.linspace(0, 1, roughness), t if spacing == "uniform" else F0 + (1 - F0) * t**2


def model(S_L: np.ndarray, Ks: float, alpha: float, prefilter: float = 0.0) -> np.ndarray:
    """Ks^2 exp(-2 (alpha l)^2) S_L(l) for l = 0 ... L on the last axis (Eq. 11)."""
    l = np.arange(S_L.shape[-1])
    return Ks**2 * np.exp(-2 * max(alpha**2 - prefilter**2, 0) * l**2) * S_L


def distances(
    S_L: np.ndarray, S_B: np.ndarray, alphas: np.ndarray, Ks: np.ndarray, prefilter: float = 0.0
) -> np.ndarray:
    """d of one texel and channel (L + 1,) on the grid, (R, S): l = 0 takes no part (Eq. 11).

    Args:
        S_L: power of the light by degree.
        S_B: power of the photographs.
        alphas: (R,).
        Ks: (S,) of all roughnesses, or (R, S).
        prefilter: alpha' that is undone.
    """
    Ks = np.broadcast_to(Ks, (len(alphas), np.shape(Ks)[-1]))
    d = np.zeros(Ks.shape)
    for i, j in itertools.product(*map(range, d.shape)):
        difference = S_B - model(S_L, Ks[i, j], alphas[i], prefilter)
        d[i, j] = (difference[1:] ** 2).sum()
    return d


def constant_residual(
    S_L0: float, S_B0: float, irradiance: float, Kd: np.ndarray, Ks: np.ndarray
) -> np.ndarray:
    """sqrt(S_B(0)) - 2 Kd E / sqrt(pi) - Ks sqrt(S_L(0)) of every (Kd, Ks) (Eq. 7)."""
    return np.sqrt(S_B0) - 2 * Kd * irradiance / np.sqrt(np.pi) - Ks * np.sqrt(S_L0)


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


# --- from errors to probabilities and entropy: Eq. 3 to 5 -----------------------------------


def energies(d: np.ndarray, sigma: float, views: float | None = None) -> np.ndarray:
    """-log p up to a constant; with a number of views, of the unknown-sigma rule d^(-nu/2)."""
    if views is None:
        return d / (2 * sigma**2)
    return max(views - 3, 1) / 2 * np.log(d / sigma**2 + 1)


def normalize(energy: np.ndarray, prior: np.ndarray | float = 1.0) -> np.ndarray:
    """exp(-energy) prior, summing to 1; relative to the best cell that the prior allows."""
    prior = np.broadcast_to(prior, energy.shape)
    allowed = np.where(prior > 0, energy, np.inf)
    p = np.exp(-(allowed - allowed.min())) * prior
    return p / p.sum()


def joint(channels: list[np.ndarray], prior: np.ndarray | None = None) -> np.ndarray:
    """p of every combination: rows, then one cell for each channel.

    All channels share a row (roughness, or roughness and metallic); the last axis is each
    channel's own.

    Args:
        channels: energies (..., cells) of each channel.
        prior: (..., cells) weights of one channel: of a row, times those of its cells given it.
    """
    cells, count = channels[0].shape[-1], len(channels)
    prior = np.ones(channels[0].shape) if prior is None else prior
    prior = prior.reshape(-1, cells)
    of_row = prior.sum(axis=1)
    given = prior / np.where(of_row > 0, of_row, 1)[:, None]
    energy: np.ndarray = np.zeros(())
    weight = of_row.reshape(-1, *(1,) * count)
    for channel, x in enumerate(channels):
        own = (len(prior), *(cells if k == channel else 1 for k in range(count)))
        energy = energy + x.reshape(own)
        weight = weight * given.reshape(own)
    return normalize(energy, weight)


def of_channels(p: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The distribution of each channel with the others summed over: (*shape, channels)."""
    count = p.ndim - 1
    parts = []
    for channel in range(count):
        others = tuple(1 + k for k in range(count) if k != channel)
        parts.append(p.sum(axis=others).reshape(shape))
    return np.stack(parts, axis=-1)


def entropy(p: np.ndarray) -> float:
    """H = -1 / log n * sum p log p (Eq. 5)."""
    positive = p[p > 0]
    return float(-(positive * np.log(positive)).sum() / np.log(p.size))


def mean_entropy(p: np.ndarray) -> float:
    """Mean over the last axis (channels) of the normalised entropy."""
    return float(np.mean([entropy(p[..., c]) for c in range(p.shape[-1])]))
