"""Gains of photographs that nobody wrote down, and photographs that do not fit.

    PYTHONPATH=tests python -m studies.gains [--quick] [--data FOLDER] [--objects A,B,...]

Every photograph is multiplied by a gain of up to 30 % and white balance of up to 15 % of its own;
then three of them are spoilt: four times as bright, blurred, and of another object. Textures are
posterior means, of 160 x 160 texels and 60 photographs of 192 x 192.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from studies.captures import Photographed, mean
from studies.command import Command, main
from svu_mi.bench.cells import own_cells
from svu_mi.bench.experiment import Bench, Experiment, Part, Record
from svu_mi.bench.study import Asked, Study
from svu_mi.bench.text import Bar, Column, columns, digits
from svu_mi.bench.truth import Truth
from svu_mi.capture import Capture
from svu_mi.illumination.equalize import equalized, estimate_gains
from svu_mi.illumination.estimate import estimate_light
from svu_mi.illumination.found_gains import FoundGains
from svu_mi.illumination.lit import with_light
from svu_mi.illumination.options import LightOptions
from svu_mi.metrics.textures import psnr
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate

EXPOSURE, BALANCE = 0.3, 0.15  # logarithms, at most
SPOILT = (0.12, 0.4, 0.75)  # of all photographs, in their order
BRIGHTER, BLUR = 4.0, 1 / 48  # factor; standard deviation in widths of the film


@dataclass(frozen=True)
class UnknownGains(Photographed):
    """An object whose photographs have gains."""

    rows = (
        Part("given light", lambda self: self.under_given()),
        Part("no light", lambda self: self.under_found()),
        Part("three do not fit", lambda self: self.spoilt()),
    )

    @cached_property
    def true(self) -> np.ndarray:
        """(V, 3) logarithms of gains."""
        rng, views = np.random.default_rng(0), self.capture.count
        exposure = rng.uniform(-EXPOSURE, EXPOSURE, (views, 1))
        return exposure + rng.uniform(-BALANCE, BALANCE, (views, 3))

    @cached_property
    def gained(self) -> Capture:
        """With gains."""
        return _with_images(self.capture, [
            image * factor.astype(np.float32)
            for image, factor in zip(self.capture.images, np.exp(self.true), strict=True)
        ])  # fmt: skip

    def under_given(self) -> Record:
        """Find gains under the light that the capture has."""
        found = estimate_gains(self.gained, self.observed.texels)
        return {
            **self._gains(found),
            "right": self._textures(self.capture),
            "found": self._textures(equalized(self.gained, found)),
            "as it is": self._textures(self.gained),
        }  # fmt: skip

    def under_found(self) -> Record:
        """Find gains and light together; beside light that is found without gains."""
        depths = ((64, 3), (128, 2)) if self.bench.quick else LightOptions.depths
        options = LightOptions(moves=False, depths=depths)
        plain = estimate_light(self.capture, self.observed.texels, options)
        light = estimate_light(self.gained, self.observed.texels, replace(options, gains=True))
        assert light.gains is not None
        return {
            **self._gains(light.gains), "right": self._textures(with_light(self.capture, plain)),
            "found": self._textures(with_light(equalized(self.gained, light.gains), light)),
        }  # fmt: skip

    def spoilt(self) -> Record:
        """Leave photographs out that do not fit; beside gains found without them, and given."""
        images, used = list(self.capture.images), list(self.capture.used)
        object_ = "knot" if self.cell.object != "knot" else "vase"
        other = self.captured(own_cells([object_], ["studio"])[0])
        bad = [int(part * len(images)) for part in SPOILT]
        width = images[0].shape[1]
        images[bad[0]] = BRIGHTER * images[bad[0]]
        images[bad[1]] = gaussian_filter(np.nan_to_num(images[bad[1]]), (BLUR * width,) * 2 + (0,))
        images[bad[2]] = other.images[bad[2]]
        for view in bad:
            used[view] = False
        spoilt = _with_images(self.capture, images)
        found = estimate_gains(spoilt, self.observed.texels)
        honest = replace(self.capture, used=tuple(used))
        return {
            "odd": np.flatnonzero(found.odd).tolist(), "spoilt": bad,
            "given": self._textures(honest),
            "right": self._textures(
                equalized(honest, estimate_gains(honest, self.observed.texels))
            ),
            "found": self._textures(equalized(spoilt, found)),
            "as it is": self._textures(spoilt),
        }  # fmt: skip

    def _gains(self, found: FoundGains) -> Record:
        off = found.logarithm - self.true
        return {"rms": float((off - off.mean()).std()), "odd": np.flatnonzero(found.odd).tolist()}

    def _textures(self, capture: Capture) -> Record:
        found, seen = estimate(capture, self.observed.texels), self.observed.coverage > 0
        truth, quality = Truth.of(self.capture, self.observed.texels), {}
        for name in NAMES:
            right = truth.values[name][seen].astype(np.float64).reshape(seen.sum(), -1)
            mean = np.array(found.posterior.mean(name), np.float64).reshape(len(seen), -1)[seen]
            if name == "base_color":  # after one factor per channel
                factor = (mean * right).sum(axis=0) / np.maximum((mean * mean).sum(axis=0), 1e-12)
                mean = np.clip(mean * factor, 0, 1)
            quality[name] = float(psnr(mean, right))
        return quality


def _with_images(capture: Capture, images: Iterable[np.ndarray]) -> Capture:
    return replace(
        capture, images=tuple(np.ascontiguousarray(image, np.float32) for image in images)
    )


def _rows(record: Record, name: str) -> list[Record]:
    return [{"cell": cell["cell"], **cell["rows"][name]}
            for cell in record["cells"] if name in cell["rows"]]  # fmt: skip


def _told(name: str) -> Any:
    """Textures of photographs as they should be, as found, and as they are."""
    ways = ("given", "right", "found", "as it is")
    return lambda row: " / ".join(f"{row[way][name]:.1f}" for way in ways if way in row)


def _shown(*others: Column) -> tuple[Column, ...]:
    textures = (Column(f"{name} (dB)", _told(name)) for name in NAMES)
    return (Column("cell", lambda row: row["cell"]), *others, *textures)


GAINS = Column("gains off by (rms)", lambda row: row["rms"], digits(3))
LEFT_OUT = Column("left out", lambda row: ", ".join(map(str, row["odd"])) or "-")
TABLES = {
    "given light": _shown(GAINS, LEFT_OUT), "no light": _shown(GAINS, LEFT_OUT),
    "three do not fit": _shown(
        Column("spoilt", lambda row: ", ".join(map(str, row["spoilt"]))), LEFT_OUT
    ),
}  # fmt: skip
TOLD = {
    "given light": "as it should be / found / as it is", "no light": "as it should be / found",
    "three do not fit": "without them, gains given / found / with them, found / as it is",
}  # fmt: skip


def tables(record: Record) -> list[str]:
    """Return a table for each of the three experiments."""
    return [f"**{name}**: {TOLD[name]}\n\n{columns(shown, _rows(record, name))}"
            for name, shown in TABLES.items()]  # fmt: skip


def bars(record: Record) -> list[Bar]:
    """Return what gains have to reach."""
    found = []
    for name, most, lost in (("given light", 0.03, 0.5), ("no light", 0.05, 1.0)):
        rows = _rows(record, name)
        found.append(Bar(f"{name}: gains off by (rms), mean", mean(r["rms"] for r in rows), most))
        found.append(Bar(f"{name}: honest photographs left out",
                         float(sum(len(r["odd"]) for r in rows)), 0.0))  # fmt: skip
        found += [Bar(f"{name}: {what}, dB lost", mean(_lost(r, what) for r in rows), lost)
                  for what in NAMES]  # fmt: skip
    rows = _rows(record, "three do not fit")
    named = mean(r["odd"] == r["spoilt"] for r in rows)
    found.append(Bar("three do not fit: exactly these left out", named, 1.0, least=True))
    worst = max((_lost(r, what) for r in rows for what in NAMES), default=float("nan"))
    return [*found, Bar("three do not fit: most dB lost", worst, 0.2)]


def _lost(row: Record, name: str) -> float:
    return float(row["right"][name] - row["found"][name])


def experiment(bench: Bench, asked: Asked) -> Experiment:
    """Return what is measured: every cell in three ways."""
    return Experiment("gains", (UnknownGains(bench, cell) for cell in asked.cells), True)


STUDY = Study(title="Gains of photographs", experiment=experiment, bars=bars, tables=tables)


class GainsStudy(Command):
    """Gains of photographs that are found, with and without a light, and photographs that do not
    fit the others."""

    def study(self) -> Study:
        """Return what is measured."""
        return STUDY


if __name__ == "__main__":
    raise SystemExit(main(GainsStudy))
