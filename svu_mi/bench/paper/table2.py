"""Table 2 of the paper: textures from photographs mostly from one side, and their entropy.

24 photographs of 96 x 96 with 32 samples, 20 from one side, 96 x 96 texels, direct light. Rows are
the paper's methods as printed (presets ``paper`` and ``spectrum``) and ours. Columns:

* PSNR of textures over visible texels;
* Pearson's correlation of mean absolute error and entropy of a texel: the paper's textures with the
  paper's entropy (power spectra), ours with ours;
* Fig. 8: mean absolute error of the most and the least certain texels by the paper's entropy, for
  masks of 10 to 90 % of the surface.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.bench.captures import uneven_views
from svu_mi.bench.correlation import pearson
from svu_mi.bench.experiment import CaseSubject, Record
from svu_mi.bench.markdown import Column, digits, table, tabulate
from svu_mi.bench.recovery.methods import OURS, PAPER, PATH_SHARING, RecoveryMethod
from svu_mi.capture.capture import Capture
from svu_mi.geometry.texels import Texels, texels
from svu_mi.pipeline import estimate

FILM, DENSE, FRONT, BACK, TEXELS, SPP = 96, 48, 20, 4, 96, 32
QUICK_FILM, QUICK_TEXELS, QUICK_SPP = 48, 48, 8
PARTS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
ROWS = tuple(row for row in (*PAPER, *OURS) if row is not PATH_SHARING)


@dataclass(frozen=True)
class Table2(CaseSubject):
    """A case whose textures are recovered from photographs mostly from one side."""

    @property
    def name(self) -> str:
        return f"table2/{self.case.name}"

    @property
    def rows(self) -> Sequence[RecoveryMethod]:
        """All recovery methods; for quick sizes, only methods without path tracing."""
        return [row for row in ROWS if not (row.traced and self.bench.quick)]

    def settings(self, row: RecoveryMethod | None) -> Any:
        return str(self.case.scene), self.case.defines, self.bench.quick, row and asdict(row)

    def head(self) -> Record:
        return {"part": "table2", "cell": self.title}

    @cached_property
    def capture(self) -> Capture:
        """Photographs mostly from one side."""
        film, spp = (QUICK_FILM, QUICK_SPP) if self.bench.quick else (FILM, SPP)
        every = self.bench.capture(self.case, "table2", views=DENSE, film=film, spp=spp)
        return uneven_views(every, FRONT, BACK)

    @cached_property
    def layout(self) -> Texels:
        """Texels of the textures."""
        return texels(self.capture.mesh, QUICK_TEXELS if self.bench.quick else TEXELS)

    @cached_property
    def entropy(self) -> dict[str, np.ndarray]:
        """Entropies (T,) by ``paper`` (spectra) and ``ours``; flags of visible texels, ``seen``."""
        ours = estimate(self.capture, self.layout)
        paper = estimate(ours, method="spectrum", preset="paper")
        return {
            "paper": np.array(paper.entropy, np.float64),
            "ours": np.array(ours.entropy, np.float64),
            "seen": np.array(ours.coverage) > 0,
        }

    def measure(self, row: RecoveryMethod) -> Record:
        """Return times and errors of the textures of a method."""
        seen = self.entropy["seen"]
        dr.sync_thread()
        start = time.perf_counter()
        textures = row.recover(self.capture, self.layout).textures
        dr.sync_thread()
        seconds = time.perf_counter() - start
        error, paper = self.truth.error(textures, seen), self.entropy["paper"][seen]
        own = self.entropy["paper" if "(paper)" in row.label else "ours"][seen]
        return {
            "seconds": seconds, "psnr": self.truth.psnr(textures, seen),
            "correlation": pearson(error, own),
            "certain": masked(error, np.argsort(paper, kind="stable")),
            "uncertain": masked(error, np.argsort(-paper, kind="stable")),
        }  # fmt: skip


def masked(error: np.ndarray, order: np.ndarray) -> list[float]:
    """Return mean errors of the first texels in ``order``, for each fraction in ``PARTS``."""
    return [float(error[order[: max(int(part * len(order)), 1)]].mean()) for part in PARTS]


SHOWN = (
    Column("recovery", lambda line: line[0]),
    *(Column(title, lambda line, name=name: _mean(line[1], name), digits(2))  # type: ignore[misc]
      for title, name in (("base colour", "base_color"), ("roughness", "roughness"),
                          ("metallic", "metallic"), ("average", "average"))),
    Column("error with entropy", lambda line: np.mean([x["correlation"] for x in line[1]]),
           digits(2)),
    Column("seconds", lambda line: np.median([x["seconds"] for x in line[1]]), digits(1)),
)  # fmt: skip


def _mean(rows: list[Record], name: str) -> float:
    return float(np.mean([one["psnr"][name] for one in rows]))


def table2_tables(cases: list[Record]) -> list[str]:
    """Return Table 2 and the errors of Fig. 8."""
    lines = [(label, [case["rows"][label] for case in cases]) for label in cases[0]["rows"]]
    errors = [
        [f"{label}, most {kind}",
         *(f"{value:.3f}" for value in np.mean([one[kind] for one in rows], axis=0))]
        for label, rows in lines for kind in ("certain", "uncertain")
    ]  # fmt: skip
    return [
        "## Table 2: textures, photographs mostly from one side",
        f"PSNR (dB), mean over {len(cases)} cases: {', '.join(case['cell'] for case in cases)}.",
        tabulate(SHOWN, lines),
        "Mean absolute error of the most and the least certain texels, by the paper's entropy "
        "(Fig. 8).",
        table(("share of texels", *(f"{part:.0%}" for part in PARTS)), errors),
    ]
