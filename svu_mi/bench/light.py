"""``svu bench light``: light estimated from photographs, compared with the true light.

Only pixels of the object are used. Textures are posterior means of 160 x 160 texels from 60
photographs of 192 x 192, under the estimated and under the given light.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Measurement, Record
from svu_mi.bench.markdown import Bar, Column, digits, tabulate
from svu_mi.bench.study import Selection, Study
from svu_mi.calibration.light.estimate_light import estimate_light
from svu_mi.calibration.light.light_estimate import LightEstimate
from svu_mi.calibration.light.light_options import LightOptions
from svu_mi.calibration.light.light_summary import blurred, compare_lights
from svu_mi.calibration.light.resolve_light import with_light
from svu_mi.capture.capture import Capture
from svu_mi.core.arrays import fibonacci
from svu_mi.evaluation.psnr import psnr
from svu_mi.geometry.texels import Texels, texels
from svu_mi.light.environment import read_environment
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import Observed, observe

GLOSSY, SOME = 0.4, 0.05  # largest roughness of a glossy texel; share of them in a glossy case
FEW_DIELECTRICS = 0.2  # share of dielectric texels that determines the scale of the light
ALONE, FAR = 0.8, 30.0  # relative brightness and angle (degrees) of competing directions
POINTS = 2048
PHOTOGRAPHS: dict[str, Any] = {"views": 60, "film": 192, "spp": 32}
QUICK: dict[str, Any] = {"views": 16, "film": 64, "spp": 8}
TEXELS, QUICK_TEXELS = 160, 64  # per side


@dataclass(frozen=True)
class EstimatedLightCase(CaseSubject):
    """Object whose textures are estimated under the given and the estimated light."""

    rows = (Measurement("found", lambda self: self.compared()),)

    @cached_property
    def capture(self) -> Capture:
        """Photographs of the case."""
        return self.bench.capture(self.case, **(QUICK if self.bench.quick else PHOTOGRAPHS))

    @cached_property
    def layout(self) -> Texels:
        """Texels of the object."""
        return texels(self.capture.mesh, QUICK_TEXELS if self.bench.quick else TEXELS)

    @cached_property
    def observed(self) -> Observed:
        """Observations of the texels."""
        return observe(self.capture, self.layout)

    def head(self) -> Record:
        return {"cell": self.title, **self._kind()}

    def _kind(self) -> Record:
        seen = self.observed.coverage > 0
        roughness, metallic = (self.truth.values[name][seen] for name in ("roughness", "metallic"))
        world = fibonacci(POINTS)
        grey = blurred(read_environment(self.capture.environment), world).mean(axis=1)
        angle = np.degrees(np.arccos(np.clip(world @ world[grey.argmax()], -1, 1)))
        return {
            "glossy": bool((roughness < GLOSSY).mean() >= SOME),
            "dielectric": bool((metallic < 0.5).mean() >= FEW_DIELECTRICS),
            "has_brightest": bool(grey[angle > FAR].max() < ALONE * grey.max()),
        }

    def compared(self) -> Record:
        """Estimate the light; compare results under the given and the estimated light."""
        options = LightOptions(depths=((64, 3), (128, 2))) if self.bench.quick else LightOptions()
        start = time.perf_counter()
        light = estimate_light(self.observed, options=options)
        took = time.perf_counter() - start
        known = estimate(self.observed)
        unknown = estimate(with_light(self.capture, light), self.observed.texels)
        seen = self.observed.coverage > 0
        first, second = (np.array(one.entropy, np.float64)[seen] for one in (known, unknown))
        return {
            **_light(self.capture, light), "seconds": took,
            "entropy": float(np.corrcoef(first, second)[0, 1]),
            "known": self._textures(known, seen), "unknown": self._textures(unknown, seen),
        }  # fmt: skip

    def _textures(self, estimated: Estimate, seen: np.ndarray) -> Record:
        quality: Record = {}
        for name in NAMES:
            truth = self.truth.values[name][seen].astype(np.float64).reshape(seen.sum(), -1)
            mean, low, high = (
                np.array(values, np.float64).reshape(len(seen), -1)[seen]
                for values in (estimated.posterior.mean(name), *estimated.posterior.interval(name))
            )
            if name == "base_color":  # up to one factor per channel
                factor = (mean * truth).sum(axis=0) / np.maximum((mean * mean).sum(axis=0), 1e-12)
                mean = np.clip(mean * factor, 0, 1)
            quality[name] = {
                "psnr": float(psnr(mean, truth)),
                "holds": float(((low <= truth + 1e-6) & (truth <= high + 1e-6)).mean()),
            }
        return quality


def _light(capture: Capture, light: LightEstimate) -> Record:
    against = compare_lights(light, capture.environment)
    low, high = light.scale_interval
    scale = float(against.scale.mean())
    return {
        "correlation": against.correlation, "angle": against.angle, "scale": scale,
        "inside": bool(low.mean() <= scale <= high.mean()), "wide": float((high / low).mean()),
        "misfit": list(light.misfit), "moves": light.moves, "widening": light.widening,
        "known_part": float(light.known.mean()),
    }  # fmt: skip


def _mean(values: Iterable[float]) -> float:
    """Return the mean; NaN without values, so that bars are missed."""
    numbers = list(values)
    return float(np.mean(numbers)) if numbers else float("nan")


def _lost(name: str) -> Any:
    return lambda case: case["known"][name]["psnr"] - case["unknown"][name]["psnr"]


def _both(name: str) -> Any:
    return lambda row: " -> ".join(f"{row[one][name]['psnr']:.1f}" for one in ("known", "unknown"))


def _holds(case: Record) -> float:
    return float(np.mean([case["unknown"][name]["holds"] for name in NAMES]))


def rows_of(record: Record) -> list[Record]:
    """Return the results of each case."""
    return [{**case, **case["rows"]["found"]} for case in record["cells"]]


SHOWN = (
    Column("case", lambda row: row["cell"]),
    Column("correlation of the light", lambda row: row["correlation"], digits(3)),
    Column("error of the brightest direction",
           lambda row: row["angle"] if row["has_brightest"] else None,
           lambda value: f"{value:.0f} deg"),
    Column("true / estimated scale", lambda row: row["scale"], digits(2)),
    Column("its 90 % interval",
           lambda row: f"x{row['wide']:.2f}" + ("" if row["inside"] else ", outside")),
    *(Column(f"{name}: given -> estimated (dB)", _both(name)) for name in NAMES),
    Column("correlation of the entropy", lambda row: row["entropy"], digits(2)),
    Column("90 % intervals: colour / roughness / metallic", lambda row: " / ".join(
        f"{row['unknown'][name]['holds']:.2f}" for name in NAMES)),
    Column("time", lambda row: row["seconds"], lambda value: f"{value:.0f} s"),
)  # fmt: skip


def bars(record: Record) -> list[Bar]:
    """Return the bars of a record of ``svu bench light``."""
    rows = rows_of(record)
    glossy = [row["correlation"] for row in rows if row["glossy"]]
    angles = [row["angle"] <= 15 for row in rows if row["has_brightest"]]
    scales = [row for row in rows if row["dielectric"]]
    entropies = [row["entropy"] for row in rows]
    holds = _mean(_holds(row) for row in rows)
    at_least = {
        "correlation of the environment map, mean": (
            _mean(row["correlation"] for row in rows),
            0.88,
        ),
        "correlation of the environment map, worst glossy case": (min(glossy, default=1.0), 0.7),
        "brightest direction within 15 degrees, share of cases": (_mean(angles), 0.7),
        "correlation of the entropy, mean": (_mean(entropies), 0.8),
        "correlation of the entropy, worst case": (min(entropies), 0.55),
        "scale inside its 90 % interval, share of cases": (
            _mean(row["inside"] for row in scales),
            0.8,
        ),
        "90 % intervals that contain the truth, at least": (holds, 0.78),
    }
    at_most = {
        **{f"{name}: PSNR lost on average (dB)": (_mean(_lost(name)(row) for row in rows), most)
           for name, most in (("roughness", 1.5), ("metallic", 1.5), ("base_color", 3.0))},
        "90 % interval of the scale, upper over lower end, median":
            (float(np.median([row["wide"] for row in scales])), 2.0),
        "90 % intervals that contain the truth, at most": (holds, 0.95),
    }  # fmt: skip
    return [
        *(Bar(what, value, limit, least=True) for what, (value, limit) in at_least.items()),
        *(Bar(what, value, limit) for what, (value, limit) in at_most.items()),
    ]


def experiment(bench: BenchRun, selection: Selection) -> Experiment:
    """Return the experiment: every case under the given and the estimated light."""
    return Experiment("light", (EstimatedLightCase(bench, case) for case in selection.cases), True)


STUDY = Study(title="Light estimated from the photographs", experiment=experiment, bars=bars,
              own_sizes=True, tables=lambda record: [tabulate(SHOWN, rows_of(record))])  # fmt: skip
