"""Predictions of unknown texels by total variation and symmetry, and their mean."""

from collections.abc import Container, Iterator

import numpy as np
import scipy

from svu_mi.recovery.inpaint.fill_result import LEAST_SD, Weights
from svu_mi.recovery.inpaint.symmetry_predictors import NEAR_PREDICTOR, PREDICTORS, KnownTexels
from svu_mi.recovery.inpaint.texel_hierarchy import TexelGraph
from svu_mi.recovery.uncertainty.texture_field import TextureField

MEAN_WEIGHTS = {"from the border": 1e-5, "from the border and the mean": 1e-2}
"""By title: precision of the prior at unknown texels, whose mean is the mean of known texels,
relative to 1 / their variance. Larger values let borders spread less far into a hole."""
EDGE_ROUNDS = 2  # rounds with links updated from the last result, which continue edges into holes
SMOOTHED_BORDER = 48  # links from holes within which known values are smoothed; 16 are too few
START_NEIGHBORS = 8  # nearest known texels whose weighted mean is the initial value


def tv_predictions(
    graph: TexelGraph, titles: Container[str] = MEAN_WEIGHTS
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield titles and total-variation inpaintings (N, T).

    Lagged diffusivity [Vogel and Oman 1996]: links have equal weights first; later rounds weaken
    them across edges of the last result. Pieces without known texels get the mean of all known
    texels. Large maps are filled from coarse to fine.
    """
    known, values, weights = graph.known, graph.values, graph.weights
    mean = np.average(values[:, known], axis=1, weights=weights[:, known])[:, None]
    spread = np.maximum(values[:, known].std(axis=1), LEAST_SD)[:, None]
    border = np.bincount(graph.pieces.piece, known)[graph.pieces.piece] > 0
    free = border & graph.near(~known, SMOOTHED_BORDER)  # other known values have no influence
    part = np.flatnonzero(graph.near(free, 1))
    links = graph.smoother.restricted(part) if part.size else graph.smoother
    own, free = known[part], free[part]
    for title, filled, edges in _initial_values(graph, titles, border, mean):
        trust = np.where(known, weights, MEAN_WEIGHTS[title] * graph.size / spread**2)[:, part]
        right, some = trust * np.where(known, values, mean)[:, part], filled[:, part]
        rounds = [None] if edges else [~own, *[None] * EDGE_ROUNDS]
        for hidden in rounds if part.size else ():
            smoother = links.with_precision(trust, some, hidden)
            some = np.where(own, values[:, part], smoother.solve_masked(right, some, free))
        filled = filled.copy()
        filled[:, part] = some
        yield title, np.clip(filled, 0, 1)


def _initial_values(
    graph: TexelGraph, titles: Container[str], border: np.ndarray, mean: np.ndarray
) -> Iterator[tuple[str, np.ndarray, bool]]:
    """Yield title, initial values (N, T), and whether these have edges within holes."""
    if graph.is_large:
        groups, owner = graph.halved
        for title, coarse in tv_predictions(groups, titles):
            yield title, np.where(graph.known, graph.values, coarse[:, owner]), True
        return
    # Weighted means of the nearest known texels.
    pieces, known, filled = graph.pieces, graph.known, graph.values.copy()
    places = pieces.separated(pieces.point)
    tree = scipy.spatial.cKDTree(places[known])
    count = min(START_NEIGHBORS, int(known.sum()))
    away, which = tree.query(places[~known], [*range(1, count + 1)], workers=-1)
    weights = 1 / np.maximum(away, 1e-9) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    filled[:, ~known] = np.einsum("nwk,wk->nw", graph.values[:, known][:, which], weights)
    start = np.where(border, filled, mean)
    yield from ((title, start, False) for title in MEAN_WEIGHTS if title in titles)


TITLES = (*MEAN_WEIGHTS, *(title for predictor in PREDICTORS for title in predictor.titles))


def weighted_mean(graph: TexelGraph, weights: Weights) -> np.ndarray:
    """Return weighted mean predictions, (N, T); 0 at known texels."""
    titles = {title for each in weights.values() for title, weight in each.items() if weight > 0}
    unknown, mean = np.flatnonzero(~graph.known), np.zeros_like(graph.values)
    for title, predicted in predictions(graph, unknown, titles):
        for name, each in weights.items():
            rows = TextureField.rows(name)
            mean[rows, unknown] += each.get(title, 0.0) * predicted[rows]
    return mean


def predictions(
    graph: TexelGraph, wanted: np.ndarray, titles: Container[str] = TITLES
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield title and values (N, w) of each predictor at w ``wanted`` texels."""
    for title, values in tv_predictions(graph, titles):
        yield title, values[:, wanted]
    predictors = [one for one in PREDICTORS if any(title in titles for title in one.titles)]
    if not predictors:
        return
    texels = np.flatnonzero(graph.known)
    examples = KnownTexels(texels, graph.values[:, texels], graph.weights[:, texels])
    ((fallback, has_match),) = NEAR_PREDICTOR.predict(graph.pieces, examples, wanted)
    fallback = np.where(has_match, fallback, examples.mean)  # where the predictor has no match
    for predictor in predictors:
        if predictor is NEAR_PREDICTOR:
            yield predictor.titles[0], fallback
            continue
        found = predictor.predict(graph.pieces, examples, wanted)
        for title, (values, has_match) in zip(predictor.titles, found, strict=True):
            if title in titles:
                yield title, np.where(has_match, values, fallback)
