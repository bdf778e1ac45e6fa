"""Entropy of cells that are integrated, in double precision, and how far single may be from it.

The noise of a texel is taken as it was estimated: it comes from all texels together, and has an
oracle of its own (tests/posterior/test_calibrated.py).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from oracle.calibrated import Nodes, between_levels, channel, even, mixed, normal_on
from oracle.rounding import ROOT, Exact, U, moved

CELLS = 8  # of every parameter
METALLIC_PARTS = 14  # between 0 and 1, at least
FLATTEST, FARTHEST = 1e-3, 64.0  # least A, largest |mu| of a colour's normal distribution
TINY = 1e-13  # part of its diagonal below which a pivot is nothing but rounding
CLOSED = 1e-5  # nats: error of a channel's integral in closed form


def calibrated_entropies(
    w: np.ndarray, e: np.ndarray, p: np.ndarray, q: np.ndarray, d: np.ndarray, b: np.ndarray,
    noise: np.ndarray, switches: Any,
) -> list[Exact]:  # fmt: skip
    """Entropies of T texels from their samples, at levels of roughness uniform on [0, 1].

    Args:
        w: (T, V) weights; 0 of a view that does not see a texel.
        e: (T, R, C, V) diffuse shading; p, q and d alike.
        p: part of a metal's lobe that base colour scales.
        q: part that Fresnel adds.
        d: lobe of a dielectric.
        b: (T, C, V) radiance.
        noise: (T,) s of every texel, in radiance.
        switches: the preset.
    """
    r, m = even(_parts(switches.parts)), mixed(_parts(METALLIC_PARTS), switches.metals)
    weight = w.sum(axis=1)
    size = np.sqrt(w / weight[:, None])[:, None, None]
    columns = np.stack([e, p, q - d, d - b[:, None]]) * size  # (4, T, R, C, V)
    root, least = _root(columns)  # (R, C, T, 4, 4), (C, T)
    root[..., 3, 3] -= least
    # Radiance in units of noise, and what of it rounding and dropped pivots may be.
    unit = np.sqrt(weight / switches.overdispersion) / noise
    off = ROOT * unit * np.sqrt((columns**2).sum(axis=(0, -1)).max(axis=1)).T  # (C, T)
    energies, errors, given = [], [], []
    for roughness in r.value:
        at = between_levels(root, roughness)
        for metallic in m.value:
            likelihood = [x * unit**2 for x in channel(at, metallic)]
            best, log_mass, cells = _color(*likelihood)
            energies.append((best - log_mass).sum(axis=0))
            errors.append(_wrong(best, off).sum(axis=0))
            given.append(cells)
    shape = len(r.value), len(m.value), len(w)
    spread = np.reshape(given, (*shape[:2], *given[0].shape))
    prior = np.log(r.prior)[:, None, None] + np.log(m.prior)[:, None]
    energy = np.reshape(energies, shape) - prior
    energy -= energy.min(axis=(0, 1))
    wrong = np.reshape(errors, shape) + U * (4 * energy + 64)
    weights = np.exp(-energy)
    weights /= weights.sum(axis=(0, 1))
    masses = _cells(weights, r, m, spread)
    weighted = _cells(weights * wrong, r, m, spread)
    usual, results = _entropy_of(_prior(r, m)), []
    for p_of, wrong_of in zip(masses, weighted, strict=True):
        channels = range(p_of.shape[-1])
        H = [_entropy_of(p_of[..., c]) for c in channels]
        bounds = [moved(p_of[..., c], wrong_of[..., c], H[c], usual) for c in channels]
        # Sums over all cells, one after the other; log Z and sum p x are rounded apart.
        apart = U * (CELLS**3 * len(H) + len(r.value) * len(m.value)) / usual
        entropy = min(float(np.mean(H)) / usual, 1.0)
        results.append(Exact(entropy, min(float(np.mean(bounds)) + apart, 1.0)))
    return results


def _parts(least: int) -> int:
    """How many parts cells are cut into: half cells alike."""
    halves = 2 * (CELLS - 1)
    return -(-least // halves) * halves


def _root(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orthogonalise columns (4, T, R, C, V) one after the other, without those that depend on
    the ones before.

    Returns:
        U (R, C, T, 4, 4), upper triangular, its last entry squared; the least of that of all
        levels, (C, T).
    """
    left = columns.copy()
    root = np.zeros((*columns.shape[1:-1], 4, 4))
    for i in range(3):
        pivot, whole = ((x**2).sum(axis=-1) for x in (left[i], columns[i]))
        good = pivot > TINY * whole
        unit = left[i] * np.where(good, 1 / np.sqrt(np.where(good, pivot, 1)), 0)[..., None]
        for j in range(i, 4):
            root[..., i, j] = (unit * left[j]).sum(axis=-1)
            left[j] -= unit * root[..., i, j, None]
    root[..., 3, 3] = (left[3] ** 2).sum(axis=-1)
    root = np.moveaxis(root, 0, 2)
    return root, root[..., 3, 3].min(axis=0)


