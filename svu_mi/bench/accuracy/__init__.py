"""``svu bench accuracy``: estimators, a path-traced posterior, and the true parameters."""

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
from svu_mi.bench.correlation import pearson, sparsification, spearman
from svu_mi.bench.credible_sets import credible_coverage, nearest_bins
from svu_mi.bench.error_summary import error_summary
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Record
from svu_mi.bench.study import Selection, Study
from svu_mi.bench.timing import Timed, time_warm
from svu_mi.capture.capture import Capture
from svu_mi.errors import ShapeError
from svu_mi.evaluation.ground_truth import GroundTruth, ground_truth
from svu_mi.evaluation.traced_posterior import reference_posterior
from svu_mi.geometry.texels import Texels

DIGITS = 4  # decimals of the entropies in scatter plots


def reference_of(bench: BenchRun, capture: Capture, layout: Texels, **changes: Any) -> Any:
    """Return the path-traced posterior of a few texels, cached in the folder of the run."""
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
    """Case whose estimators are compared with a path-traced reference and the true parameters.

    Attributes:
        rows: Estimators to compare.
    """

    rows: Sequence[Variant]

    def settings(self, row: Variant | None) -> Any:
        how = None if row is None else (row.method, asdict(row.preset))
        return super().settings(row), how

    def head(self) -> Record:
        """Return scores of the reference, and its correlation with two simple maps.

        Returns:
            ``object``, ``light``, ``texels``, and the entries of ``CaseReference.figures``.
        """
        return {
            "object": self.case.object, "light": self.case.light, "texels": self.layout.count,
            **self._traced.figures(),
        }  # fmt: skip

    def measure(self, row: Variant) -> Record:
        """Return the scores of an estimator."""
        timed = time_warm(partial(row.estimate, self.capture, self.layout))
        return self._traced.score(timed)

    @cached_property
    def _traced(self) -> CaseReference:
        with self.bench.progress.stage(f"Tracing the reference of {self.title}"):
            reference = reference_of(self.bench, self.capture, self.layout)
            return CaseReference.of(reference, self.capture, self.layout)


@dataclass(frozen=True)
class CaseReference:
    """Path-traced reference of a case, and comparisons with estimates.

    Attributes:
        reference: Result of ``reference_posterior``.
        kept: Indices (n,) of the visible texels of the reference.
        entropy: Entropy (n,) of the reference at these texels.
        truth: True parameters of all T texels.
    """

    reference: Any
    kept: np.ndarray
    entropy: np.ndarray
    truth: GroundTruth

    @classmethod
    def of(cls, reference: Any, capture: Capture, grid: Texels) -> CaseReference:
        """Return the reference without unseen texels, where every entropy is 1."""
        seen = np.array(reference.coverage) > 0
        return cls(
            reference=reference,
            kept=np.array(reference.subset)[seen],
            entropy=np.array(reference.entropy, np.float64)[seen],
            truth=ground_truth(capture, grid),
        )

    def figures(self) -> dict[str, Any]:
        """Return ``reference`` (scores) and ``sanity`` (correlation with two simple maps)."""
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
        """Return correlation with the reference, run times and scores of an estimate."""
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
    """Return the common probability mass of the posteriors from two halves of the reference.

    The result is the mean over texels, in [0, 1]. It is low if noise makes the halves certain of
    different parameters, which the correlation of their entropies does not detect.
    """
    p, q = (np.array(half.probabilities, np.float64)[seen] for half in halves)
    return float(np.minimum(p, q).reshape(len(p), -1).sum(axis=1).mean())


MASSES = (0.5, 0.9)


def agreement(entropy: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return Pearson's and Spearman's correlation of two entropies (n,)."""
    return {"pearson": pearson(entropy, reference), "spearman": spearman(entropy, reference)}


def score_posterior(
    probabilities: np.ndarray,
    axes: Mapping[str, np.ndarray],
    truth: GroundTruth,
    entropy: np.ndarray,
    texels: np.ndarray,
) -> dict[str, Any]:
    """Compare a posterior with the true parameters.

    A posterior with separate channels is compared with the truth of each channel, a grey
    posterior with the mean over channels. The estimate is the most probable cell.

    Args:
        probabilities: Probabilities (n, *grid), or (n, *grid, 3) for separate channels.
        axes: Nodes of each parameter, in the order of the axes of the grid.
        truth: True parameters of all T texels.
        entropy: Entropy (n,) of the posterior.
        texels: Indices (n,) of the texels of the posterior.

    Returns:
        ``credible``: coverage of credible sets, by their mass. ``parameters``: by name, bias, mae
        and rmse of the estimate, ``entropy_correlation`` of absolute error and entropy, and ause.
        ``ause``, ``ause_relative``: means over parameters. ``sparsification``: curves by parameter.

    Raises:
        ShapeError: The probabilities do not fit the axes.
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
    """Return probabilities (channels * n, *grid), and the number of channels, 1 or 3."""
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
    """Return true values (channels * n,) by parameter, in the order of ``_channels``."""
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
    title="Agreement with path tracing and with the truth",
    experiment=_experiment,
    summary=lambda record: {**record, "summary": summarize(record["cells"])},
    tables=accuracy_tables,
    lines=agreement_lines,
    plots={"time_error": time_error, "scatter": scatter, "sparsification": curves},
)  # fmt: skip
