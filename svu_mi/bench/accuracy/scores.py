"""One estimate against the reference posterior and against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from svu_mi import metrics
from svu_mi.errors import ShapeError

LEVELS = (0.5, 0.9)


def agreement(entropy: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return Pearson's and Spearman's correlation of two (n,) entropies."""
    return {
        "pearson": metrics.pearson(entropy, reference),
        "spearman": metrics.spearman(entropy, reference),
    }


def judge_posterior(
    probabilities: np.ndarray,
    axes: Mapping[str, np.ndarray],
    truth: metrics.GroundTruth,
    entropy: np.ndarray,
    texels: np.ndarray,
) -> dict[str, Any]:
    """Compare a posterior with the true parameters.

    A posterior whose channels are separate is compared with each channel's truth, one that
    has a single grey value with the mean over channels. The estimate is the most probable
    cell of each distribution.

    Args:
        probabilities: (n, *grid), or (n, *grid, 3) with a distribution per channel.
        axes: nodes of each parameter, in the order of the grid's axes.
        truth: of all T texels.
        entropy: (n,) entropy of the posterior.
        texels: (n,) indices of its texels.

    Returns:
        ``credible`` by level; ``parameters`` by name: bias, mae, rmse of the estimate,
        ``entropy_correlation`` of its absolute error with the entropy and ``ause``; ``ause``
        and ``ause_relative``, means over parameters; and ``sparsification``, the curves of
        each parameter.

    Raises:
        ShapeError: probabilities do not fit the axes.
    """
    p, channels = _channels(probabilities, axes)
    true = _truth(truth, tuple(axes), texels, channels)
    cells = metrics.nearest_cells(axes, true)
    shape = tuple(len(nodes) for nodes in axes.values())
    best = np.unravel_index(p.reshape(len(p), -1).argmax(axis=1), shape)
    parameters, curves = {}, {}
    for (name, nodes), index in zip(axes.items(), best, strict=True):
        estimate = np.asarray(nodes, np.float64)[index]
        error = np.abs(estimate - true[name]).reshape(channels, -1).mean(axis=0)
        curve = metrics.sparsification(error, entropy)
        parameters[name] = {
            **asdict(metrics.error_summary(estimate, true[name])),
            "entropy_correlation": metrics.pearson(error, entropy),
            "ause": curve.ause,
            "ause_relative": curve.relative,
        }
        curves[name] = curve.sampled()
    levels = [asdict(metrics.credible_coverage(p, cells, level)) for level in LEVELS]
    return {
        "credible": {f"{level['level']:g}": level for level in levels},
        "parameters": parameters,
        "ause": _mean(parameters, "ause"),
        "ause_relative": _mean(parameters, "ause_relative"),
        "sparsification": curves,
    }


def _channels(probabilities: np.ndarray, axes: Mapping[str, np.ndarray]) -> tuple[np.ndarray, int]:
    """Return (channels * n, *grid), channel by channel, and their number, 1 or 3."""
    grid = tuple(len(nodes) for nodes in axes.values())
    if probabilities.shape[1:] == grid:
        return probabilities, 1
    if probabilities.shape[1:] == (*grid, 3):
        return np.concatenate([probabilities[..., channel] for channel in range(3)]), 3
    raise ShapeError(
        f"probabilities of shape {probabilities.shape} do not fit a grid of {grid} cells."
    )


def _truth(
    truth: metrics.GroundTruth, names: tuple[str, ...], texels: np.ndarray, channels: int
) -> dict[str, np.ndarray]:
    """Return (channels * n,) true values by parameter, in the order of ``_channels``."""
    found = {}
    for name in names:
        values = getattr(truth, name)
        if values.ndim == 2 and channels == 3:
            found[name] = values[texels].T.ravel()
        else:
            found[name] = np.tile(truth.grey(name)[texels], channels)
    return found


def _mean(parameters: Mapping[str, Mapping[str, float]], name: str) -> float:
    return float(np.mean([figures[name] for figures in parameters.values()]))
