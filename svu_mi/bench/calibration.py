"""``svu bench calibration``: share of posterior intervals and sets that contain the truth.

The preset ``default`` is compared with the true textures, averaged over each texel, for 1500
visible texels (seed 0):

* shares of 90 and 50 % credible sets (cells of the grid, the last one in part) that contain the
  truth; and shares of the 90 % intervals that contain it;
* correlation of predicted errors (root of the summed variances) and true errors (root of the
  summed squared errors of all parameters); relative area under the sparsification error (0
  perfect, 1 random);
* CRPS of every parameter from draws, relative to the CRPS with overdispersion 3; PSNR of means;
* share of narrow 90 % intervals, at most .05 to either side, that contain the truth;
* correlation of the entropy with path-traced entropy for the same likelihood.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.bench.accuracy import reference_of
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Measurement, Record
from svu_mi.bench.markdown import Column, digits, table, tabulate
from svu_mi.bench.study import Selection, Study
from svu_mi.evaluation.correlation import pearson, sparsification, spearman
from svu_mi.evaluation.credible_sets import credible_coverage, nearest_bins
from svu_mi.geometry.texel_materials import parameters_at
from svu_mi.geometry.texels import texels
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate
from svu_mi.presets import preset

JUDGED, TRACED, SPP = 1500, 100, 256  # compared texels; path-traced texels, and their samples
QUICK_TRACED, QUICK_SPP = 30, 16
FINER = 4  # samples of the true textures per side of a texel
DRAWS = 64
SETTLED = 0.05
NODES = np.arange(8) / 7
SHOWN = {
    "90 r": "90 % sets: r", "90 m": "m", "90 c": "c", "90 rm": "r, m", "50 r": "50 %: r",
    "50 m": "m", "50 c": "c", "50 rm": "r, m", "pearson": "Pearson", "spearman": "Spearman",
    "ause r": "AUSE r", "ause m": "m", "ause c": "c", "psnr r": "PSNR r", "psnr m": "m",
    "psnr c": "c",
}  # fmt: skip

Truths = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class CalibrationCase(CaseSubject):
    """A case whose posterior is compared with the true textures."""

    @property
    def rows(self) -> tuple[Measurement, ...]:
        return PARTS

    @cached_property
    def chosen(self) -> np.ndarray:
        """Indices of the compared texels, (t,)."""
        seen = np.flatnonzero(np.array(estimate(self.capture, self.layout).coverage))
        count = min(JUDGED, len(seen))
        return np.sort(np.random.default_rng(0).choice(seen, count, replace=False))

    @cached_property
    def true_values(self) -> dict[str, np.ndarray]:
        """Mean of the true texture over each compared texel, (t,) or (t, 3) by parameter."""
        return {name: values[self.chosen] for name, values in self._true_means().items()}

    def _true_means(self) -> dict[str, np.ndarray]:
        """Return the mean of the true texture over each texel, (T,) or (T, 3) by parameter."""
        layout, width = self.layout, self.layout.resolution[0]
        fine = texels(self.capture.mesh, width * FINER)
        x, y = fine.index.numpy() % (width * FINER), fine.index.numpy() // (width * FINER)
        place = np.full(width * width, -1)
        place[layout.index.numpy()] = np.arange(layout.count)
        parent = place[(y // FINER) * width + x // FINER]
        inside = parent >= 0
        count = np.bincount(parent[inside], minlength=layout.count)
        own, result = parameters_at(self.capture, layout), {}
        for name, values in parameters_at(self.capture, fine).items():
            of_fine = np.atleast_2d(np.asarray(values, np.float64).T)[:, inside]
            sums = [np.bincount(parent[inside], column, layout.count) for column in of_fine]
            middle = np.atleast_2d(np.asarray(own[name], np.float64).T)
            mean = np.where(count > 0, np.array(sums) / np.maximum(count, 1), middle).T
            result[name] = mean if mean.shape[1] > 1 else mean[:, 0]
        return result

    def calibration(self, **switches: Any) -> Record:
        """Return the scores of the preset ``default`` with ``switches`` replaced."""
        chosen = preset("default", method="angular", **switches)
        estimated = estimate(self.capture, self.layout, preset=chosen, method="angular")
        return posterior_figures(estimated.posterior, self.true_values, self.chosen)

    def traced(self) -> Record:
        """Return the correlation of the entropy with path-traced entropy."""
        count, spp = (QUICK_TRACED, QUICK_SPP) if self.bench.quick else (TRACED, SPP)
        reference = reference_of(
            self.bench, self.capture, self.layout, subset=count, spp=spp, noise="estimated"
        )
        seen = reference.coverage > 0
        entropy = np.array(estimate(self.capture, self.layout).entropy, np.float64)
        return {
            "rho": pearson(entropy[reference.subset][seen], reference.entropy[seen]),
            "halves": reference.split_half().correlation,
        }


PARTS = (
    Measurement("default", CalibrationCase.calibration),
    Measurement("tau 3", lambda subject: subject.calibration(overdispersion=3.0)),
    Measurement("traced", CalibrationCase.traced),
)


# --- scores ---------------------------------------------------------------------------------


def posterior_figures(posterior: Any, truth: Truths, chosen: np.ndarray) -> Record:
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
        low, high = (_columns(np.array(end)) for end in posterior.interval(name, 0.9, chosen))
        inside = (mine >= low - 1e-6) & (mine <= high + 1e-6)
        settled = (high - low) / 2 <= SETTLED
        error, variance = ((mean - mine) ** 2).mean(axis=1), (sd**2).mean(axis=1)
        errors.append(error)
        variances.append(variance)
        drawn = np.array(draws[name])[:, chosen].astype(np.float64)
        result |= {
            f"interval {key}": float(inside.mean()), f"settled {key}": float(settled.mean()),
            f"settled {key} holds": float(inside[settled].mean()) if settled.any() else 1.0,
            f"psnr {key}": float(-10 * np.log10(np.mean((mean - mine) ** 2))),
            f"ause {key}": sparsification(np.sqrt(error), np.sqrt(variance)).relative,
            f"crps {key}": crps(drawn.reshape(DRAWS, *mine.shape), mine),
        }  # fmt: skip
    error, expected = np.sqrt(np.sum(errors, axis=0)), np.sqrt(np.sum(variances, axis=0))
    return result | {"pearson": pearson(error, expected),
                     "spearman": spearman(error, expected)}  # fmt: skip


def _columns(values: np.ndarray) -> np.ndarray:
    """Return values (t,) or (t, g) as (t, g)."""
    return values if values.ndim == 2 else values[:, None]


def set_coverage(p: np.ndarray, truth: Truths) -> Record:
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


def crps(drawn: np.ndarray, true: np.ndarray) -> float:
    """Return the mean CRPS, E|x - truth| - E|x - x'| / 2, of draws (n, t, g)."""
    n = len(drawn)
    ordered = np.sort(drawn, axis=0)
    weights = (2 * np.arange(n) - n + 1)[:, None, None]
    apart = 2 * (weights * ordered).sum(axis=0) / (n * (n - 1))
    return float((np.abs(drawn - true).mean(axis=0) - apart / 2).mean())


