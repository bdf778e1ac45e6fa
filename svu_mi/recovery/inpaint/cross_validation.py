"""How far off guesses are: tried on parts of the surface that were seen.

Each parameter is judged by itself. With e_g how far off guess g is on a hidden part, in the square
mean over its texels, all guesses are averaged with weights

    w_g ~ 1 / mean over parts of ((e_g^2 + e^2) / (that of the best guess there + e^2)),

to m (e: what no guess is surer than); and so, by themselves, those that spread from the border, to
s. Texels of a part are weighted so as to be as far from what is known as those that are to be
filled [Shimodaira 2000]: what is hidden lies deeper inside. What is filled in is s + a (m - s),
with the largest share a by which no part gets worse than by s alone,

    a = min over parts of (h + sqrt(h^2 + t^2 d)) / d,    h = <s s> - <s m>,  d = <(s - m) (s - m)>,

at most 1, where <> are means of products of errors, and t^2 is a gain or loss that nobody sees.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from svu_mi.posterior import intervals
from svu_mi.recovery.inpaint.combine_predictors import FARTHER, TITLES, guesses
from svu_mi.recovery.inpaint.fill_result import SUREST
from svu_mi.recovery.inpaint.texel_hierarchy import Ground

FEWEST, MOST = 2, 6  # parts of the surface that are hidden in turn
DIVISIONS = 2  # ways to divide it, where it is divided into so few


def hidden_parts(ground: Ground) -> list[np.ndarray]:
    """Return parts of what is known, as cameras leave them out.

    Each is what faces one way, or of a flat object what lies on one side, about as large as what
    is not known, so that it is as far from what is.
    """
    point, normal = ground.pieces.point, ground.pieces.normal
    side = point / np.maximum(np.linalg.norm(point, axis=1, keepdims=True), 1e-9)
    return _divided(normal, ground.known) or _divided(side, ground.known)


def _divided(normal: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
    """Return parts of what was seen of which the unit vectors (T, 3) are alike."""
    number = int(np.clip(round(seen.sum() / max((~seen).sum(), 1)), FEWEST, MOST))
    found: list[np.ndarray] = []
    for seed in range(DIVISIONS if number == FEWEST else 1):
        owner = np.full(len(normal), -1)
        owner[seen] = _clusters(normal[seen], number, seed)
        for hidden in (owner == k for k in range(number)):
            new = not any(np.array_equal(hidden, other) for other in found)
            if new and hidden.any() and (seen & ~hidden).any():
                found.append(hidden)
    return found


def _clusters(unit: np.ndarray, number: int, seed: int) -> np.ndarray:
    """Return which of some clusters each unit vector (n, 3) is in, by spherical k-means."""
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


TRIED = 3000  # texels of a part that guesses are compared on
MEASURED = 2**16  # distances, at most
DISTANCES = 5  # groups of texels by how far they are from what is known
RARE = 0.01  # part of the texels from which on a group of them tells enough
UNSEEN = 1e-4  # t


@dataclass(frozen=True)
class Trial:
    """How far off all guesses of a hidden part are.

    Attributes:
        errors: (G, N, w).
        weights: (w,) of the part's texels, which sum to one.
    """

    errors: np.ndarray
    weights: np.ndarray

    @staticmethod
    def of(ground: Ground, hidden: np.ndarray, far: np.ndarray) -> Trial:
        """Try all guesses on a part of what is known."""
        left, texels = ground.without(hidden), np.flatnonzero(hidden)
        texels = texels[intervals.spread(np.arange(len(texels)), TRIED)]
        true = ground.single[:, texels]
        errors = np.array([guess - true for _, guess in guesses(left, texels)])
        return Trial(errors, importance(far, distances(left, texels)))

    def products(self, rows: slice) -> np.ndarray:
        """Return means of products of errors of two guesses each, (C, G, G)."""
        some = self.errors[:, rows].transpose(1, 0, 2)
        return np.asarray((some * self.weights) @ some.transpose(0, 2, 1))


def distances(ground: Ground, texels: np.ndarray) -> np.ndarray:
    """Return how far texels are from what is known, (w,), of many of them those of some."""
    point = ground.pieces.point
    tree = scipy.spatial.cKDTree(point[ground.known])
    return np.asarray(tree.query(point[intervals.spread(texels, MEASURED)], workers=-1)[0])


def importance(meant: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Return weights of some distances (w,) with which they are distributed as others are; what is
    farther than most of them counts as if it were as far as these."""
    meant = np.minimum(meant, np.quantile(given, 1 - 1 / DISTANCES))
    edges = np.quantile(meant, np.linspace(0, 1, DISTANCES + 1)[1:-1])
    groups = np.digitize(given, edges)
    wanted = np.bincount(np.digitize(meant, edges), minlength=DISTANCES) / len(meant)
    share = np.bincount(groups, minlength=DISTANCES) / len(given)
    weights = (wanted / np.maximum(share, RARE))[groups]
    return np.asarray(weights / weights.sum())


@dataclass(frozen=True)
class Judged:
    """How far off the values of one parameter are.

    Attributes:
        products: (P, C, G, G) of errors, of P parts and C channels.
    """

    products: np.ndarray

    @staticmethod
    def of(trials: Sequence[Trial], rows: slice) -> Judged:
        return Judged(np.stack([trial.products(rows) for trial in trials]))

    @cached_property
    def _means(self) -> np.ndarray:
        return np.asarray(self.products.mean(axis=1))

    @cached_property
    def mixed(self) -> np.ndarray:
        """(G,), weights of the guesses in m."""
        return self._weights(np.arange(len(TITLES)))

    @cached_property
    def spread(self) -> np.ndarray:
        """(G,), weights of the guesses in s."""
        return self._weights(np.arange(len(FARTHER)))

    @cached_property
    def share(self) -> float:
        """a."""
        apart = self.spread - self.mixed
        h, d = self._means @ apart @ self.spread, self._means @ apart @ apart
        d = np.maximum(d, UNSEEN**2)
        return float(min(((h + np.sqrt(h**2 + UNSEEN**2 * d)) / d).min(), 1))

    def weights(self, most: float = 1.0) -> dict[str, float]:
        """Return how much every guess counts, by title."""
        found = self.spread + min(self.share, most) * (self.mixed - self.spread)
        return dict(zip(TITLES, found.tolist(), strict=True))

    def squares(self, weights: Mapping[str, float]) -> np.ndarray:
        """Return mean squared errors (P, C) of guesses together."""
        used = np.array([weights[title] for title in TITLES])
        return np.asarray(self.products @ used @ used)

    def _weights(self, used: np.ndarray) -> np.ndarray:
        squares = np.diagonal(self._means, axis1=1, axis2=2)[:, used] + SUREST**2
        off = (squares / squares.min(axis=1, keepdims=True)).mean(axis=0)
        weights = np.zeros(len(TITLES))
        weights[used] = 1 / off / (1 / off).sum()
        return weights
