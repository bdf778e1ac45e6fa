"""``svu bench paths``: agreement with path tracing under indirect light and other noise models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.bench.accuracy import reference_of
from svu_mi.bench.compared_estimators import Variant
from svu_mi.bench.correlation import pearson
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Record
from svu_mi.bench.markdown import Column, digits, tabulate
from svu_mi.bench.study import Selection, Study
from svu_mi.capture.capture import Capture
from svu_mi.geometry.texels import Texels, texels

DEPTH = 4  # path length of the reference with indirect light
PHOTOGRAPHS = 6  # path length of the photographs with indirect light
# Indirect light requires a render of every psi, so only few texels are compared.
TEXELS, SAMPLES, OBJECTS = 150, 32, 4
QUICK = (40, 8, 1)
KINDS = {
    "direct": "direct light",
    "photographs": "all light in the photographs",
    "both": "all light in both",
    "heteroscedastic": "noise grows with radiance",
    "estimated": "noise is estimated",
}


@dataclass(frozen=True)
class PathsCase(CaseSubject):
    """A case, photographed once with direct light and once with direct and indirect light.

    Attributes:
        rows: Estimators.
        texels: Number of texels of the references.
        samples: Samples per ray of the references.
    """

    rows: Sequence[Variant]
    texels: int = TEXELS
    samples: int = SAMPLES

    def settings(self, row: Variant | None) -> Any:
        how = None if row is None else (row.method, asdict(row.preset))
        return super().settings(row), self.texels, self.samples, how

    def head(self) -> Record:
        """Return ``cell``, number of ``texels``, and correlation between ``references``."""
        one, other = self.references["photographs"], self.references["both"]
        kept = one.posterior.observed & other.posterior.observed
        rho = pearson(one.entropy[kept], other.entropy[kept])
        return {"cell": self.title, "texels": int(kept.sum()), "references": rho}

    def measure(self, row: Variant) -> Record:
        """Return Pearson's correlation of an estimator with each reference, by kind."""
        entropies = {id(capture): np.array(row.estimate(capture, self.layout).entropy, float)
                     for capture in self.captures}  # fmt: skip
        correlations = {}
        for kind, reference in self.references.items():
            seen = reference.posterior.observed
            entropy = entropies[id(self.capture_of(kind))][reference.subset[seen]]
            correlations[kind] = pearson(entropy, reference.entropy[seen])
        return correlations

    @cached_property
    def captures(self) -> tuple[Capture, Capture]:
        """Captures with direct light, and with direct and indirect light."""
        lit = replace(self.case, defines={**self.case.defines, "max_depth": str(PHOTOGRAPHS)})
        return self.bench.capture(self.case), self.bench.capture(lit, "capture_all_light")

    def capture_of(self, kind: str) -> Capture:
        """Return the capture for a kind in ``KINDS``."""
        return self.captures[kind in ("photographs", "both")]

    @cached_property
    def layout(self) -> Texels:
        """Texels of the object."""
        return texels(self.captures[0].mesh, self.bench.sizes.texels)

    @cached_property
    def references(self) -> dict[str, Any]:
        """Path-traced posteriors of the same texels, by kind."""

        def traced(kind: str, **changes: Any) -> Any:
            return reference_of(
                self.bench, self.capture_of(kind), self.layout, spp=self.samples, **changes
            )

        plain = traced("direct", subset=self.texels)
        how: dict[str, dict[str, Any]] = {
            "photographs": {},
            "both": {"method": "brute", "max_depth": DEPTH},
            "heteroscedastic": {"noise": "heteroscedastic"},
            "estimated": {"noise": "estimated"},
        }
        others = {kind: traced(kind, subset=plain.subset, **one) for kind, one in how.items()}
        return {"direct": plain, **others}


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    first = {case.object: case for case in reversed(selection.cases)}
    count, samples, objects = QUICK if bench.quick else (TEXELS, SAMPLES, OBJECTS)
    chosen = list(first.values())[::-1][:objects]
    subjects = (PathsCase(bench, case, selection.variants, count, samples) for case in chosen)
    return Experiment("paths", subjects)


def tables(record: Record) -> list[str]:
    """Return a table with one line per case and estimator."""
    shown = (
        Column("object / light", lambda line: line[0]["cell"]),
        Column("map", lambda line: line[1]),
        *(Column(title, lambda line, kind=kind: line[2][kind], digits(2))  # type: ignore[misc]
          for kind, title in KINDS.items()),
        Column("both references", lambda line: line[0]["references"], digits(2)),
    )  # fmt: skip
    lines = [(case, label, row) for case in record["cells"] for label, row in case["rows"].items()]
    most = max((case["texels"] for case in record["cells"]), default=0)
    return [
        f"Pearson correlation with references that render every psi, on up to {most} texels. "
        "Direct light: in photographs and reference. All light in the photographs: up to 5 "
        "bounces, reference with direct light. All light in both: the same photographs, reference "
        "with up to 3 bounces, in which the whole object has the rendered psi. The next columns "
        "have direct light and noise that grows with radiance, or that is estimated as by "
        "`default` and `fast`. The last column compares both references with each other.",
        tabulate(shown, lines),
    ]


STUDY = Study(title="Indirect light and other noise", experiment=_experiment,
              tables=tables)  # fmt: skip
