"""Cross-validation of predictors on held-out parts of the surface.

Each parameter has its own weights. With e_g the RMS error of predictor g on a hidden part, all
predictions are averaged with weights

    w_g ~ 1 / mean over parts of ((e_g^2 + e^2) / (that of the best predictor there + e^2)),

to m (e: the least standard deviation of a prediction); and the total-variation inpaintings alone
to s. Texels of a part are weighted to be as far from known texels as those to be filled
[Shimodaira 2000], because hidden parts are deeper. The filled value is s + a (m - s),
with the largest share a by which no part gets worse than by s alone,

    a = min over parts of (h + sqrt(h^2 + t^2 d)) / d,    h = <s s> - <s m>,  d = <(s - m) (s - m)>,

at most 1, where <> are means of products of errors, and t^2 is an invisible difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from svu_mi.posterior import intervals
from svu_mi.recovery.inpaint.combine_predictors import MEAN_WEIGHTS, TITLES, predictions
from svu_mi.recovery.inpaint.fill_result import LEAST_SD
from svu_mi.recovery.inpaint.texel_hierarchy import TexelGraph

FEWEST_PARTS, MOST_PARTS = 2, 6  # held-out parts of the surface
DIVISIONS = 2  # divisions of the surface into FEWEST_PARTS


def holdout_masks(graph: TexelGraph) -> list[np.ndarray]:
    """Return masks (T,) of known texels to hold out, shaped like what cameras miss.

    Each has similar normals (of a flat object, lies on one side) and is about as large as the
    unknown part, so that it is as far from known texels.
    """
    point, normal = graph.pieces.point, graph.pieces.normal
    side = point / np.maximum(np.linalg.norm(point, axis=1, keepdims=True), 1e-9)
    return _divided(normal, graph.known) or _divided(side, graph.known)


def _divided(normal: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
    """Return masks of seen texels with similar unit vectors (T, 3)."""
    number = int(np.clip(round(seen.sum() / max((~seen).sum(), 1)), FEWEST_PARTS, MOST_PARTS))
    masks: list[np.ndarray] = []
    for seed in range(DIVISIONS if number == FEWEST_PARTS else 1):
        owner = np.full(len(normal), -1)
        owner[seen] = _cluster_directions(normal[seen], number, seed)
        for hidden in (owner == k for k in range(number)):
            new = not any(np.array_equal(hidden, other) for other in masks)
            if new and hidden.any() and (seen & ~hidden).any():
                masks.append(hidden)
    return masks


def _cluster_directions(unit: np.ndarray, number: int, seed: int) -> np.ndarray:
    """Return the cluster (n,) of each unit vector (n, 3), by spherical k-means."""
    random = np.random.default_rng(seed)
    centres = unit[random.choice(len(unit), min(number, len(unit)), replace=False)]
    for _ in range(8):
        owner = (unit @ centres.T).argmax(axis=1)
        centres = np.stack([
            unit[owner == k].mean(axis=0) if (owner == k).any() else centres[k]
            for k in range(len(centres))
        ])  # fmt: skip
        centres /= np.maximum(np.linalg.norm(centres, axis=1, keepdims=True), 1e-9)
    return np.asarray((unit @ centres.T).argmax(axis=1))


TRIAL_TEXELS = 3000  # texels of a part on which predictors are compared
MOST_DISTANCES = 2**16  # texels whose distance is measured, at most
DISTANCE_BINS = 5  # groups of texels by their distance to known ones
RARE = 0.01  # least part of the texels that a group counts as
TOLERANCE = 1e-4  # t


@dataclass(frozen=True)
class HoldoutErrors:
    """Errors of all predictors on a held-out part.

    Attributes:
        errors: (G, N, w).
        weights: (w,) of the part's texels, which sum to one.
    """

    errors: np.ndarray
    weights: np.ndarray

    @staticmethod
    def of(graph: TexelGraph, hidden: np.ndarray, far: np.ndarray) -> HoldoutErrors:
        """Compute the errors of all predictors on ``hidden`` texels (T,)."""
        training, texels = graph.with_hidden(hidden), np.flatnonzero(hidden)
        texels = texels[intervals.subsample(np.arange(len(texels)), TRIAL_TEXELS)]
        true = graph.single[:, texels]
        errors = np.array([predicted - true for _, predicted in predictions(training, texels)])
        return HoldoutErrors(errors, importance_weights(far, distances_to_known(training, texels)))

    def products(self, rows: slice) -> np.ndarray:
        """Return means of products of errors of two predictors, (C, G, G)."""
        off = self.errors[:, rows].transpose(1, 0, 2)
        return np.asarray((off * self.weights) @ off.transpose(0, 2, 1))


def distances_to_known(graph: TexelGraph, texels: np.ndarray) -> np.ndarray:
    """Return distances (w,) of texels to the nearest known one, of a subset if there are many."""
    point = graph.pieces.point
    tree = scipy.spatial.cKDTree(point[graph.known])
    return np.asarray(tree.query(point[intervals.subsample(texels, MOST_DISTANCES)], workers=-1)[0])


def importance_weights(target: np.ndarray, sampled: np.ndarray) -> np.ndarray:
    """Return weights of ``sampled`` distances (w,) that give them the distribution of ``target``,
    whose largest values are clipped."""
    target = np.minimum(target, np.quantile(sampled, 1 - 1 / DISTANCE_BINS))
    edges = np.quantile(target, np.linspace(0, 1, DISTANCE_BINS + 1)[1:-1])
    groups = np.digitize(sampled, edges)
    wanted_share = np.bincount(np.digitize(target, edges), minlength=DISTANCE_BINS) / len(target)
    share = np.bincount(groups, minlength=DISTANCE_BINS) / len(sampled)
    weights = (wanted_share / np.maximum(share, RARE))[groups]
    return np.asarray(weights / weights.sum())


@dataclass(frozen=True)
class PredictorErrors:
    """Covariances of the predictors' errors of one parameter.

    Attributes:
        products: (P, C, G, G) of errors, of P parts and C channels.
    """

    products: np.ndarray

    @staticmethod
    def of(trials: Sequence[HoldoutErrors], rows: slice) -> PredictorErrors:
        return PredictorErrors(np.stack([trial.products(rows) for trial in trials]))

    @cached_property
    def _means(self) -> np.ndarray:
        return np.asarray(self.products.mean(axis=1))

    @cached_property
    def all_weights(self) -> np.ndarray:
        """(G,), weights of the predictors in m."""
        return self._weights(np.arange(len(TITLES)))

    @cached_property
    def tv_weights(self) -> np.ndarray:
        """(G,), weights of the predictors in s."""
        return self._weights(np.arange(len(MEAN_WEIGHTS)))

    @cached_property
    def share(self) -> float:
        """a."""
        difference = self.tv_weights - self.all_weights
        h, d = self._means @ difference @ self.tv_weights, self._means @ difference @ difference
        d = np.maximum(d, TOLERANCE**2)
        return float(min(((h + np.sqrt(h**2 + TOLERANCE**2 * d)) / d).min(), 1))

    def weights(self, max_share: float = 1.0) -> dict[str, float]:
        """Return the weight of each predictor, by title."""
        share = min(self.share, max_share)
        weights = self.tv_weights + share * (self.all_weights - self.tv_weights)
        return dict(zip(TITLES, weights.tolist(), strict=True))

    def squares(self, weights: Mapping[str, float]) -> np.ndarray:
        """Return mean squared errors (P, C) of the weighted mean."""
        used = np.array([weights[title] for title in TITLES])
        return np.asarray(self.products @ used @ used)

    def _weights(self, used: np.ndarray) -> np.ndarray:
        squares = np.diagonal(self._means, axis1=1, axis2=2)[:, used] + LEAST_SD**2
        relative = (squares / squares.min(axis=1, keepdims=True)).mean(axis=0)
        weights = np.zeros(len(TITLES))
        weights[used] = 1 / relative / (1 / relative).sum()
        return weights
