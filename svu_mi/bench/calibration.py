"""``svu bench calibration``: error bars of the preset ``default``, compared with the truth.

1500 visible texels per case are compared with the true textures, averaged over each texel:

* shares of 90 and 50 % credible sets (cells of the grid, the last one in part) and of 90 %
  intervals that contain the truth; of narrow intervals, at most .05 to either side, too;
* interval score, CRPS of draws, and PSNR of means; correlation of predicted errors (root of the
  summed variances) and true errors (root of the summed squared errors of all parameters);
* ``before``: the same without the test by folds and the prior of metals, with eight levels;
* in some cases, correlation of the entropy with path-traced entropy for the same likelihood, and
  the scores for photographs that the model does not explain (``VARIANTS``);
* metallic of dark dielectrics and real metals (``plain_balls``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from svu_mi.bench import spoiled_captures as spoiled
from svu_mi.bench.accuracy import reference_of
from svu_mi.bench.correlation import pearson, spearman
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Measurement, Record
from svu_mi.bench.markdown import Bar, Column, digits, table, tabulate
from svu_mi.bench.plain_balls import BallCase
from svu_mi.bench.posterior_scores import JUDGED, posterior_figures
from svu_mi.bench.study import Selection, Study
from svu_mi.calibration.light.estimate_light import estimate_light
from svu_mi.calibration.light.resolve_light import with_light
from svu_mi.capture.capture import Capture
from svu_mi.geometry.texel_materials import parameters_at
from svu_mi.geometry.texels import Texels, texels
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import observe
from svu_mi.presets import preset

SIZES: dict[str, Any] = {"views": 60, "film": 256, "spp": 32}
QUICK: dict[str, Any] = {"views": 16, "film": 48, "spp": 4}
TEXELS, QUICK_TEXELS = 192, 32  # per side
TRACED, SPP = 100, 256  # path-traced texels, and their samples
QUICK_TRACED, QUICK_SPP = 30, 16
FINER = 4  # samples of the true textures per side of a texel
BEFORE = {"folds": 0, "bare_metals": 0.0, "metal_share": 0.5, "levels": 8}
WITH_VARIANTS = 6  # cases whose variants are measured
GREY = (0.5, 0.5, 0.5)
SHOWN = {
    "90 r": "90 % sets: r", "90 m": "m", "90 c": "c", "90 rm": "r, m", "50 r": "50 %: r",
    "50 m": "m", "50 c": "c", "50 rm": "r, m", "pearson": "Pearson", "spearman": "Spearman",
    "ause r": "AUSE r", "ause m": "m", "ause c": "c", "psnr r": "PSNR r", "psnr m": "m",
    "psnr c": "c",
}  # fmt: skip
PARAMETERS = {"r": "roughness", "m": "metallic", "c": "base colour"}


@dataclass(frozen=True)
class CalibrationCase(CaseSubject):
    """A case whose posterior is compared with the true textures.

    Attributes:
        varied: True if path-traced entropy and variants of its photographs are measured, too.
    """

    varied: bool

    @property
    def rows(self) -> tuple[Measurement, ...]:
        return PARTS if self.varied else PARTS[:2]

    @property
    def photographs(self) -> dict[str, Any]:
        """Number and size of photographs, and their samples per pixel."""
        return QUICK if self.bench.quick else SIZES

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the case."""
        return self.bench.capture(self.case, "calibration", **self.photographs)

    @property
    def bounced(self) -> Capture:
        """Photographs with all bounces."""
        case = replace(self.case, defines={**self.case.defines, "max_depth": "6"})
        return self.bench.capture(case, "calibration-bounces", **self.photographs)

    def texels_of(self, capture: Capture) -> Texels:
        """Return the texels of a capture's mesh."""
        return texels(capture.mesh, QUICK_TEXELS if self.bench.quick else TEXELS)

    @cached_property
    def layout(self) -> Texels:
        """Texels of the object."""
        return self.texels_of(self.capture)

    @cached_property
    def true_means(self) -> dict[str, np.ndarray]:
        """Mean of the true texture over each texel, (T,) or (T, 3) by parameter."""
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
        return self._scores(self.estimated(**switches), np.arange(self.layout.count))

    def estimated(self, **switches: Any) -> Estimate:
        """Return the estimate of the preset ``default`` with ``switches`` replaced."""
        chosen = preset("default", method="angular", **switches)
        return estimate(self.capture, self.layout, preset=chosen, method="angular")

    def varied_as(self, name: str) -> Record:
        """Return the scores of the preset ``default`` for a variant."""
        capture = VARIANTS[name](self)
        layout = self.texels_of(capture)
        # The nearest texel of the true mesh; it is the same one if the mesh is.
        here, there = (one.position.numpy().T for one in (layout, self.layout))
        found = estimate(capture, layout)
        predicted = found.prediction
        verdict = {} if predicted is None else {
            "reliable": predicted.reliable, "cause": predicted.cause,
        }  # fmt: skip
        return {**self._scores(found, cKDTree(there).query(here)[1]), **verdict}

    def _scores(self, found: Estimate, truth: np.ndarray) -> Record:
        """Return scores; ``truth`` (T,) is the texel of ``layout`` at each texel."""
        seen = np.flatnonzero(found.posterior.observed)
        chosen = np.random.default_rng(0).choice(seen, min(JUDGED, len(seen)), replace=False)
        chosen.sort()
        true = {name: values[truth[chosen]] for name, values in self.true_means.items()}
        spread = found.posterior.kernel.spread.get("roughness", 1.0)
        return {**posterior_figures(found.posterior, true, chosen), "spread": spread}

    def traced(self) -> Record:
        """Return correlations with path-traced entropy: of the reference's prior, and as shown."""
        count, spp = (QUICK_TRACED, QUICK_SPP) if self.bench.quick else (TRACED, SPP)
        reference = reference_of(
            self.bench, self.capture, self.layout, subset=count, spp=spp, noise="estimated"
        )
        seen = reference.coverage > 0
        true, found = reference.entropy[seen], {}
        for key, changes in (("rho", BEFORE), ("rho now", {})):
            entropy = np.array(self.estimated(**changes).entropy, np.float64)
            found[key] = pearson(entropy[reference.subset][seen], true)
        return {
            **found,
            "halves": reference.split_half().correlation,
        }


