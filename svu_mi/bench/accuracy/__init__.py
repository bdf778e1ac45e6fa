"""``svu bench accuracy``: estimators against a path-traced posterior and the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from svu_mi.bench.accuracy.accuracy_tables import (
    accuracy_tables,
    agreement_lines,
    curves,
    scatter,
    summarize,
    time_error,
)
from svu_mi.bench.compared_estimators import Variant
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Record
from svu_mi.bench.study import Selection, Study
from svu_mi.bench.timing import Timed, time_warm
from svu_mi.capture.capture import Capture
from svu_mi.errors import ShapeError
from svu_mi.evaluation.correlation import pearson, sparsification, spearman
from svu_mi.evaluation.credible_sets import credible_coverage, nearest_bins
from svu_mi.evaluation.ground_truth import GroundTruth, error_summary, ground_truth
from svu_mi.evaluation.traced_posterior import reference_posterior
from svu_mi.geometry.texels import Texels

DIGITS = 4  # of the entropies that are kept for scatter plots


def reference_of(bench: BenchRun, capture: Capture, layout: Texels, **changes: Any) -> Any:
    """Return the path-traced posterior of a few texels, from the cache if it is there."""
    options: dict[str, Any] = {
        "subset": bench.sizes.reference_texels,
        "spp": bench.sizes.reference_spp,
        "seed": bench.sizes.seed,
        "cache": bench.folder / "cache",
        **changes,
    }
    return reference_posterior(capture, layout, **options)


@dataclass(frozen=True)
class AccuracyCase(CaseSubject):
    """A case whose estimators are compared with the reference and with the truth.

    Attributes:
        rows: the estimators.
    """

    rows: Sequence[Variant]

    def settings(self, row: Variant | None) -> Any:
        how = None if row is None else (row.method, asdict(row.preset))
        return super().settings(row), how

    def head(self) -> Record:
        """Return figures of the reference, and its agreement with the two simple maps.

        Returns:
            ``object``, ``light``, ``texels``, ``reference`` (its figures) and ``sanity``.
        """
        return {
            "object": self.case.object, "light": self.case.light, "texels": self.layout.count,
            **self._traced.figures(),
        }  # fmt: skip

    def measure(self, row: Variant) -> Record:
        """Estimate, and compare."""
        timed = time_warm(partial(row.estimate, self.capture, self.layout))
        return self._traced.score(timed)

    @cached_property
    def _traced(self) -> CaseReference:
        with self.bench.progress.stage(f"Tracing the reference of {self.title}"):
            reference = reference_of(self.bench, self.capture, self.layout)
            return CaseReference.of(reference, self.capture, self.layout)


@dataclass(frozen=True)
class CaseReference:
    """Path-traced reference of a case, and its comparison with estimates.

    Attributes:
        reference: as ``reference_posterior`` gives it.
        kept: (n,) indices of the texels that the reference observed.
        entropy: (n,) its entropy there.
        truth: of all T texels.
    """

    reference: Any
    kept: np.ndarray
    entropy: np.ndarray
    truth: GroundTruth

    @classmethod
    def of(cls, reference: Any, capture: Capture, grid: Texels) -> CaseReference:
        """Exclude unseen texels, where every estimator is trivially right."""
        seen = np.array(reference.coverage) > 0
        return cls(
            reference=reference,
            kept=np.array(reference.subset)[seen],
            entropy=np.array(reference.entropy, np.float64)[seen],
            truth=ground_truth(capture, grid),
        )

    def figures(self) -> dict[str, Any]:
        """Return figures of the reference, and its agreement with the two simple maps."""
        reference = self.reference
        seen = np.array(reference.coverage) > 0
        maps = {
            "brightness": -np.array(reference.brightness, np.float64)[seen],
            "number of views": -np.array(reference.coverage, np.float64)[seen],
        }
        posterior = np.array(reference.posterior.probabilities)[seen]
        judged = score_posterior(
            posterior, reference.posterior.axes, self.truth, self.entropy, self.kept
        )
        return {
            "reference": {
                "texels": len(self.kept),
                "seconds": reference.seconds,
                "rays": reference.rays,
                "spp": reference.spp,
                "split_half": reference.split_half().correlation,
                "half_overlap": _overlap(reference.halves, seen),
                "mean_entropy": float(self.entropy.mean()),
                "entropy": self.entropy.round(DIGITS),
                **judged,
            },
            "sanity": {name: agreement(values, self.entropy) for name, values in maps.items()},
        }

    def score(self, timed: Timed) -> dict[str, Any]:
        """Return the figures of one estimate."""
        result = timed.result
        everywhere = np.array(result.entropy, np.float64)
        entropy = everywhere[self.kept]
        posterior = np.array(result.posterior.probabilities_of(self.kept))
        judged = score_posterior(posterior, result.posterior.axes, self.truth, entropy, self.kept)
        return {
            **agreement(entropy, self.entropy),
            "mean_entropy": float(everywhere[np.array(result.coverage) > 0].mean()),
            "seconds": timed.seconds,
            "timings": timed.timings,
            "entropy": entropy.round(DIGITS),
            **judged,
        }


def _overlap(halves: Any, seen: np.ndarray) -> float:
    """Return the mass that two posteriors share, mean over texels: 1 if equal, 0 if apart.

    Noise that makes both halves of the reference certain, but of different parameters, shows
    here and not in the correlation of their entropies.
    """
    p, q = (np.array(half.probabilities, np.float64)[seen] for half in halves)
    return float(np.minimum(p, q).reshape(len(p), -1).sum(axis=1).mean())


MASSES = (0.5, 0.9)


def agreement(entropy: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return Pearson's and Spearman's correlation of two (n,) entropies."""
    return {
        "pearson": pearson(entropy, reference),
        "spearman": spearman(entropy, reference),
    }


