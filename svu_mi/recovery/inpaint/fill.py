"""Filling of unseen texels by symmetry and total variation.

A filled texel is the weighted mean of all predictors (``combine_predictors``), because none suits
all objects. Cross-validation on seen parts of the surface gives weights per parameter, and the
error of the mean (``cross_validation``).
"""

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from svu_mi.core.progress import Progress, Stage
from svu_mi.errors import CaptureError, OptionError, ShapeError
from svu_mi.parameters import NAMES
from svu_mi.recovery.inpaint.combine_predictors import weighted_mean
from svu_mi.recovery.inpaint.cross_validation import (
    HoldoutErrors,
    PredictorErrors,
    distances_to_known,
    holdout_masks,
)
from svu_mi.recovery.inpaint.fill_result import Filled, Fusion, Weights
from svu_mi.recovery.inpaint.texel_hierarchy import TexelGraph
from svu_mi.recovery.uncertainty.texture_field import TextureField

LIMITING = "base_color"  # its share limits the shares of others: photographs determine it best


def fill(
    field: TextureField, seen: np.ndarray, above: float = inf, *, progress: Progress | None = None
) -> Filled:
    """Fill unseen texels and, with ``above``, uncertain ones.

    Args:
        field: Recovered textures with standard deviations.
        seen: (T,) bool, True for texels that a photograph shows.
        above: Limit of standard deviations, > 0. A seen texel that exceeds it in any parameter
            gets the precision-weighted mean of its value and the prediction.
        progress: Display of the stage.

    Raises:
        CaptureError: Too few texels are seen, or certain enough, for cross-validation.
        ShapeError: The shape of ``seen`` is not (T,).
        OptionError: ``above`` is not positive.

    Example:
        >>> field = svu.texture_field(recovery, mesh=capture.mesh)
        >>> filled = svu.fill(field, recovery.coverage > 0)
        >>> filled.textures.resolution, sorted(filled.errors)
        ((64, 64), ['base_color', 'metallic', 'roughness'])
    """
    shown = np.asarray(seen).astype(bool)
    if shown.shape != (field.texels.count,):
        raise ShapeError(
            f"fill(): seen must have one flag for each of {field.texels.count} texels, got shape "
            f"{shown.shape}."
        )
    if not above > 0:
        raise OptionError(f"fill(): above must be positive, got {above}.")
    seen = shown & (field.sds <= above).all(axis=0)
    if seen.any() and seen.all():
        return Filled(field, ~seen, {name: {} for name in NAMES}, {name: 0.0 for name in NAMES})
    with (progress or Progress()).stage("Comparing predictors") as stage:
        graph = TexelGraph.of(field, seen)
        masks = holdout_masks(graph.coarsest) if seen.any() else []
        if not masks and (above == inf or shown.sum() < 2):
            raise CaptureError(
                f"{shown.sum()} of {len(shown)} texels are seen, too few to fill the others; "
                "add photographs of the object."
            )
        if not masks:
            raise CaptureError(
                "fill(): too few texels are certain enough to fill the others; increase above="
                f"{above}.",
                shell="Too few texels are certain enough to fill the others; increase --above "
                f"({above}).",
            )
        errors = _predictor_errors(field, graph, masks, stage)
        max_share = errors[LIMITING].share if LIMITING in errors else 1.0
        weights = {n: errors[n].weights(max_share) if n in errors else {} for n in NAMES}
        return _fused(Fusion(field, shown), graph, errors, weights)


def _predictor_errors(
    field: TextureField, graph: TexelGraph, masks: Sequence[np.ndarray], stage: Stage
) -> dict[str, PredictorErrors]:
    """Return the errors of all predictors, by recovered parameter."""
    distances, trials = distances_to_known(graph, np.flatnonzero(~graph.known)), []
    for done, hidden in enumerate(masks):
        stage.update(done, len(masks) + 1)
        trials.append(HoldoutErrors.of(graph.coarsest, hidden, distances))
    stage.update(len(masks), len(masks) + 1)
    return {name: PredictorErrors(np.stack([each.products(field.rows(name)) for each in trials]))
            for name in field.names}  # fmt: skip


def _fused(
    fusion: Fusion, graph: TexelGraph, errors_of: Mapping[str, PredictorErrors], weights: Weights
) -> Filled:
    """Fuse unknown texels with weighted means of the predictors."""
    predicted = weighted_mean(graph, weights)
    errors = {name: 0.0 for name in NAMES}
    for name, each in errors_of.items():
        rows, squares = TextureField.rows(name), each.squares(weights[name])
        errors[name] = float(np.sqrt(squares.mean()))
        sd = np.sqrt(np.maximum(squares.max(axis=0)[:, None], graph.known_variance[rows]))
        fusion.fuse(name, ~graph.known, predicted[rows], sd)
    return Filled(fusion.fused_field(~graph.known), ~graph.known, weights, errors)


def filled_values(graph: TexelGraph, weights: Weights) -> np.ndarray:
    """Return all values (N, T), with weighted mean predictions at unknown texels."""
    values, predicted = graph.values.copy(), weighted_mean(graph, weights)
    for name, of_parameter in weights.items():
        if of_parameter:
            rows = TextureField.rows(name)
            values[rows] = np.where(graph.known, values[rows], predicted[rows])
    return values
