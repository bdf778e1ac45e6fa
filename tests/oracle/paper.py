"""The paper's equations 1 to 15 as printed: NumPy, float64, nothing of svu_mi and nothing shared.

The other oracles follow the package, readings and repairs included; this one follows the text
alone. Letters: T texels, V views, C channels, L = l* degrees; wo is the direction to the
camera, cosine its cos theta_o. Coefficients stand in the order l*l + l + m. Where the text is
open, an argument says which reading is meant, and ``notebooks/paper.md`` what it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

DIELECTRIC = 0.04  # R0 of what is no metal
LEAST_ALPHA = 1e-3

# --- spherical harmonics --------------------------------------------------------------------


def degree(count: int) -> int:
    """The highest degree of so many coefficients."""
    return math.isqrt(count) - 1


def degrees(lmax: int) -> np.ndarray:
    """l of every coefficient, ((lmax + 1)^2,)."""
    return np.concatenate([np.full(2 * l + 1, float(l)) for l in range(lmax + 1)])


def legendre(l: int, m: int, x: np.ndarray) -> np.ndarray:
    """P_l^m(x) with the Condon-Shortley sign (-1)^m, by its recurrence in l; m >= 0."""
    below = np.zeros_like(x)
    here = (-1) ** m * math.prod(range(1, 2 * m, 2)) * (1 - x**2) ** (m / 2)
    for k in range(m + 1, l + 1):
        here, below = ((2 * k - 1) * x * here - (k + m - 1) * below) / (k - m), here
    return here


def basis(directions: np.ndarray, lmax: int) -> np.ndarray:
    """Y_lm of unit vectors (..., 3), real and orthonormal on the sphere: (..., (lmax + 1)^2)."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    phi, columns = np.arctan2(y, x), []
    for l in range(lmax + 1):
        for m in range(-l, l + 1):
            k = abs(m)
            size = (2 * l + 1) / (4 * math.pi) * math.factorial(l - k) / math.factorial(l + k)
            turn = np.ones_like(phi)
            if m:
                turn = math.sqrt(2) * (np.cos(k * phi) if m > 0 else np.sin(k * phi))
            columns.append(math.sqrt(size) * legendre(l, k, z) * turn)
    return np.stack(columns, axis=-1)


# --- Eq. 1 to 5: posterior and entropy ------------------------------------------------------


def posterior(likelihood: np.ndarray, prior: np.ndarray | float = 1.0) -> np.ndarray:
    """p(psi | B, L) = p(B | psi, L) p(psi) / sum over the grid (Eq. 1, 2, 4)."""
    product = likelihood * prior
    return product / product.sum()


def likelihood(distance: np.ndarray, sigma: float) -> np.ndarray:
    """p(B | psi, L) ~ exp(-d / (2 sigma^2)) (Eq. 3), relative to the best of the grid."""
    return np.exp(-(distance - distance.min()) / (2 * sigma**2))


def entropy(p: np.ndarray) -> float:
    """H = -1 / log n sum p log p over the n cells of a grid (Eq. 5)."""
    return -math.fsum(x * math.log(x) for x in p.ravel() if x > 0) / math.log(p.size)


# --- Eq. 6: the SH reflection model ---------------------------------------------------------


def alpha_of(roughness: np.ndarray | float) -> np.ndarray:
    """Width of a lobe: the square of roughness, and no less than 0.001."""
    return np.maximum(np.square(roughness), LEAST_ALPHA)


