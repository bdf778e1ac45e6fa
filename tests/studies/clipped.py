"""Photographs as cameras store them: 8 bits, and highlights clipped.

    PYTHONPATH=tests python -m studies.clipped [--quick] [--data FOLDER] [--objects A,B,...]

HDR photographs are exposed so that a part of the object's pixels is clipped in some channel, and
stored as 8-bit sRGB. Entropy and textures (posterior means, of 160 x 160 texels and 60 photographs
of 192 x 192) are compared with those of HDR, clipped pixels counting as at least so bright, or left
out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from studies.captures import Photographed, mean
from studies.command import Command, main
from svu_mi.bench.experiment import Bench, Experiment, Part, Record
from svu_mi.bench.study import Asked, Study
from svu_mi.bench.text import Bar, Column, columns, digits
from svu_mi.bench.truth import Truth
from svu_mi.capture import Capture
from svu_mi.capture.clipped import Clipped
from svu_mi.capture.images import SATURATED
from svu_mi.capture.picture import decoded
from svu_mi.capture.rounding import Rounding
from svu_mi.metrics.images import srgb
from svu_mi.metrics.textures import psnr
from svu_mi.observed import Observed
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate

# Correlation of entropy at least, by part clipped.
ENTROPY = {0.0: 0.995, 0.001: 0.995, 0.01: 0.97, 0.03: 0.95, 0.06: 0.88}


FINE = "0 %, 16 bits"  # what is lost where nothing is clipped, but for the steps of 8 bits


def _comparing(part: float, bits: int = 8) -> Any:
    return lambda cell: cell.compared(part, bits)


@dataclass(frozen=True)
class OfEightBits(Photographed):
    """An object whose photographs are clipped."""

    rows = (
        *(Part(f"{100 * part:g} %", _comparing(part)) for part in ENTROPY),
        Part(FINE, _comparing(0.0, 16)),
    )

    @cached_property
    def right(self) -> Record:
        """Of HDR."""
        return self._found(self.capture)

    def compared(self, part: float, bits: int) -> Record:
        """Compare photographs of which a part is clipped with HDR."""
        stored, clipped = in_integers(self.capture, self.observed, part, bits)
        rows = {}
        for name, capture in (("bound", stored), ("left out", replace(stored, clipped=()))):
            found = self._found(capture)
            rows[name] = {
                "entropy": float(np.corrcoef(self.right["entropy"], found["entropy"])[0, 1]),
                "textures": found["textures"], "holds": found["holds"],
            }  # fmt: skip
        return {"clipped": clipped, "hdr": self.right["textures"], **rows}

    def _found(self, capture: Capture) -> Record:
        found, seen = estimate(capture, self.observed.texels), self.observed.coverage > 0
        truth = Truth.of(self.capture, self.observed.texels)
        textures, holds = {}, {}
        for name in NAMES:
            right = truth.values[name][seen].astype(np.float64).reshape(seen.sum(), -1)
            mean, low, high = (
                np.array(values, np.float64).reshape(len(seen), -1)[seen]
                for values in (found.posterior.mean(name), *found.posterior.interval(name))
            )
            textures[name] = float(psnr(mean, right))
            holds[name] = float(((low <= right + 1e-6) & (right <= high + 1e-6)).mean())
        entropy = np.array(found.entropy, np.float64)[seen]
        return {"entropy": entropy, "textures": textures, "holds": holds}


def in_integers(
    capture: Capture, observed: Observed, part: float, bits: int = 8
) -> tuple[Capture, float]:
    """Store photographs as sRGB integers, with one exposure for all.

    Args:
        capture: HDR photographs.
        observed: what they show.
        part: of the pixels that show the object, which is clipped in some channel.
        bits: 8 or 16.

    Returns:
        The capture, and the part that is clipped.
    """
    colors = np.asarray(observed.views.pixels.numpy()).reshape(-1, 3)
    most = colors[observed.views.usable.numpy()].max(axis=1)
    limit, last = float(decoded(np.array(SATURATED[bits], np.float32))), 2**bits - 1
    exposure = limit / max(float(np.quantile(most, 1 - part)), 1e-12)
    if part == 0:
        exposure *= 0.99
    images, clipped = [], []
    for image in capture.images:
        encoded = np.round(last * srgb(np.nan_to_num(image) * exposure)) / last
        found = Clipped.of(encoded > SATURATED[bits], limit / exposure)
        linear = (decoded(encoded.astype(np.float32)) / exposure).astype(np.float32)
        linear[found.flags] = np.nan
        images.append(np.ascontiguousarray(linear))
        clipped.append(found)
    steps = (Rounding.of(bits).divided(exposure),) * len(images)
    stored = replace(capture, images=tuple(images), clipped=tuple(clipped), rounding=steps)
    return stored, float((most * exposure > limit).mean())


def _rows(record: Record, name: str) -> list[Record]:
    return [{"cell": cell["cell"], **cell["rows"][name]}
            for cell in record["cells"] if name in cell["rows"]]  # fmt: skip


def _each(what: str) -> Any:
    return lambda row: " / ".join(
        f"{row[which]['textures'][what]:.1f}" if which != "hdr" else f"{row['hdr'][what]:.1f}"
        for which in ("hdr", "bound", "left out")
    )


def _holds(which: str) -> Any:
    return lambda row: " / ".join(f"{row[which]['holds'][name]:.2f}" for name in NAMES)


SHOWN = (
    Column("cell", lambda row: row["cell"]),
    Column("clipped", lambda row: 100 * row["clipped"], lambda value: f"{value:.1f} %"),
    Column("entropy", lambda row: row["bound"]["entropy"], digits(3)),
    Column("entropy, left out", lambda row: row["left out"]["entropy"], digits(3)),
    *(Column(f"{name} (dB)", _each(name)) for name in NAMES),
    Column("90 % hold: roughness / metallic / colour", _holds("bound")),
)


def tables(record: Record) -> list[str]:
    """Return a table for each part that is clipped: HDR / clipped at least so bright / left out."""
    names = [part.label for part in OfEightBits.rows]
    return [f"**{name}**\n\n{columns(SHOWN, _rows(record, name))}" for name in names]


def bars(record: Record) -> list[Bar]:
    """Return what clipped photographs have to reach."""
    found = []
    for part, least in ENTROPY.items():
        rows = _rows(record, f"{100 * part:g} %")
        entropy = mean(row["bound"]["entropy"] for row in rows)
        what = f"{100 * part:g} % clipped"
        found.append(Bar(f"{what}: correlation of entropy, mean", entropy, least, least=True))
        if part <= 0.03:
            lost = mean(row["hdr"]["roughness"] - row["bound"]["textures"]["roughness"]
                         for row in rows)  # fmt: skip
            found.append(Bar(f"{what}: roughness, dB lost", lost, 1.0))
    entropy = mean(row["bound"]["entropy"] for row in _rows(record, FINE))
    return [*found, Bar(f"{FINE}: correlation of entropy, mean", entropy, ENTROPY[0.0], least=True)]


def experiment(bench: Bench, asked: Asked) -> Experiment:
    """Return what is measured: every cell, clipped more and more."""
    return Experiment("clipped", (OfEightBits(bench, cell) for cell in asked.cells), True)


STUDY = Study(title="Clipped photographs", experiment=experiment, bars=bars, tables=tables)


class ClippedStudy(Command):
    """Entropy and textures of photographs of 8 bits, whose highlights are clipped."""

    def study(self) -> Study:
        """Return what is measured."""
        return STUDY


if __name__ == "__main__":
    raise SystemExit(main(ClippedStudy))
