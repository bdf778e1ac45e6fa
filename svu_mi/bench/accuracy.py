"""How well every estimator agrees with a path-traced posterior and with the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi import metrics
from svu_mi.bench.captures import capture_of
from svu_mi.bench.cells import Cell
from svu_mi.bench.clock import Timed
from svu_mi.bench.judge import agreement, judge_posterior
from svu_mi.bench.sizes import Sizes
from svu_mi.bench.store import Store, code_and_machine, key_of
from svu_mi.bench.variants import VARIANTS, Variant
from svu_mi.capture import Capture, load_capture
from svu_mi.pipeline import estimate
from svu_mi.progress import Progress
from svu_mi.reference import reference_posterior
from svu_mi.surface import Texels, texels

Tracer = Callable[..., Any]
DIGITS = 4  # of the entropies that are kept for scatter plots


@dataclass(frozen=True)
class Bench:
    """Where and how a benchmark runs.

    Attributes:
        folder: of all results.
        sizes: how large everything is.
        progress: shows what is going on.
        trace: gives the reference posterior.
        fresh: compute anew what is finished.
        quick: whether the sizes are small ones, which bars are not meant for.
    """

    folder: Path
    sizes: Sizes
    progress: Progress
    trace: Tracer = reference_posterior
    fresh: bool = False
    quick: bool = False

    @property
    def store(self) -> Store:
        """Finished cells."""
        return Store(self.folder / "cells")

    def key(self, cell: Cell, variants: Sequence[Variant]) -> str:
        """Key of a result that takes all of these variants together."""
        labels = [(v.label, v.method, asdict(v.preset)) for v in variants]
        return key_of(
            str(cell.scene), cell.defines, self.sizes.shared, labels, code_and_machine()
        )

    def capture(self, cell: Cell, sizes: Sizes | None = None, name: str = "") -> Capture:
        """Photographs of a cell, rendered once per sizes."""
        folder = self.folder / "cells" / cell.name / (name or "capture")
        return capture_of(cell, sizes or self.sizes, folder, self.progress)

    def reference(self, capture: Capture, layout: Texels, **changes: Any) -> Any:
        """Path-traced posterior of a few texels, from the cache if it is there."""
        asked: dict[str, Any] = {
            "subset": self.sizes.reference_texels,
            "spp": self.sizes.reference_spp,
            "seed": self.sizes.seed,
            "cache": self.folder / "cache",
            **changes,
        }
        return self.trace(capture, layout, **asked)


def run_once(capture: Capture, layout: Texels, variant: Variant, **options: Any) -> Timed:
    """Estimate; the seconds are the sum of those of all stages."""
    progress = Progress()
    result = estimate(capture, layout, variant.method, variant.preset, progress=progress, **options)
    timings = dict(progress.timings)
    return Timed(result, sum(timings.values()), timings, sum(progress.kernels.values()))


def run_warm(capture: Capture, layout: Texels, variant: Variant, **options: Any) -> Timed:
    """Estimate; again if kernels had to be compiled."""
    timed = run_once(capture, layout, variant, **options)
    return run_once(capture, layout, variant, **options) if timed.compiled else timed


def estimate_once(folder: str, resolution: int, label: str) -> dict[str, Any]:
    """Estimate as a user's first run does, in a new process (see ``fresh.in_new_process``).

    Args:
        folder: of the capture.
        resolution: texels per side.
        label: of the variant.

    Returns:
        ``timings`` by stage in seconds, ``seconds`` their sum, ``kernels`` compiled.
    """
    variant = next(v for v in VARIANTS if v.label == label)
    capture = load_capture(folder)
    timed = run_once(capture, texels(capture.mesh, resolution), variant)
    return {"timings": timed.timings, "seconds": timed.seconds, "kernels": timed.compiled}


def run_cell(bench: Bench, cell: Cell, variants: Sequence[Variant]) -> dict[str, Any]:
    """Return a cell's record; what is finished is taken from disk, variant by variant.

    The record is written after every variant, so an interrupted run loses one at most.

    Args:
        bench: where and how.
        cell: object and light.
        variants: estimators to compare.

    Returns:
        ``object``, ``light``, ``reference`` (its figures), ``sanity`` (agreement of the two
        simple maps) and ``variants``: one record per label.
    """
    key = key_of(str(cell.scene), cell.defines, bench.sizes.shared)
    record = None if bench.fresh else bench.store.load(cell.name, key)
    done = {} if record is None else dict(record["variants"])
    keys = {v.label: key_of(*code_and_machine(), v.method, asdict(v.preset)) for v in variants}
    missing = [v for v in variants if done.get(v.label, {}).get("key") != keys[v.label]]
    if record is None or missing:
        capture = bench.capture(cell)
        grid = texels(capture.mesh, bench.sizes.texels)
        with bench.progress.stage(f"Tracing the reference of {cell.title}"):
            reference = Traced.of(bench.reference(capture, grid), capture, grid)
        record = {**_heading(cell, grid), **reference.figures()}
        for variant in missing:
            with bench.progress.stage(f"{cell.title}: {variant.label}"):
                timed = run_warm(capture, grid, variant)
                done[variant.label] = {"key": keys[variant.label], **reference.judge(timed)}
            record = bench.store.save(cell.name, key, {**record, "variants": done})
    found = record["variants"]
    return {**record, "variants": {v.label: {**found[v.label], "main": v.main} for v in variants}}


def _heading(cell: Cell, grid: Texels) -> dict[str, Any]:
    return {"object": cell.object, "light": cell.light, "texels": grid.count}


@dataclass(frozen=True)
class Traced:
    """The path-traced reference of a cell, and what is needed to compare an estimate with it.

    Attributes:
        reference: as ``reference_posterior`` gives it.
        kept: (n,) indices of the texels that the reference observed.
        entropy: (n,) its entropy there.
        truth: of all T texels.
    """

    reference: Any
    kept: np.ndarray
    entropy: np.ndarray
    truth: metrics.GroundTruth

    @classmethod
    def of(cls, reference: Any, capture: Capture, grid: Texels) -> Traced:
        """Leave out what nobody saw: there, every estimator is trivially right."""
        seen = np.array(reference.coverage) > 0
        return cls(
            reference=reference,
            kept=np.array(reference.subset)[seen],
            entropy=np.array(reference.entropy, np.float64)[seen],
            truth=metrics.ground_truth(capture, grid),
        )

    def figures(self) -> dict[str, Any]:
        """Return what the reference says of itself, and how the two simple maps agree with it."""
        found = self.reference
        seen = np.array(found.coverage) > 0
        maps = {
            "brightness": -np.array(found.brightness, np.float64)[seen],
            "number of views": -np.array(found.coverage, np.float64)[seen],
        }
        posterior = np.array(found.posterior.probabilities)[seen]
        judged = judge_posterior(
            posterior, found.posterior.axes, self.truth, self.entropy, self.kept
        )
        return {
            "reference": {
                "texels": len(self.kept),
                "seconds": found.seconds,
                "rays": found.rays,
                "spp": found.spp,
                "split_half": found.split_half().correlation,
                "half_overlap": _overlap(found.halves, seen),
                "mean_entropy": float(self.entropy.mean()),
                "entropy": self.entropy.round(DIGITS),
                **judged,
            },
            "sanity": {name: agreement(values, self.entropy) for name, values in maps.items()},
        }

    def judge(self, timed: Timed) -> dict[str, Any]:
        """Return the figures of one estimate."""
        result = timed.result
        everywhere = np.array(result.entropy, np.float64)
        entropy = everywhere[self.kept]
        posterior = np.array(result.posterior.probabilities_of(self.kept))
        judged = judge_posterior(posterior, result.posterior.axes, self.truth, entropy, self.kept)
        return {
            **agreement(entropy, self.entropy),
            "mean_entropy": float(everywhere[np.array(result.coverage) > 0].mean()),
            "seconds": timed.seconds,
            "timings": timed.timings,
            "entropy": entropy.round(DIGITS),
            **judged,
        }


def _overlap(halves: Any, seen: np.ndarray) -> float:
    """Return the mass that two posteriors share, mean over texels: 1 if equal, 0 if apart.

    Noise that makes both halves of the reference certain, but of different parameters, shows
    here and not in the correlation of their entropies.
    """
    p, q = (np.array(half.probabilities, np.float64)[seen] for half in halves)
    return float(np.minimum(p, q).reshape(len(p), -1).sum(axis=1).mean())
