"""Scores of a posterior against true parameters: coverage, interval scores, ranks and errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from svu_mi.bench.correlation import pearson, sparsification, spearman
from svu_mi.bench.credible_sets import credible_coverage, nearest_bins
from svu_mi.core.arrays import evenly_spaced
from svu_mi.parameters import NAMES

JUDGED = 1500  # compared texels
DRAWS = 64
SETTLED = 0.05  # largest half width of a narrow interval
NODES = np.arange(8) / 7
LEVEL = 0.9
PAIRS = 100  # texels of a case whose predicted and true errors are pooled with other cases

Truths = Mapping[str, np.ndarray]
Scores = dict[str, Any]


def posterior_figures(posterior: Any, truth: Truths, chosen: np.ndarray) -> Scores:
    """Return all scores of a posterior.

    Args:
        posterior: Posterior of T texels.
        truth: True values (t,) or (t, 3) by parameter.
        chosen: Indices (t,) of the compared texels.
    """
    true = {name: _columns(np.asarray(truth[name], np.float64)) for name in NAMES}
    if posterior.channels == 1:
        true["base_color"] = true["base_color"].mean(axis=1, keepdims=True)
    result = set_coverage(np.array(posterior.probabilities_of(chosen), np.float64), true)
    draws = posterior.draw(DRAWS, seed=1)
    errors, variances = [], []
    for name in NAMES:
        key, mine = name.replace("base_", "")[0], true[name]
        mean, sd = (_columns(np.array(x(name), np.float64)[chosen])
                    for x in (posterior.mean, posterior.sd))  # fmt: skip
        low, high = (_columns(np.array(end)) for end in posterior.interval(name, LEVEL, chosen))
        inside = (mine >= low - 1e-6) & (mine <= high + 1e-6)
        settled = (high - low) / 2 <= SETTLED
        error, variance = ((mean - mine) ** 2).mean(axis=1), (sd**2).mean(axis=1)
        errors.append(error)
        variances.append(variance)
        drawn = np.array(draws[name])[:, chosen].astype(np.float64)
        result |= {
            f"interval {key}": float(inside.mean()), f"settled {key}": float(settled.mean()),
            f"settled {key} holds": float(inside[settled].mean()) if settled.any() else 1.0,
            f"score {key}": interval_score(low, high, mine),
            f"psnr {key}": float(-10 * np.log10(np.mean((mean - mine) ** 2))),
            f"ause {key}": sparsification(np.sqrt(error), np.sqrt(variance)).relative,
            f"crps {key}": crps(drawn.reshape(DRAWS, *mine.shape), mine),
        }  # fmt: skip
    error, expected = np.sqrt(np.sum(errors, axis=0)), np.sqrt(np.sum(variances, axis=0))
    some = evenly_spaced(len(error), PAIRS)
    return result | {
        "pearson": pearson(error, expected), "spearman": spearman(error, expected),
        "errors": error[some].round(4).tolist(), "expected": expected[some].round(4).tolist(),
    }  # fmt: skip


def _columns(values: np.ndarray) -> np.ndarray:
    """Return values (t,) or (t, g) as (t, g)."""
    return values if values.ndim == 2 else values[:, None]


def set_coverage(p: np.ndarray, truth: Truths) -> Scores:
    """Return the shares of credible sets that contain the truth.

    Args:
        p: Probabilities (t, roughness, metallic, base colour), or with a last axis of channels.
        truth: True values (t, g) by parameter.
    """
    p = p if p.ndim == 5 else p[..., None]
    bins = {
        name: np.stack([nearest_bins({name: NODES}, {name: x}) for x in truth[name].T], axis=1)
        for name in NAMES
    }
    r, m = bins["roughness"][:, 0], bins["metallic"][:, 0]
    of = {
        "r": (p[..., 0].sum(axis=(2, 3)), r),
        "m": (p[..., 0].sum(axis=(1, 3)), m),
        "rm": (p[..., 0].sum(axis=3).reshape(len(p), -1), len(NODES) * r + m),
    }
    colors = list(zip(np.moveaxis(p.sum(axis=(1, 2)), 2, 0), bins["base_color"].T, strict=True))
    result = {}
    for mass in (0.9, 0.5):
        key = f"{100 * mass:.0f}"
        for name, (q, own) in of.items():
            result[f"{key} {name}"] = credible_coverage(q, own, mass).fractional
        coverages = [credible_coverage(q, own, mass).fractional for q, own in colors]
        result[f"{key} c"] = float(np.mean(coverages))
    return result


def interval_score(low: np.ndarray, high: np.ndarray, true: np.ndarray) -> float:
    """Return the mean score of 90 % intervals: width, and 20 times the distance of the truth.

    [Gneiting and Raftery 2007, Strictly proper scoring rules, prediction, and estimation]

    Example:
        >>> from svu_mi.bench.posterior_scores import interval_score
        >>> ends = np.array([0.2, 0.2]), np.array([0.4, 0.4])
        >>> round(interval_score(*ends, np.array([0.3, 0.5])), 3)
        1.2
    """
    missed = np.maximum(low - true, 0) + np.maximum(true - high, 0)
    return float((high - low + 2 / (1 - LEVEL) * missed).mean())


def crps(drawn: np.ndarray, true: np.ndarray) -> float:
    """Return the mean CRPS, E|x - truth| - E|x - x'| / 2, of draws (n, t, g)."""
    n = len(drawn)
    ordered = np.sort(drawn, axis=0)
    weights = (2 * np.arange(n) - n + 1)[:, None, None]
    apart = 2 * (weights * ordered).sum(axis=0) / (n * (n - 1))
    return float((np.abs(drawn - true).mean(axis=0) - apart / 2).mean())
