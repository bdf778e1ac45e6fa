"""What each switch of the estimators adds and costs.

    PYTHONPATH=tests python -m studies.switches [--quick] [--data FOLDER] [--objects A,B,...]
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from studies.command import Command, main
from svu_mi.bench.accuracy.measure import Compared
from svu_mi.bench.experiment import Bench, Experiment, Record
from svu_mi.bench.plots import COLORS, INK, page, save, tidy
from svu_mi.bench.study import Asked, Study
from svu_mi.bench.text import Column, columns, digits
from svu_mi.bench.variants import VARIANTS, Variant

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _spectrum(label: str, base: str = "default", **switches: Any) -> Variant:
    return Variant(f"spectrum {label}", "spectrum", base, switches)


def _angular(label: str, base: str = "default", **switches: Any) -> Variant:
    return Variant(f"angular {label}", "angular", base, switches)


# The reference assumes the noise that ``fixed`` does: what changes the model is compared there.
SWITCHES = (
    _spectrum("constant penalised", penalize_constant=True),
    _spectrum("band-limit undone", undo_prefilter=True),
    _spectrum("no occlusion", occluded=False),
    _spectrum("no albedo", albedo=False),
    _spectrum("roughness and Ks only", parameters="specular"),
    _spectrum("roughness and Ks only, uniform Ks", parameters="specular", spacing="uniform"),
    _spectrum("channels joint", channels="joint"),
    _spectrum("channels summed", channels="sum"),
    _spectrum("least of three channels", channels="minimum"),
    _spectrum("unknown noise", noise="marginal"),
    _spectrum("half the sigma", sigma=0.002),
    _spectrum("twice the sigma", sigma=0.008),
    _spectrum("degree 4", degree=4),
    _spectrum("degree 8", degree=8),
    _spectrum("regularizer 1e-3", regularizer=1e-3),
    _spectrum("regularizer 1e-1", regularizer=1e-1),
    _angular("default, channels grey", channels="grey"),
    _angular("default, any metallic alike", metals=0.0),
    _angular("default, edges count", edges=0.0),
    _angular("fixed, looked up", base="fixed", cells=0),
    _angular("fixed, looked up, Fresnel: none", base="fixed", cells=0, fresnel="none"),
    _angular("fixed, looked up, Fresnel: Schlick at theta_o", base="fixed", cells=0,
             fresnel="schlick"),
    _angular("fixed, looked up, lobe: Gaussian", base="fixed", cells=0, lobe="gaussian"),
    _angular("fixed, looked up, no off-specular shift", base="fixed", cells=0,
             off_specular=False),
    _angular("fixed, nothing occluded", base="fixed", occluded=False),
    _angular("fixed, 512 cells", base="fixed", cells=512),
    _angular("fixed, 2048 cells", base="fixed", cells=2048),
    _angular("fixed, Lambert", base="fixed", diffuse="lambert"),
    _angular("fixed, roughness and Ks only", base="fixed", parameters="specular"),
    _angular("fixed, channels joint", base="fixed", channels="joint"),
    _angular("fixed, noise grows", base="fixed", noise="heteroscedastic", sigma=0.16),
    _angular("fixed, unknown noise", base="fixed", noise="marginal"),
    _angular("fixed, half the sigma", base="fixed", sigma=0.04),
    _angular("fixed, twice the sigma", base="fixed", sigma=0.16),
)  # fmt: skip


def base_of(label: str, labels: Collection[str]) -> str:
    """Return what a switch is a difference to: the variant that it is named after, up to the last
    comma, or ``default`` of its method."""
    named = label.rpartition(", ")[0]
    return named if named in labels else f"{label.split()[0]} default"


def experiment(bench: Bench, asked: Asked) -> Experiment:
    """Return what is measured: the estimators of ``asked``, and all switches."""
    rows = [*asked.variants, *SWITCHES]
    return Experiment("switches", (Compared(bench, cell, rows) for cell in asked.cells), True)


def changes(record: Record) -> list[Record]:
    """Return what every switch changes in comparison with its base.

    Args:
        record: of this study.

    Returns:
        Per switch ``label``, ``base``, ``pearson`` of every cell and of the base, part of the
        90 % sets that hold the truth, and ``seconds`` that it takes longer; means over cells.
    """
    found = []
    for label in record["cells"][0]["rows"] if record["cells"] else ():
        base = base_of(label, record["cells"][0]["rows"])
        rows = [(cell["rows"][label], cell["rows"][base]) for cell in record["cells"]]
        found.append({
            "label": label, "base": base,
            "pearson": [row["pearson"] for row, _ in rows],
            "change": [row["pearson"] - other["pearson"] for row, other in rows],
            "holds": float(np.mean([row["credible"]["0.9"]["plain"] for row, _ in rows])),
            "seconds": float(np.mean([row["seconds"] - other["seconds"] for row, other in rows])),
        })  # fmt: skip
    return found


SHOWN = (
    Column("switch", lambda row: row["label"]),
    Column("rho", lambda row: f"{np.mean(row['pearson']):.3f} ({np.mean(row['change']):+.3f})"),
    Column("worst cell", lambda row: min(row["pearson"]), digits(2)),
    Column("90 % sets hold the truth", lambda row: row["holds"], lambda value: f"{value:.0%}"),
    Column("time", lambda row: row["seconds"], lambda value: f"{value:+.2f} s"),
)


def draw(record: Record) -> Figure:
    """Draw how much each switch changes the correlation, per cell and on average."""
    rows = [row for row in changes(record) if row["label"] != row["base"]]
    figure = page(8, 1.2 + 0.32 * len(rows))
    axes = figure.add_subplot()
    for place, row in enumerate(reversed(rows)):
        mean = float(np.mean(row["change"]))
        axes.barh(place, mean, color=COLORS[2] if mean > 0 else COLORS[4], height=0.6)
        axes.plot(row["change"], [place] * len(row["change"]), "|", color=INK, markersize=7)
    axes.set_yticks(range(len(rows)), [row["label"] for row in reversed(rows)], fontsize=8)
    axes.axvline(0, color=INK, linewidth=0.8)
    axes.set_xlabel("change of the Pearson correlation against what is switched")
    axes.set_title("Single switches: mean (bar) and each cell (stroke)", fontsize=10, color=INK)
    tidy(axes)
    return figure


STUDY = Study(title="What each switch adds and costs", experiment=experiment,
              tables=lambda record: [columns(SHOWN, changes(record))])  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Switches(Command):
    """Every switch of the estimators alone, against path tracing; draws switches.png, too."""

    def study(self) -> Study:
        """Return what is measured."""
        return STUDY

    def asked(self) -> Asked:
        """Return what of it is run: what switches are compared with."""
        return replace(super().asked(), variants=VARIANTS)

    def write(self, study: Study, record: Record) -> None:
        """Draw the changes, too."""
        super().write(study, record)
        save(draw(record), self.output, "switches")


if __name__ == "__main__":
    raise SystemExit(main(Switches))