VARIANTS: dict[str, Callable[[CalibrationCase], Capture]] = {
    "table": lambda case: spoiled.on_table(case.capture, GREY, case.photographs["spp"]),
    "bounces": lambda case: case.bounced,
    "poses": lambda case: spoiled.wrong_poses(case.capture, 0.2),
    "coarse mesh": lambda case: spoiled.coarse_mesh(case.capture, 0.2),
    "found light": lambda case: with_light(
        case.capture, estimate_light(observe(case.capture, case.layout))
    ),
    "relief": lambda case: spoiled.with_relief(case.capture, 6, case.photographs["spp"]),
}


def _variant(name: str) -> Measurement:
    return Measurement(name, lambda case: case.varied_as(name))


PARTS = (
    Measurement("default", CalibrationCase.calibration),
    Measurement("before", lambda subject: subject.calibration(**BEFORE)),
    Measurement("traced", CalibrationCase.traced),
    *(_variant(name) for name in VARIANTS),
)
# --- tables ---------------------------------------------------------------------------------


def _rows(record: Record, part: str) -> list[Record]:
    """Return the results of a row, one per case that has it."""
    return [case["rows"][part] for case in record["cells"] if part in case["rows"]]


def _mean(rows: Iterable[Record], key: str) -> float:
    return float(np.mean([row[key] for row in rows]))


def _narrow(rows: list[Record]) -> float:
    """Return the share of all narrow intervals of roughness that contain the truth."""
    share, held = (np.array([row[key] for row in rows]) for key in ("settled r", "settled r holds"))
    return float((share * held).sum() / max(share.sum(), 1e-9))


def find_bars(record: Record) -> list[Bar]:
    """Return the bars of a record of ``svu bench calibration``."""
    rows, before = (_rows(record, part) for part in ("default", "before"))
    if not before:
        return []
    bars = []
    for key, name in PARAMETERS.items():
        held = [row[f"interval {key}"] for row in rows]
        title = f"{name}: 90 % intervals that contain the truth"
        bars += [Bar(f"{title}, at least", float(np.mean(held)), 0.85, least=True),
                 Bar(f"{title}, worst case", min(held), 0.75, least=True)]  # fmt: skip
        if key != "m":
            bars.append(Bar(f"{title}, at most", float(np.mean(held)), 0.97))
        score = _mean(rows, f"score {key}") / _mean(before, f"score {key}")
        lost = _mean(before, f"psnr {key}") - _mean(rows, f"psnr {key}")
        bars += [Bar(f"{name}: interval score, relative to before", score, 1.0),
                 Bar(f"{name}: PSNR of means lost since before", lost, 0.1, "dB")]  # fmt: skip
    losses = [old["psnr m"] - new["psnr m"] for old, new in zip(before, rows, strict=True)]
    some = _mean(rows, "settled r") / max(_mean(before, "settled r"), 1e-9)
    bars += [
        Bar("metallic: PSNR of means lost since before, worst case", max(losses), 1.0, "dB"),
        Bar("narrow intervals of roughness with the truth", _narrow(rows), 0.82, least=True),
        Bar("narrow intervals of roughness, relative to before", some, 0.7, least=True),
        Bar("Pearson of predicted and true errors", _mean(rows, "pearson"), 0.75, least=True),
        Bar("Spearman of predicted and true errors", _mean(rows, "spearman"), 0.78, least=True),
    ]
    for name in VARIANTS:
        varied = _rows(record, name)
        limits = {"found light": (0.75, 0.85, 0.75), "relief": (0.6, 0.0, 0.0)}
        for key, limit in zip(PARAMETERS, limits.get(name, (0.8, 0.88, 0.85)), strict=True):
            if varied and limit:
                title = f"{name}: 90 % intervals of {PARAMETERS[key]} with the truth"
                bars.append(Bar(title, _mean(varied, f"interval {key}"), limit, least=True))
    for name, limit in (("dark dielectrics", 0.88), ("real metals", 0.9)):
        if balls := _rows(record, name):
            title = f"{name}: 90 % intervals of metallic with the truth"
            bars.append(Bar(title, _mean(balls, "interval m"), limit, least=True))
    return bars


