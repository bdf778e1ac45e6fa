"""Table 3 of the paper: agreement of entropies with a path tracer.

Pearson's correlation of entropies over 400 texels (64 paths per ray, direct light, 8 x 8 x 8
parameters), 60 photographs of 256 x 256:

* rows of the paper: SH model (Eq. 6) in angle and power spectra (Eq. 11), both as printed; the
  reference also sums errors over views (sigma .4 of the mean radiance);
* the same over open texels, where the object occludes less than 3 % of the irradiance;
* other readings of the paper, and steps from the SH model to ours: light given in all directions,
  GGX lobes with their Fresnel term, cells of the light, occlusion;
* ours, with a reference that takes the mean over views (sigma .08).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from svu_mi.bench.accuracy import reference_of
from svu_mi.bench.correlation import pearson
from svu_mi.bench.experiment import CaseSubject, Record
from svu_mi.bench.markdown import Column, digits, tabulate
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.tabulated import tabulated_posterior
from svu_mi.presets import Fit, Method, preset

FULL, QUICK = (400, 64), (60, 8)  # texels of the reference, and paths per ray
SUM, MEAN = 0.4, 0.08  # sigma relative to the mean radiance
LOSES = 0.97  # least share of the irradiance that reaches an open texel


@dataclass(frozen=True)
class EntropyRow:
    """An estimator whose correlation with a reference is a row of the table.

    Attributes:
        label: Label of the row.
        method: Method of ``estimate``.
        preset: Preset of ``estimate``.
        reference: ``sum`` or ``mean`` of errors over views, as used by the reference.
        open: Add a row that compares only open texels.
    """

    label: str
    method: Method
    preset: Any
    reference: str
    open: bool = False


def _entropy_rows() -> tuple[EntropyRow, ...]:
    def paper(label: str, *, open: bool = False, **switches: Any) -> EntropyRow:
        which = "mean" if switches.get("errors") == "mean" else "sum"
        chosen = preset("paper", method="angular", **switches)
        return EntropyRow(label, "angular", chosen, which, open)

    def ours(label: str, *, open: bool = False, **switches: Any) -> EntropyRow:
        chosen = preset("fixed", method="angular", errors="sum", sigma=SUM, **switches)
        return EntropyRow(label, "angular", chosen, "sum", open)

    relative = preset("paper", method="spectrum", noise="relative", sigma=0.02)
    return (
        paper("SH model (paper)", open=True),
        EntropyRow("spectrum (paper)", "spectrum", preset("paper", method="spectrum"), "sum", True),
        EntropyRow("spectrum (paper), relative noise", "spectrum", relative, "sum"),
        paper("SH model, mean over views", errors="mean", sigma=MEAN),
        paper("SH model, band-limit undone", fit=Fit(undo_prefilter=True)),
        paper("SH model, degree 5", fit=Fit(degree=5)),
        paper("SH model, degree 9", fit=Fit(degree=9)),
        paper("SH model, lambda 1e-2", fit=Fit(regularizer=1e-2)),
        paper("SH model, constant free", fit=Fit(penalize_constant=False)),
        paper("its lobes, light known everywhere", fit=None),
        ours("GGX lobes, light known everywhere", cells=0),
        ours("cells of the light, nothing occluded", occluded=False),
        ours("fixed, sum over views", open=True),
        EntropyRow("fixed", "angular", preset("fixed", method="angular"), "mean"),
        EntropyRow("spectrum (ours)", "spectrum", preset("default", method="spectrum"), "mean"),
    )


@dataclass(frozen=True)
class Table3(CaseSubject):
    """A case whose entropies are compared with path-traced ones."""

    @property
    def name(self) -> str:
        return f"table3/{self.case.name}"

    @property
    def rows(self) -> Sequence[EntropyRow]:
        return _entropy_rows()

    def settings(self, row: EntropyRow | None) -> Any:
        return super().settings(None), self.bench.quick, row and asdict(row)

    @cached_property
    def observed(self) -> Estimate:
        """Estimate by the paper's power spectra; other estimates reuse its visibility."""
        return estimate(self.capture, self.layout, "spectrum", "paper")

    @cached_property
    def reference(self) -> Any:
        """Path-traced posterior with errors summed over views."""
        texels, spp = QUICK if self.bench.quick else FULL
        return reference_of(
            self.bench, self.capture, self.layout, subset=texels, spp=spp, sigma=SUM, errors="sum"
        )

    @cached_property
    def seen(self) -> np.ndarray:
        """Visible texels of the reference, (n,) bool."""
        return self.reference.coverage > 0

    @cached_property
    def entropies(self) -> dict[str, list[np.ndarray]]:
        """Entropies of reference and halves, by ``sum`` and ``mean`` of errors over views."""
        reference, result = self.reference, {}
        posterior = partial(tabulated_posterior, grid=reference.posterior.grid, observed=self.seen)
        views = reference.coverage[:, None, None, None]
        for name, factor in (("sum", views), ("mean", (SUM / MEAN) ** 2)):
            result[name] = [
                np.array(posterior(table * factor).entropy(), np.float64)[self.seen]
                for table in reference.tables
            ]
        return result

    @cached_property
    def open(self) -> np.ndarray:
        """Texels whose irradiance the object hardly occludes, (n,) bool."""
        observed, result = self.observed.observed, np.zeros(self.layout.count, bool)
        assert observed is not None
        rules = (preset("default", method="spectrum", occluded=on) for on in (True, False))
        arrives, whole = (observed.irradiance(rule, 1)[0].numpy() for rule in rules)
        result[observed.seen] = arrives > LOSES * whole
        return result[self.reference.subset][self.seen]

    def head(self) -> Record:
        """Return correlations of each reference's halves, and of references and simple maps."""
        simple: Record = {}
        for which, (whole, *halves) in self.entropies.items():
            simple[f"reference's halves ({which})"] = correlation(*halves)
            for name in ("coverage", "brightness"):
                values = getattr(self.reference, name)[self.seen]
                simple[f"{name} ({which})"] = correlation(-values, whole)
            simple[f"mean entropy of the reference ({which})"] = float(whole.mean())
        return {"part": "table3", "cell": self.title, "simple": simple,
                "open texels, part": float(self.open.mean())}  # fmt: skip

    def measure(self, row: EntropyRow) -> Record:
        """Return an estimator's correlation with the reference, over all and open texels."""
        estimated = estimate(self.observed, method=row.method, preset=row.preset)
        own = np.array(estimated.entropy, np.float64)[self.reference.subset][self.seen]
        truth = self.entropies[row.reference][0]
        record = {"rho": correlation(own, truth)}
        if row.open:
            record["open"] = correlation(own[self.open], truth[self.open])
        return record


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return Pearson's correlation; NaN if either is constant."""
    varied = np.ptp(a) > 0 and np.ptp(b) > 0
    return pearson(a, b) if varied else float("nan")


def table3_tables(cases: list[Record]) -> list[str]:
    """Return a table with mean and lowest value of each row over the cases."""
    lines = []
    for label, first in cases[0]["rows"].items():
        lines.append((label, [case["rows"][label]["rho"] for case in cases]))
        if "open" in first:
            values = [case["rows"][label]["open"] for case in cases]
            lines.append((f"{label}, open texels", values))
    lines += [(name, [case["simple"][name] for case in cases]) for name in cases[0]["simple"]]
    shown = (
        Column("row", lambda line: line[0]),
        Column(f"mean of {len(cases)} cases", lambda line: np.mean(line[1]), digits(3)),
        Column("lowest", lambda line: np.min(line[1]), digits(3)),
    )
    return ["## Table 3: entropy compared with path tracing", tabulate(shown, lines)]