def reflectances(base_color: np.ndarray, metallic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kd = (1 - m) c and R0 = 0.04 + (c - 0.04) m."""
    return (1 - metallic) * base_color, DIELECTRIC + (base_color - DIELECTRIC) * metallic


def masking(cosine: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
    """G1 = 1 / (1 + Lambda), Lambda = (sqrt(1 + alpha^2 tan^2 theta) - 1) / 2."""
    tangent = np.sqrt(1 - cosine**2) / cosine
    return 1 / (1 + (np.sqrt(1 + (alpha * tangent) ** 2) - 1) / 2)


def fresnel(R0: np.ndarray | float, cosine: np.ndarray) -> np.ndarray:
    """F = R0 + (1 - R0) (1 - cos theta_o)^5 (Schlick)."""
    return R0 + (1 - R0) * (1 - cosine) ** 5


def fall_off(lmax: int, alpha: float) -> np.ndarray:
    """exp(-(alpha l)^2) of every coefficient: what convolution with a lobe multiplies by."""
    return np.exp(-((alpha * degrees(lmax)) ** 2))


def sh_model(
    light: tuple[np.ndarray, np.ndarray, np.ndarray], wo: np.ndarray, cosine: np.ndarray,
    E: np.ndarray, base_color: np.ndarray, roughness: float, metallic: float, lmax: int,
    regularizer: float,
) -> np.ndarray:  # fmt: skip
    """B(wo) = Kd / pi E + F(theta_o) G1(theta_o) [S_alpha * (G1(theta_i) L)](wo) (Eq. 6).

    Of one texel.

    Args:
        light: samples of the incoming light that it is fitted to: (N, 3) directions that the
            mirror sends them to, (N,) cos theta_i and (N, C) radiance.
        wo: (V, 3) to the cameras, in the frame of the light's samples.
        cosine: (V,).
        E: (C,) irradiance.
        base_color: (C,).
        roughness: of the texel.
        metallic: of the texel.
        lmax: l* of the light's expansion.
        regularizer: lambda of its fit, whose weights are |cos theta_i|.

    Returns:
        (V, C) radiance.
    """
    directions, incident, radiance = light
    alpha = float(alpha_of(roughness))
    shadowed = masking(incident, alpha)[:, None] * radiance
    blurred = fall_off(lmax, alpha)[:, None] * fit(
        directions, incident, shadowed, lmax, regularizer
    )
    Kd, R0 = reflectances(base_color, np.float64(metallic))
    scale = fresnel(R0, cosine[:, None]) * masking(cosine, alpha)[:, None]
    return Kd / np.pi * E + scale * (basis(wo, lmax) @ blurred)


# --- Eq. 7 to 11: in the frequency domain ---------------------------------------------------


def constant(value: np.ndarray, lmax: int) -> np.ndarray:
    """Coefficients ((lmax + 1)^2, C) of a radiance that is the same everywhere.

    The integral of Y_00 times value over the sphere. Of value = Kd E / pi it is
    2 Kd E / sqrt(pi); Eq. 7 prints half of that.
    """
    result = np.zeros(((lmax + 1) ** 2, *np.shape(value)))
    result[0] = 4 * np.pi * value / np.sqrt(4 * np.pi)
    return result


def reflected(L: np.ndarray, Kd: np.ndarray, Ks: np.ndarray, alpha: float,
              E: np.ndarray) -> np.ndarray:  # fmt: skip
    """B_lm = Ks exp(-(alpha l)^2) L_lm, and the diffuse term in degree 0 (Eq. 7).

    Args:
        L: ((lmax + 1)^2, C) of the light.
        Kd: (C,).
        Ks: (C,).
        alpha: width of the lobe.
        E: (C,) irradiance.
    """
    lmax = degree(len(L))
    return Ks * fall_off(lmax, alpha)[:, None] * L + constant(Kd * E / np.pi, lmax)


def power(c: np.ndarray) -> np.ndarray:
    """S(l) = sum over m of c_lm^2, (lmax + 1, C) (Eq. 8)."""
    l = degrees(degree(len(c)))
    return np.stack([np.square(c[l == n]).sum(axis=0) for n in range(int(l[-1]) + 1)])


def reflected_power(S_L: np.ndarray, Ks: float, alpha: float) -> np.ndarray:
    """Ks^2 exp(-2 (alpha l)^2) S_L(l), (lmax + 1, C): S_B for l > 0 (Eq. 9, 10)."""
    l = np.arange(len(S_L))
    return Ks**2 * np.exp(-2 * (alpha * l) ** 2)[:, None] * S_L


def distance(S_B: np.ndarray, S_L: np.ndarray, Ks: float, alpha: float) -> float:
    """d = sum over l = 1 ... l* of (S_B(l) - Ks^2 exp(-2 (alpha l)^2) S_L(l))^2 (Eq. 11).

    Of (lmax + 1, C) spectra, the sum over channels, too: they share roughness and Ks.
    """
    return float(np.square(S_B - reflected_power(S_L, Ks, alpha))[1:].sum())


def distances(S_B: np.ndarray, S_L: np.ndarray, Ks: np.ndarray, alphas: np.ndarray) -> np.ndarray:
    """d of every cell of the grid, (alphas, Ks)."""
    return np.array([[distance(S_B, S_L, k, a) for k in Ks] for a in alphas])


# --- Eq. 12: the fit ------------------------------------------------------------------------


def fit(
    directions: np.ndarray, weights: np.ndarray, values: np.ndarray, lmax: int, regularizer: float
) -> np.ndarray:
    """Solve (Y^T W^2 Y + lambda R) c = Y^T W^2 f, R = diag(e^l), W = diag(w) (Eq. 12).

    As least squares of the stacked rows W Y and sqrt(lambda R), of which these are the normal
    equations.

    Args:
        directions: (V, 3).
        weights: (V,) w = |cos theta|, 0 where the texel is not seen.
        values: (V, C) f.
        lmax: l*.
        regularizer: lambda.

    Returns:
        ((lmax + 1)^2, C) coefficients.
    """
    rows = weights[:, None] * basis(directions, lmax)
    ridge = np.diag(np.sqrt(regularizer * np.exp(degrees(lmax))))
    right = np.concatenate([weights[:, None] * values, np.zeros((len(ridge), values.shape[1]))])
    return np.linalg.lstsq(np.concatenate([rows, ridge]), right, rcond=None)[0]


# --- Eq. 13: the next best view -------------------------------------------------------------


def band_limited(L: np.ndarray, views: int) -> np.ndarray:
    """Light ((lmax + 1)^2, C) as v photographs can resolve it: alpha' = v^(-1/2)."""
    return fall_off(degree(len(L)), views**-0.5)[:, None] * L


def expected_entropy(
    S_B: np.ndarray, S_L: np.ndarray, Ks: np.ndarray, alphas: np.ndarray, sigma: float
) -> float:
    """E[H] = sum over psi of p(psi | B, L') H(B'_psi, L') of one texel (Eq. 13).

    Args:
        S_B: (l* + 1, C) spectrum of the photographs that there are.
        S_L: (l* + 1, C) spectrum of L', which v' views mirror, the new one among them.
        Ks: nodes.
        alphas: nodes.
        sigma: of the likelihood.
    """
    p, total = posterior(likelihood(distances(S_B, S_L, Ks, alphas), sigma)), 0.0
    for i, alpha in enumerate(alphas):
        for j, specular in enumerate(Ks):
            shown = reflected_power(S_L, specular, alpha)  # B'_psi
            d = distances(shown, S_L, Ks, alphas)
            total += p[i, j] * entropy(posterior(likelihood(d, sigma)))
    return total


# --- Eq. 14 and 15: sharing -----------------------------------------------------------------


def divergence(p: np.ndarray, q: np.ndarray) -> float:
    """KL(p || q) = sum p log(p / q), over all cells."""
    p, q = p.ravel(), q.ravel()
    return math.fsum(x * (math.log(x) - math.log(y)) for x, y in zip(p, q, strict=True) if x > 0)


def sharing_weights(p: np.ndarray, seeds: np.ndarray, tau: float = 0.4) -> np.ndarray:
    """w_pq = exp(-KL(P_p || P_q)^2 / (2 tau'^2)), (T, S) (Eq. 15).

    tau' is tau times the mean KL between all points and all seeds. Not normalised.

    Args:
        p: (T, ...) posteriors.
        seeds: (S,) numbers of texels.
        tau: 0.4.
    """
    KL = np.array([[divergence(here, p[q]) for q in seeds] for here in p])
    return np.exp(-(KL**2) / (2 * (tau * KL.mean()) ** 2))


def sharing(psi: np.ndarray, seeds: np.ndarray, w: np.ndarray) -> tuple[float, np.ndarray]:
    """L_S = 1/T sum over p, sum over seeds q of w_pq |psi_p - psi_q|^2 (Eq. 14).

    Args:
        psi: (T, D) parameters.
        seeds: (S,).
        w: (T, S), which does not depend on psi.

    Returns:
        The loss, and its derivatives (T, D); seeds are pulled by what they pull at.
    """
    apart = psi[:, None] - psi[seeds][None]
    slope = 2 * w[..., None] * apart / len(psi)
    gradient = slope.sum(axis=1)
    np.add.at(gradient, seeds, -slope.sum(axis=0))
    return float((w[..., None] * apart**2).sum() / len(psi)), gradient


def least_minima(entropy: np.ndarray, pairs: np.ndarray, count: int) -> np.ndarray:
    """The seeds C: the most certain of the texels that no neighbour is more certain than.

    Args:
        entropy: (T,), no two the same.
        pairs: (P, 2) neighbouring texels.
        count: at most so many, the least entropy first.
    """
    minimum = np.ones(len(entropy), bool)
    for i, j in pairs:
        minimum[i if entropy[j] < entropy[i] else j] = False
    minima = np.flatnonzero(minimum)
    return minima[np.argsort(entropy[minima])][:count]


# --- losses ---------------------------------------------------------------------------------


def absolute_error(model: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean |model - target| over everything, and its derivatives by the model."""
    apart = model - target
    return float(np.abs(apart).mean()), np.sign(apart) / apart.size


def total_variation(psi: np.ndarray, pairs: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean over pairs of sum |psi_i - psi_j|, and its derivatives (T, D); 0 at a kink.

    Args:
        psi: (T, D).
        pairs: (P, 2) neighbouring texels.
    """
    apart = psi[pairs[:, 0]] - psi[pairs[:, 1]]
    gradient = np.zeros_like(psi)
    np.add.at(gradient, pairs[:, 0], np.sign(apart) / len(pairs))
    np.add.at(gradient, pairs[:, 1], -np.sign(apart) / len(pairs))
    return float(np.abs(apart).sum() / len(pairs)), gradient


def differences(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-6):
    """Central differences of f(x) by each number of x (N,): (N, ...)."""
    slopes = []
    for k in range(len(x)):
        away = np.zeros_like(x)
        away[k] = step
        slopes.append((f(x + away) - f(x - away)) / (2 * step))
    return np.array(slopes)