def _tables(record: Record) -> list[str]:
    rows = _rows(record, "default")
    if not rows:
        return []
    names = [case["cell"] for case in record["cells"] if "default" in case["rows"]]
    values = {key: [one[key] for one in rows] for key in SHOWN}
    means = {key: float(np.mean(x)) for key, x in values.items()}
    lowest = {key: float(np.min(x)) for key, x in values.items()}
    summary = [(f"**mean of {len(rows)}**", means), ("lowest", lowest)]
    lines = [*summary, *zip(names, rows, strict=True)]
    shown = [Column("object / light", lambda line: line[0])] + [
        Column(title, lambda line, key=key: line[1][key],  # type: ignore[misc]
               digits(1 if key.startswith("psnr") else 2))
        for key, title in SHOWN.items()
    ]  # fmt: skip
    traced = [[case["cell"], *(digits(2)(case["rows"]["traced"].get(key, np.nan))
                                for key in ("rho", "rho now", "halves"))]
              for case in record["cells"] if "traced" in case["rows"]]  # fmt: skip
    return [
        f"At most {JUDGED} texels per case; r, m and c are roughness, metallic and base colour.",
        tabulate(shown, lines), *_compared(rows, _rows(record, "before")),
        "Correlation with the path-traced entropy of the same likelihood and a flat prior: of the "
        "entropy before folds and the prior of metals, of that now, and of halves of the samples.",
        table(("object / light", "before", "now", "halves"), traced), *_others(record),
    ]  # fmt: skip


def _compared(rows: list[Record], before: list[Record]) -> list[str]:
    """Return a table of scores before and now, and correlations of all cases together."""
    if not before:
        return []
    shown = ("crps", "score", "interval", "settled", "settled {} holds", "psnr")
    keys = [what if "{}" in what else f"{what} {{}}" for what in shown]
    lines = [
        [name, *(f"{_mean(before, what.format(key)):.3f} -> {_mean(rows, what.format(key)):.3f}"
                 for what in keys)]
        for key, name in PARAMETERS.items()
    ]  # fmt: skip
    true, predicted = (np.concatenate([row[key] for row in rows]) for key in ("errors", "expected"))
    return [
        "Before and after the test by folds and the prior of metals:",
        table(("parameter", "CRPS", "interval score", "90 % intervals with the truth",
               "intervals within .05", "narrow intervals with the truth", "PSNR (dB)"), lines),
        f"Predicted and true errors of all cases together: Pearson {pearson(true, predicted):.2f}, "
        f"Spearman {spearman(true, predicted):.2f}.",
    ]  # fmt: skip


OTHERS = (
    Column("case", lambda line: line["cell"]),
    Column("photographs", lambda line: line["row"]),
    *(Column(f"90 % {key}", lambda line, key=key: line.get(f"interval {key}"),  # type: ignore[misc]
             digits(2)) for key in PARAMETERS),
    *(Column(f"PSNR {key}", lambda line, key=key: line.get(f"psnr {key}"),  # type: ignore[misc]
             digits(1)) for key in PARAMETERS),
    Column("verdict", lambda line: line.get("reliable"),
           lambda reliable: "reliable" if reliable else "unreliable"),
)  # fmt: skip


def _others(record: Record) -> list[str]:
    """Return a table of variants and balls: means of each kind, then its cases."""
    lines: list[Record] = []
    kinds = [*VARIANTS, "dark dielectrics", "real metals"]
    for kind in kinds:
        if rows := _rows(record, kind):
            keys = [key for key in rows[0] if key.startswith(("interval", "psnr"))]
            lines.append({"cell": f"**mean of {len(rows)}**", "row": kind,
                          **{key: _mean(rows, key) for key in keys}})  # fmt: skip
    lines += [
        {"cell": case["cell"], "row": kind, **case["rows"][kind]}
        for kind in kinds
        for case in record["cells"]
        if kind in case["rows"]
    ]
    return ["Photographs that the model does not explain, and balls of one material:",
            tabulate(OTHERS, lines)] if lines else []  # fmt: skip


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    cases = selection.cases
    every = max(len(cases) // WITH_VARIANTS, 1)
    lights = {case.light: case for case in reversed(cases)}
    return Experiment("calibration", [
        # One light after the other, so that all lights have variants.
        *(CalibrationCase(bench, case, (number + number // len(lights)) % every == 0)
          for number, case in enumerate(cases)),
        *(BallCase(bench, lights[light]) for light in dict.fromkeys(case.light for case in cases)),
    ], True)  # fmt: skip


STUDY = Study(title="Calibration of the posterior", experiment=_experiment, tables=_tables,
              bars=find_bars, own_sizes=True)  # fmt: skip
