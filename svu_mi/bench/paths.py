"""``svu bench paths``: agreement with path tracing under indirect light and other noise models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from svu_mi.bench.accuracy import agreement
from svu_mi.bench.compared_estimators import Variant
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Record
from svu_mi.bench.markdown import Column, digits, tabulate
from svu_mi.bench.reflected import SIZES
from svu_mi.bench.scene_light import SAMPLES, scene_light_posteriors
from svu_mi.bench.study import Selection, Study
from svu_mi.capture.capture import Capture
from svu_mi.capture.surroundings import DEPTH
from svu_mi.evaluation.reference_options import Noise
from svu_mi.geometry.texels import Texels, texels
from svu_mi.posterior.observations import Observed, observe

SIDE = 96  # texels per side
TEXELS, QUICK = 200, (40, 8)  # texels of the references, and their samples


class Kind(NamedTuple):
    """Comparison of an estimate with a reference.

    Attributes:
        light: light of photographs and reference, direct or all.
        bounces: the estimate has ``--bounces``.
        noise: noise model of the reference.
    """

    title: str
    light: str
    bounces: bool
    noise: Noise


KINDS = {
    "direct": Kind("direct light", "direct", False, "relative"),
    "both": Kind("all light", "all", False, "relative"),
    "bounces": Kind("all light, `--bounces`", "all", True, "relative"),
    "heteroscedastic": Kind("direct, growing noise", "direct", False, "heteroscedastic"),
    "estimated": Kind("direct, estimated noise", "direct", False, "estimated"),
    "estimated both": Kind("all light, estimated noise", "all", False, "estimated"),
    "estimated bounces": Kind("the same, `--bounces`", "all", True, "estimated"),
}


@dataclass(frozen=True)
class PathsCase(CaseSubject):
    """A case, photographed once with direct light and once with direct and indirect light.

    Attributes:
        rows: Estimators.
    """

    rows: Sequence[Variant]

    def settings(self, row: Variant | None) -> Any:
        how = None if row is None else (row.method, asdict(row.preset))
        return super().settings(row), TEXELS, SAMPLES, SIDE, SIZES, how

    def head(self) -> Record:
        """Return ``cell``, number of ``texels``, and correlations of ``halves`` of references."""
        halves = {kind: self._halves(reference) for kind, reference in self.references.items()}
        return {"cell": self.title, "texels": len(self.chosen), "halves": halves}

    def measure(self, row: Variant) -> Record:
        """Return the correlation of an estimator with each reference, by kind."""
        estimates = {}
        for light, bounces in {(kind.light, kind.bounces) for kind in KINDS.values()}:
            variant = replace(row, switches={**row.switches, "bounces": True}) if bounces else row
            if not bounces or (row.method == "angular" and row.preset.with_surfaces):
                found = variant.estimate(self.captures[light], self.layout)
                estimates[light, bounces] = np.array(found.entropy, float)[self.chosen]
        kept = {name: estimates.get((kind.light, kind.bounces)) for name, kind in KINDS.items()}
        return {name: self._agreement(entropy, self.references[name])
                for name, entropy in kept.items() if entropy is not None}  # fmt: skip

    def _agreement(self, entropy: np.ndarray, reference: Any) -> dict[str, float]:
        seen = reference.posterior.observed
        return agreement(entropy[seen], reference.entropy[seen])

    def _halves(self, reference: Any) -> dict[str, float]:
        halves, seen = reference.split_half(), reference.posterior.observed
        return agreement(halves.first[seen], halves.second[seen])

    @cached_property
    def captures(self) -> dict[str, Capture]:
        """Captures with direct and with all light, those of ``svu bench reflected``."""
        lit = replace(self.case, defines={**self.case.defines, "max_depth": str(DEPTH)})
        sizes = self.bench.sizes.shared if self.bench.quick else SIZES
        sizes = {name: sizes[name] for name in SIZES}
        return {
            "direct": self.bench.capture(self.case, "reflected", **sizes),
            "all": self.bench.capture(lit, "reflected-bounces", **sizes),
        }

    @cached_property
    def layout(self) -> Texels:
        """Texels of the object."""
        return texels(self.captures["direct"].mesh, SIDE)

    @cached_property
    def observed(self) -> dict[str, Observed]:
        """Visibility in both captures."""
        return {name: observe(capture, self.layout) for name, capture in self.captures.items()}

    @cached_property
    def chosen(self) -> np.ndarray:
        """Random texels, (n,) int64."""
        seen = np.flatnonzero(self.observed["direct"].coverage)
        count = min(QUICK[0] if self.bench.quick else TEXELS, len(seen))
        random = np.random.default_rng(self.bench.sizes.seed)
        return np.sort(random.choice(seen, count, replace=False))

    @cached_property
    def references(self) -> dict[str, Any]:
        """Path-traced posteriors of the same texels, by kind."""
        samples, made = QUICK[1] if self.bench.quick else SAMPLES, {}
        for light, observed in self.observed.items():
            models = sorted({kind.noise for kind in KINDS.values() if kind.light == light})
            depth = DEPTH if light == "all" else 2
            found = scene_light_posteriors(observed, self.chosen, models, depth, samples)
            made.update({(light, model): each for model, each in zip(models, found, strict=True)})
        return {name: made[kind.light, kind.noise] for name, kind in KINDS.items()}


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    subjects = (PathsCase(bench, case, selection.variants) for case in selection.cases)
    return Experiment("paths", subjects)


def tables(record: Record) -> list[str]:
    """Return a table of each correlation, with one line per case and estimator."""
    lines = [(case["cell"], label, row) for case in record["cells"]
             for label, row in [("halves of the reference", case["halves"]),
                                *case["rows"].items()]]  # fmt: skip

    def value(kind: str, correlation: str) -> Column:
        title = KINDS[kind].title
        return Column(title, lambda line: line[2].get(kind, {}).get(correlation), digits(3))

    def table(correlation: str) -> str:
        names = Column("object / light", lambda line: line[0]), Column("map", lambda line: line[1])
        return tabulate((*names, *(value(kind, correlation) for kind in KINDS)), lines)

    most = max((case["texels"] for case in record["cells"]), default=0)
    return [
        f"Pearson correlation with path-traced posteriors of up to {most} texels. All light: up to "
        "5 bounces in photographs and reference, which gives each texel all materials while the "
        "rest of the object keeps its own. Noise is as assumed by `fixed`, grows with radiance, or "
        "is estimated as by `default`.",
        table("pearson"),
        "Spearman correlation:",
        table("spearman"),
    ]


STUDY = Study(title="Indirect light and other noise", experiment=_experiment, own_sizes=True,
              tables=tables)  # fmt: skip
