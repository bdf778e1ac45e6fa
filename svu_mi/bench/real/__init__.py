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

RESOLUTION, TEXELS = 128, 6000  # texels per side; number of predicted texels
QUICK, QUICK_SEARCH = (64, 600), LightOptions(gains=True, texels=300, depths=((64, 4), (256, 2)))
FEWEST = 4  # least number of remaining photographs of a predicted texel
WELL_SEEN = 10  # least number of photographs of a texel in the summary of metallic


@dataclass(frozen=True)
class HoldoutCase:
    """A capture without some of its photographs.

    Attributes:
        bench: Folder, sizes and options of the run.
        source: Folder or scene of the capture.
        every: Every n-th photograph is held out, starting with the first.
    """

    bench: BenchRun
    source: Path
    every: int
    rows = PREDICTORS

    @property
    def name(self) -> str:
        """Name of the folder of the case's records."""
        return self.source.resolve().stem

    @property
    def title(self) -> str:
        """Name in progress bars and tables."""
        return self.name

    def settings(self, row: Predictor | None) -> Any:
        """Return the inputs of a row, for its cache key."""
        return self._key, self.every, self._size, row and row.label

    @cached_property
    def _key(self) -> str:
        return capture_key(self.capture)

    @property
    def _size(self) -> tuple[int, int]:
        return QUICK if self.bench.quick else (RESOLUTION, TEXELS)

    @cached_property
    def capture(self) -> Capture:
        """All photographs, with the light of the capture, if any."""
        with self.bench.progress.stage("Loading the capture"):
            return load_capture(self.source, light="optional")

    @cached_property
    def layout(self) -> Texels:
        """Texels of the object."""
        return texels(self.capture.mesh, self._size[0])

    @cached_property
    def used(self) -> np.ndarray:
        """Indices of the V used photographs."""
        return np.flatnonzero(self.capture.used)

    @cached_property
    def held(self) -> np.ndarray:
        """Flags (V,) of the held-out photographs among the used ones."""
        held = np.arange(len(self.used)) % self.every == 0
        if held.all() or (~held).sum() < FEWEST:
            raise OptionError(
                f"--every {self.every} keeps {int((~held).sum())} of {len(held)} photographs for "
                f"the estimate, which needs at least {FEWEST}; choose another number."
            )
        return held

    @cached_property
    def rest(self) -> Capture:
        """Capture without the held-out photographs."""
        used = np.zeros(self.capture.count, bool)
        used[self.used[~self.held]] = True
        return replace(self.capture, used=tuple(used.tolist()))

    @cached_property
    def lit(self) -> tuple[Capture, FoundGains]:
        """Remaining photographs divided by gains, under given or estimated light; and gains."""
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
        """Observations of the estimate."""
        assert self.estimate.observed is not None
        return self.estimate.observed

    @cached_property
    def switches(self) -> AngularPreset:
        """Preset of the estimate."""
        switches = self.estimate.switches
        assert isinstance(switches, AngularPreset)
        return switches

    @cached_property
    def samples(self) -> TexelSamples:
        """Samples of the predicted texels in all photographs, not divided by gains."""
        everything = observe(self.capture, self.layout, self.bench.progress)
        return TexelSamples.of(
            everything, find_preset("default", method="angular"), self._size[1], {}
        )

    @cached_property
    def texels(self) -> np.ndarray:
        """Indices of the predicted texels, (n,) int64."""
        return self.samples.surface.index.numpy().astype(np.int64)

    @cached_property
    def kept(self) -> np.ndarray:
        """Flags (S,) of samples from remaining photographs, except outliers."""
        fits = ~self.held
        fits[np.flatnonzero(fits)[self.lit[1].odd]] = False
        return fits[self.samples.view]

    @cached_property
    def enough(self) -> np.ndarray:
        """Flags (n,) of texels that at least ``FEWEST`` remaining photographs show."""
        rest = np.bincount(self.samples.owner[self.kept], minlength=len(self.texels))
        enough = (rest >= FEWEST) & self.estimate.posterior.observed[self.texels]
        if not enough.any():
            raise CaptureError(
                f"{self.source}: no texel is visible in {FEWEST} remaining photographs; increase "
                "--every."
            )
        return enough

    def eye(self, view: int) -> np.ndarray:
        """Return the camera position of a used photograph."""
        return np.asarray(to_world(self.capture.sensors[self.used[view]])[:3, 3])

    def head(self) -> Record:
        """Return a summary of photographs, gains and metallic texels."""
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
        """Return shares of metallic, undecided and dielectric texels by 90 % intervals."""
        seen = np.flatnonzero(np.array(self.estimate.coverage) >= WELL_SEEN)
        ends = self.estimate.posterior.interval("metallic", chosen=seen)
        low, high = (np.array(end, np.float64) for end in ends)
        return {
            "seen": len(seen), "metallic": _part(low >= 0.5), "dielectric": _part(high <= 0.5),
            "open": _part((low < 0.5) & (high > 0.5)), "reaches 1": _part(high > 0.9),
        }  # fmt: skip

    def measure(self, row: Predictor) -> Record:
        """Return the scores of the predicted photographs."""
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


MARGIN = 0.05  # bar of R^2 above texel means
HOLDS = (0.80, 0.97)  # bars of the share of 90 % intervals that contain the value


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
    title="Prediction of held-out photographs", experiment=_experiment, tables=real_tables,
    bars=find_bars, plots={"real": draw_real}, runs_on="capture",
)  # fmt: skip