# --- tables ---------------------------------------------------------------------------------


def _tables(record: Record) -> list[str]:
    cases = record["cells"]
    if not cases:
        return []
    rows = [case["rows"]["default"] for case in cases]
    values = {key: [one[key] for one in rows] for key in rows[0]}
    means = {key: float(np.mean(x)) for key, x in values.items()}
    lowest = {key: float(np.min(x)) for key, x in values.items()}
    lines = [(f"**mean of {len(cases)}**", means), ("lowest", lowest)]
    lines += [(case["cell"], case["rows"]["default"]) for case in cases]
    shown = [Column("object / light", lambda line: line[0])] + [
        Column(title, lambda line, key=key: line[1][key],  # type: ignore[misc]
               digits(1 if key.startswith("psnr") else 2))
        for key, title in SHOWN.items()
    ]  # fmt: skip
    three = {key: np.mean([case["rows"]["tau 3"][key] for case in cases]) for key in means}
    by_parameter = [
        [name, f"{means[f'crps {key}']:.4f}", f"{means[f'crps {key}'] / three[f'crps {key}']:.3f}",
         *(f"{means[what]:.2f}" for what in
           (f"interval {key}", f"settled {key}", f"settled {key} holds"))]
        for name, key in (("roughness", "r"), ("metallic", "m"), ("base colour", "c"))
    ]  # fmt: skip
    traced = [[case["cell"], *(f"{case['rows']['traced'][key]:.2f}" for key in ("rho", "halves"))]
              for case in cases]  # fmt: skip
    return [
        f"At most {JUDGED} texels per case; r, m and c are roughness, metallic and base colour.",
        tabulate(shown, lines),
        table(("parameter", "CRPS", "relative to tau = 3", "90 % intervals with the truth",
               "intervals within .05", "narrow intervals with the truth"), by_parameter),
        "Correlation of the entropy with path-traced texels, and of two halves of their samples.",
        table(("object / light", "entropy", "halves"), traced),
    ]  # fmt: skip


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    return Experiment(
        "calibration", (CalibrationCase(bench, case) for case in selection.cases), True
    )


STUDY = Study(title="Calibration of the posterior", experiment=_experiment, tables=_tables)
