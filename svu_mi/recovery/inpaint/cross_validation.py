"""Cross-validation of predictors on held-out parts of the surface.

Each parameter has its own weights. Predictions are averaged with weights

    w_g ~ 1 / mean over parts of ((e_g^2 + e^2) / (e_*^2 + e^2)),

where e_g is the RMS error of predictor g on a held-out part, e_* is the least RMS error of all
predictors, and e is the least standard deviation of a prediction. The result is m for all
predictors, and s for total-variation inpaintings alone. Texels of a part get importance weights
[Shimodaira 2000], so that their distances to known texels are distributed as for unknown texels.

The filled value is s + a (m - s). The share a <= 1 is the largest for which no part has a larger
error than with s alone, up to a tolerance t:

    a = min over parts of (h + sqrt(h^2 + t^2 d)) / d,    h = <s s> - <s m>,  d = <(s - m) (s - m)>,

where <> is the mean product of errors.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from svu_mi.posterior import intervals
from svu_mi.posterior.folds import cluster_directions
from svu_mi.recovery.inpaint.combine_predictors import MEAN_WEIGHTS, TITLES, predictions
from svu_mi.recovery.inpaint.fill_result import LEAST_SD
from svu_mi.recovery.inpaint.texel_hierarchy import TexelGraph

FEWEST_PARTS, MOST_PARTS = 2, 6  # held-out parts of the surface
DIVISIONS = 2  # divisions of the surface into FEWEST_PARTS


def holdout_masks(graph: TexelGraph) -> list[np.ndarray]:
    """Return masks (T,) of known texels to hold out, similar to unseen regions.

    Texels of a mask have similar normals (or, on a flat object, lie on one side of its centre). The
    number of texels in a mask is about the number of unknown texels.
    """
    point, normal = graph.pieces.point, graph.pieces.normal
    side = point / np.maximum(np.linalg.norm(point, axis=1, keepdims=True), 1e-9)
    return _divided(normal, graph.known) or _divided(side, graph.known)


def _divided(normal: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
    """Cluster seen texels by unit vectors (T, 3); return one mask (T,) per cluster."""
    number = int(np.clip(round(seen.sum() / max((~seen).sum(), 1)), FEWEST_PARTS, MOST_PARTS))
    masks: list[np.ndarray] = []
    for seed in range(DIVISIONS if number == FEWEST_PARTS else 1):
        owner, shown = np.full(len(normal), -1), normal[seen]
        random, count = np.random.default_rng(seed), min(number, len(shown))
        seeds = random.choice(len(shown), count, replace=False).tolist()
        owner[seen] = cluster_directions(shown, seeds)
        for hidden in (owner == k for k in range(number)):
            new = not any(np.array_equal(hidden, other) for other in masks)
            if new and hidden.any() and (seen & ~hidden).any():
                masks.append(hidden)
    return masks


TRIAL_TEXELS = 3000  # sample of a held-out part
MOST_DISTANCES = 2**16  # maximum number of distances to compute
DISTANCE_BINS = 5  # bins of the distance to known texels
RARE = 0.01  # lower limit of a bin's fraction of texels, to limit weights
TOLERANCE = 1e-4  # t, an invisible difference


@dataclass(frozen=True)
class HoldoutErrors:
    """Errors of all predictors on a held-out part.

    Attributes:
        errors: (G, N, w) errors of G predictors for N values of w texels.
        weights: (w,) importance weights of the texels, with sum 1.
    """

    errors: np.ndarray
    weights: np.ndarray

    @staticmethod
    def of(graph: TexelGraph, hidden: np.ndarray, far: np.ndarray) -> "HoldoutErrors":
        """Compute errors on ``hidden`` texels (T,); ``far``: distances from unknown to known."""
        training, texels = graph.with_hidden(hidden), np.flatnonzero(hidden)
        texels = texels[intervals.subsample(np.arange(len(texels)), TRIAL_TEXELS)]
        true = graph.single[:, texels]
        errors = np.array([predicted - true for _, predicted in predictions(training, texels)])
        return HoldoutErrors(errors, importance_weights(far, distances_to_known(training, texels)))

    def products(self, rows: slice) -> np.ndarray:
        """Return mean products of the errors of each pair of predictors, (C, G, G)."""
        off = self.errors[:, rows].transpose(1, 0, 2)
        return np.asarray((off * self.weights) @ off.transpose(0, 2, 1))


def distances_to_known(graph: TexelGraph, texels: np.ndarray) -> np.ndarray:
    """Return distances (w,) of ``texels`` (or a sample) to the nearest known texel."""
    point = graph.pieces.point
    tree = scipy.spatial.cKDTree(point[graph.known])
    return np.asarray(tree.query(point[intervals.subsample(texels, MOST_DISTANCES)], workers=-1)[0])


def importance_weights(target: np.ndarray, sampled: np.ndarray) -> np.ndarray:
    """Return weights (w,) that give ``sampled`` distances the distribution of ``target``."""
    target = np.minimum(target, np.quantile(sampled, 1 - 1 / DISTANCE_BINS))
    edges = np.quantile(target, np.linspace(0, 1, DISTANCE_BINS + 1)[1:-1])
    groups = np.digitize(sampled, edges)
    wanted_share = np.bincount(np.digitize(target, edges), minlength=DISTANCE_BINS) / len(target)
    share = np.bincount(groups, minlength=DISTANCE_BINS) / len(sampled)
    weights = (wanted_share / np.maximum(share, RARE))[groups]
    return np.asarray(weights / weights.sum())


@dataclass(frozen=True)
class PredictorErrors:
    """Error covariances of all predictors for one parameter.

    Attributes:
        products: (P, C, G, G) mean products of errors, for P parts and C channels.
    """

    products: np.ndarray

    @cached_property
    def _means(self) -> np.ndarray:
        return np.asarray(self.products.mean(axis=1))

    @cached_property
    def all_weights(self) -> np.ndarray:
        """Weights of the predictors in the mean m, (G,)."""
        return self._weights(np.arange(len(TITLES)))

    @cached_property
    def tv_weights(self) -> np.ndarray:
        """Weights of the predictors in the mean s, (G,)."""
        return self._weights(np.arange(len(MEAN_WEIGHTS)))

    @cached_property
    def share(self) -> float:
        """Share a of m in the filled value."""
        difference = self.tv_weights - self.all_weights
        h, d = self._means @ difference @ self.tv_weights, self._means @ difference @ difference
        d = np.maximum(d, TOLERANCE**2)
        return float(min(((h + np.sqrt(h**2 + TOLERANCE**2 * d)) / d).min(), 1))

    def weights(self, max_share: float = 1.0) -> dict[str, float]:
        """Return weights by title; the share is at most ``max_share``, and 0 below TOLERANCE."""
        share = min(self.share, max_share)
        share *= share >= TOLERANCE  # fills change by less; other predictors are not evaluated
        weights = self.tv_weights + share * (self.all_weights - self.tv_weights)
        return dict(zip(TITLES, weights.tolist(), strict=True))

    def squares(self, weights: Mapping[str, float]) -> np.ndarray:
        """Return mean squared errors (P, C) of a weighted mean of predictors."""
        used = np.array([weights[title] for title in TITLES])
        return np.asarray(self.products @ used @ used)

    def _weights(self, used: np.ndarray) -> np.ndarray:
        squares = np.diagonal(self._means, axis1=1, axis2=2)[:, used] + LEAST_SD**2
        relative = (squares / squares.min(axis=1, keepdims=True)).mean(axis=0)
        weights = np.zeros(len(TITLES))
        weights[used] = 1 / relative / (1 / relative).sum()
        return weights