def score_posterior(
    probabilities: np.ndarray,
    axes: Mapping[str, np.ndarray],
    truth: GroundTruth,
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
    bins = nearest_bins(axes, true)
    shape = tuple(len(nodes) for nodes in axes.values())
    best = np.unravel_index(p.reshape(len(p), -1).argmax(axis=1), shape)
    parameters, curves = {}, {}
    for (name, nodes), index in zip(axes.items(), best, strict=True):
        estimate = np.asarray(nodes, np.float64)[index]
        error = np.abs(estimate - true[name]).reshape(channels, -1).mean(axis=0)
        curve = sparsification(error, entropy)
        parameters[name] = {
            **asdict(error_summary(estimate, true[name])),
            "entropy_correlation": pearson(error, entropy),
            "ause": curve.ause,
            "ause_relative": curve.relative,
        }
        curves[name] = curve.sampled()
    levels = [asdict(credible_coverage(p, bins, mass)) for mass in MASSES]
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
    truth: GroundTruth, names: tuple[str, ...], texels: np.ndarray, channels: int
) -> dict[str, np.ndarray]:
    """Return (channels * n,) true values by parameter, in the order of ``_channels``."""
    by_parameter = {}
    for name in names:
        values = getattr(truth, name)
        if values.ndim == 2 and channels == 3:
            by_parameter[name] = values[texels].T.ravel()
        else:
            by_parameter[name] = np.tile(truth.grey(name)[texels], channels)
    return by_parameter


def _mean(parameters: Mapping[str, Mapping[str, float]], name: str) -> float:
    return float(np.mean([figures[name] for figures in parameters.values()]))


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    subjects = (AccuracyCase(bench, case, selection.variants) for case in selection.cases)
    return Experiment("accuracy", subjects, whole=True)


STUDY = Study(
    title="Agreement with path tracing, and with the truth",
    experiment=_experiment,
    summary=lambda record: {**record, "summary": summarize(record["cells"])},
    tables=accuracy_tables,
    lines=agreement_lines,
    plots={"time_error": time_error, "scatter": scatter, "sparsification": curves},
)  # fmt: skip
