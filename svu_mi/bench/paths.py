"""``svu bench paths``: agreement with path tracing under indirect light and other noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.bench.accuracy import reference_of
from svu_mi.bench.compared_estimators import Variant
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Record
from svu_mi.bench.markdown import Column, digits, tabulate
from svu_mi.bench.study import Selection, Study
from svu_mi.capture.capture import Capture
from svu_mi.evaluation.correlation import pearson
from svu_mi.geometry.texels import Texels, texels

DEPTH = 4  # of the reference with light between parts of the object
PHOTOGRAPHS = 6  # depth of the photographs it is compared on
# Every psi has to be rendered where light goes between parts of the object: for a few texels.
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
    """A case, photographed with direct light and with all light.

    Attributes:
        rows: estimators.
        texels, samples: of the references.
    """

    rows: Sequence[Variant]
    texels: int = TEXELS
    samples: int = SAMPLES

    def settings(self, row: Variant | None) -> Any:
        how = None if row is None else (row.method, asdict(row.preset))
        return super().settings(row), self.texels, self.samples, how

    def head(self) -> Record:
        """Return ``cell``, ``texels``, and ``references``: the correlation of those of direct and
        of all light."""
        one, other = self.references["photographs"], self.references["both"]
        kept = one.posterior.observed & other.posterior.observed
        rho = pearson(one.entropy[kept], other.entropy[kept])
        return {"cell": self.title, "texels": int(kept.sum()), "references": rho}

    def measure(self, row: Variant) -> Record:
        """Return Pearson's rho of an estimator with each of ``references``."""
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
        """Photographs of direct light, and of all light."""
        lit = replace(self.case, defines={**self.case.defines, "max_depth": str(PHOTOGRAPHS)})
        return self.bench.capture(self.case), self.bench.capture(lit, "capture_all_light")

    def capture_of(self, kind: str) -> Capture:
        """Return the photographs of one of ``CASES``."""
        return self.captures[kind in ("photographs", "both")]

    @cached_property
    def layout(self) -> Texels:
        """Texels that are estimated."""
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
    """Return a line per case and estimator."""
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
        f"Pearson correlation with references in which every psi is rendered, on up to {most} "
        "texels: of direct light; with photographs of up to "
        "5 bounces against the reference of direct light; with the same photographs against a "
        "reference of up to 3 bounces, in which all of the object has the psi in question; and "
        "of direct light, with noise that grows with radiance, and with noise that is estimated, "
        "as `default` and `fast` do. Last, the references of direct and of all light with each "
        "other.",
        tabulate(shown, lines),
    ]


STUDY = Study(title="Light between parts of the object, and other noise", experiment=_experiment,
              tables=tables)  # fmt: skip
