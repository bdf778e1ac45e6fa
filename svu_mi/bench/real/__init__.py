"""``svu bench real``: held-out photographs of a capture, predicted from the others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from svu_mi.bench.experiment import BenchRun, Experiment, Record
from svu_mi.bench.markdown import Bar
from svu_mi.bench.real.predictors import MEANS, POSTERIOR, PREDICTORS, Predictor, Score
from svu_mi.bench.real.real_tables import draw_real, real_tables
from svu_mi.bench.study import Selection, Study
from svu_mi.calibration.exposure import equalized, estimate_gains
from svu_mi.calibration.light.estimate_light import estimate_light
from svu_mi.calibration.light.light_estimate import FoundGains
from svu_mi.calibration.light.light_options import LightOptions
from svu_mi.calibration.light.light_samples import TexelSamples
from svu_mi.calibration.light.resolve_light import with_light
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_key
from svu_mi.capture.loading import load_capture
from svu_mi.capture.scene import to_world
from svu_mi.errors import CaptureError, OptionError
from svu_mi.geometry.texels import Texels, texels
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import Observed, observe
from svu_mi.presets import AngularPreset
from svu_mi.presets import preset as find_preset

RESOLUTION, TEXELS = 128, 6000  # per side; of these, that predictions are made for
QUICK, QUICK_SEARCH = (64, 600), LightOptions(gains=True, texels=300, depths=((64, 4), (256, 2)))
FEWEST = 4  # photographs that remain of a texel whose others are predicted
WELL_SEEN = 10  # photographs of a texel that is asked what it is made of


@dataclass(frozen=True)
class HoldoutCase:
    """A capture without some of its photographs.

    Attributes:
        bench: where and how.
        source: the capture's folder, or its scene.
        every: of the photographs that are used, each so many-th is left out, the first of all.
    """

    bench: BenchRun
    source: Path
    every: int
    rows = PREDICTORS

    @property
    def name(self) -> str:
        """Folder of its records."""
        return self.source.resolve().stem

    @property
    def title(self) -> str:
        """Name in progress bars and tables."""
        return self.name

    def settings(self, row: Predictor | None) -> Any:
        """Return the inputs of a row; a part of its cache key."""
        return self._key, self.every, self._size, row and row.label

    @cached_property
    def _key(self) -> str:
        return capture_key(self.capture)

    @property
    def _size(self) -> tuple[int, int]:
        return QUICK if self.bench.quick else (RESOLUTION, TEXELS)

    @cached_property
    def capture(self) -> Capture:
        """All photographs, under the light they come with, if any."""
        with self.bench.progress.stage("Loading the capture"):
            return load_capture(self.source, light="optional")

    @cached_property
    def layout(self) -> Texels:
        """Texels of its object."""
        return texels(self.capture.mesh, self._size[0])

    @cached_property
    def used(self) -> np.ndarray:
        """(V,) the photographs that are used at all."""
        return np.flatnonzero(self.capture.used)

    @cached_property
    def held(self) -> np.ndarray:
        """(V,) bool, used photographs that are held out."""
        held = np.arange(len(self.used)) % self.every == 0
        if held.all() or (~held).sum() < FEWEST:
            raise OptionError(
                f"Of {len(held)} photographs, --every {self.every} leaves {int((~held).sum())} to "
                f"estimate from; at least {FEWEST} are needed."
            )
        return held

    @cached_property
    def rest(self) -> Capture:
        """The capture without them."""
        used = np.zeros(self.capture.count, bool)
        used[self.used[~self.held]] = True
        return replace(self.capture, used=tuple(used.tolist()))

    @cached_property
    def lit(self) -> tuple[Capture, FoundGains]:
        """The rest without gains, under the capture's light or the estimated one; and gains."""
        options = QUICK_SEARCH if self.bench.quick else LightOptions(gains=True)
        progress = self.bench.progress
        if self.rest.environment is not None:
            gains = estimate_gains(self.rest, self.layout, options, progress)
            return equalized(self.rest, gains), gains
        light = estimate_light(self.rest, self.layout, options, progress)
        assert light.gains is not None
        return with_light(equalized(self.rest, light.gains), light), light.gains

    @cached_property
    def estimate(self) -> Estimate:
        """Estimate from the remaining photographs."""
        return estimate(self.lit[0], self.layout, progress=self.bench.progress)

    @property
    def observed(self) -> Observed:
        """Observations of that estimate."""
        assert self.estimate.observed is not None
        return self.estimate.observed

    @cached_property
    def switches(self) -> AngularPreset:
        """Of the estimate."""
        switches = self.estimate.switches
        assert isinstance(switches, AngularPreset)
        return switches

    @cached_property
    def samples(self) -> TexelSamples:
        """Samples of a few texels in all photographs, with their gains."""
        everything = observe(self.capture, self.layout, self.bench.progress)
        return TexelSamples.of(everything, find_preset("default", method="angular"), self._size[1])

    @cached_property
    def texels(self) -> np.ndarray:
        """(n,) int64, numbers of these texels."""
        return self.samples.surface.index.numpy().astype(np.int64)

    @cached_property
    def kept(self) -> np.ndarray:
        """(S,) bool, the samples of photographs that were estimated from, and fit."""
        fits = ~self.held
        fits[np.flatnonzero(fits)[self.lit[1].odd]] = False
        return fits[self.samples.view]

    @cached_property
    def enough(self) -> np.ndarray:
        """(n,) bool, texels with at least ``FEWEST`` remaining photographs."""
        rest = np.bincount(self.samples.owner[self.kept], minlength=len(self.texels))
        enough = (rest >= FEWEST) & self.estimate.posterior.observed[self.texels]
        if not enough.any():
            raise CaptureError(
                f"{self.source}: no texel is seen in {FEWEST} of the photographs that remain; "
                "leave fewer out (--every)."
            )
        return enough

    def eye(self, view: int) -> np.ndarray:
        """Return where the camera of a photograph that is used stands."""
        return np.asarray(to_world(self.capture.sensors[self.used[view]])[:3, 3])

    def head(self) -> Record:
        """Estimate; return a summary of the photographs and of the metallic texels."""
        start = perf_counter()
        names = [self.capture.names[view] for view in self.used]
        gains = self.lit[1]
        rest, factor = np.flatnonzero(~self.held), gains.factor[~gains.odd]
        return {
            "cell": self.title, "photographs": len(names), "left_out": int(self.held.sum()),
            "odd": [names[view] for view in rest[gains.odd]],
            "gains": [float(factor.mean(axis=1).min()), float(factor.mean(axis=1).max())],
            "texels": int(self.enough.sum()), "metallic": self._metallic(),
            "seconds": perf_counter() - start,
        }  # fmt: skip

    def _metallic(self) -> Record:
        """Return shares of metallic, open and dielectric texels by their 90 % intervals."""
        seen = np.flatnonzero(np.array(self.estimate.coverage) >= WELL_SEEN)
        ends = self.estimate.posterior.interval("metallic", chosen=seen)
        low, high = (np.array(end, np.float64) for end in ends)
        return {
            "seen": len(seen), "metallic": _part(low >= 0.5), "dielectric": _part(high <= 0.5),
            "open": _part((low < 0.5) & (high > 0.5)), "reaches 1": _part(high > 0.9),
        }  # fmt: skip

    def measure(self, row: Predictor) -> Record:
        """Predict the held-out photographs."""
        start, predict, samples = perf_counter(), row.of(self), self.samples
        score = Score.start(len(self.texels))
        with self.bench.progress.stage(row.label, int(self.held.sum())) as stage:
            for done, view in enumerate(np.flatnonzero(self.held), 1):
                mine = np.flatnonzero((samples.view == view) & self.enough[samples.owner])
                own = samples.owner[mine]
                if len(mine):
                    shown = predict(int(view)).subset(own)
                    score.add(own, samples.radiance[mine], samples.cosine[mine], shown)
                stage.update(done, int(self.held.sum()))
        scored = {"scored": len(score.shown), "seconds": perf_counter() - start}
        return {**score.record(), **scored}


def _part(chosen: np.ndarray) -> float:
    return float(chosen.mean()) if len(chosen) else 0.0


MARGIN = 0.05  # of R^2 over texel means
HOLDS = (0.80, 0.97)  # part of the 90 % intervals that may hold


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    assert selection.capture is not None
    return Experiment("real", [HoldoutCase(bench, selection.capture, selection.every)], whole=True)


def find_bars(record: Record) -> list[Bar]:
    """Return the bars of predictions."""
    if not record["cells"]:
        return []
    (case,) = record["cells"]
    ours, means = (case["rows"][way.label] for way in (POSTERIOR, MEANS))
    if not ours["holds"]:
        return []
    holds = ours["holds"]["0.9"]
    return [
        Bar("R^2 of held-out photographs, above texel means", ours["r2"] - means["r2"], MARGIN,
            least=True),
        Bar("90 % intervals that contain held-out pixels, at least", holds, HOLDS[0], least=True),
        Bar("90 % intervals that contain held-out pixels, at most", holds, HOLDS[1]),
    ]  # fmt: skip


STUDY = Study(
    title="Photographs that were left out", experiment=_experiment, tables=real_tables,
    bars=find_bars, plots={"real": draw_real}, runs_on="capture",
)  # fmt: skip