def _color(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, ...]:
    """Integrate exp(-(A c^2 + 2 B c + C) / 2) over c in [0, 1]; all (C, T).

    Returns:
        Energy of the best colour; log of the integral relative to it; parts of it in every cell,
        (K, C, T).
    """
    best = np.clip(-B / np.maximum(A, 1e-30), 0, 1)
    least = np.maximum(A * best**2 + 2 * B * best + C, 0) / 2
    # As ``truncated`` has it: hardly any light, and photographs far too bright, are made flatter.
    mirrored = -B > 0.5 * A
    slope = np.where(mirrored, A + B, -B)
    A = np.maximum(np.maximum(A, FLATTEST), slope / -FARTHEST)
    mu, sd = slope / A, 1 / np.sqrt(A)
    edges = np.concatenate([[0], (np.arange(CELLS - 1) + 0.5) / (CELLS - 1), [1]])
    whole = normal_on(np.zeros_like(mu), np.ones_like(mu), mu, sd)
    cells = np.exp([
        normal_on(np.full_like(mu, low), np.full_like(mu, high), mu, sd) - whole
        for low, high in zip(edges[:-1], edges[1:], strict=True)
    ])  # fmt: skip
    log_mass = whole + np.log(sd * np.sqrt(2 * np.pi)) + 0.5 * A * np.minimum(mu, 0) ** 2
    return least, log_mass, np.where(mirrored, cells[::-1], cells)


def _wrong(energy: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Error of an energy |x|^2 / 2, and of the width around it, where x is off by as much."""
    return 2 * (np.sqrt(2 * energy) * off + off**2 / 2) + CLOSED


def _cells(weight: np.ndarray, r: Nodes, m: Nodes, given: np.ndarray) -> np.ndarray:
    """Sum weights (N, L, T) of nodes, each spread over ``given`` (N, L, K, C, T), over cells:
    (T, R, M, K, C)."""
    masses = np.zeros((weight.shape[-1], CELLS, CELLS, CELLS, given.shape[3]))
    for i, j in np.ndindex(weight.shape[:2]):
        masses[:, r.cell[i], m.cell[j]] += (weight[i, j] * given[i, j]).transpose(2, 0, 1)
    return masses


def _prior(r: Nodes, m: Nodes) -> np.ndarray:
    """Prior probability of every cell."""
    of_color = np.diff(np.concatenate([[0], np.arange(CELLS - 1) + 0.5, [CELLS - 1]]))
    of_rows = np.outer(*(np.bincount(x.cell, x.prior) for x in (r, m)))
    return of_rows[..., None] * of_color / (CELLS - 1)


def _entropy_of(p: np.ndarray) -> float:
    """In nats."""
    positive = p[p > 0]
    return float(-(positive * np.log(positive)).sum())
