"""``svu bench speed``: run times of estimators and kernels, warm and cold."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import Any

import drjit as dr
import numpy as np

from svu_mi.bench.accuracy import reference_of
from svu_mi.bench.captures import even_views
from svu_mi.bench.cases import Case
from svu_mi.bench.compared_estimators import VARIANTS, Variant
from svu_mi.bench.correlation import pearson
from svu_mi.bench.experiment import BenchRun, CaseSubject, Experiment, Measurement, Record
from svu_mi.bench.markdown import Bar
from svu_mi.bench.speed.speed_tables import scaling, speed_tables
from svu_mi.bench.speed.timed_kernels import (
    MIN_TRIANGLES,
    RATIO_BAR,
    fine_capture,
    kernels_of,
    measure_gather,
)
from svu_mi.bench.study import Selection, Study
from svu_mi.bench.timing import WARM_UP, in_new_process, spread, time_once, time_warm
from svu_mi.capture.capture import Capture
from svu_mi.capture.loading import load_capture
from svu_mi.core.memory import Need, Sizes
from svu_mi.core.progress import Progress
from svu_mi.geometry.texels import Texels, texels
from svu_mi.output.maps import write_maps
from svu_mi.pipeline import estimate
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.posterior.observations import observe

DEGREES = (2, 3, 4, 5, 6, 8)
NODES = (4, 6, 8, 12, 16, 24, 32)
MAX_BINS = 5000  # largest number of cells of a grid in the scaling curve
VIEWS = (10, 20, 40, 60)
SAMPLES = (2, 4, 8, 16, 32, 64, 128)
WARM_BAR_S, COLD_BAR_S, MEMORY_BAR = 3.0, 25.0, 1.1  # bars from files to entropy.exr
PLAIN_PSI, LINEAR_PSI = 512, 32  # materials psi of the extrapolated posterior


@dataclass(frozen=True)
class SpeedCase(CaseSubject):
    """Case on which all run times are measured.

    Attributes:
        variants: Timed estimators; scaling curves exist for the presets ``default`` and ``fixed``.
    """

    variants: Sequence[Variant]

    @property
    def rows(self) -> Sequence[Measurement]:
        return PARTS

    def settings(self, row: Measurement | None) -> Any:
        timed = [(v.label, v.method, asdict(v.preset)) for v in self.variants]
        return super().settings(row), timed

    def head(self) -> Record:
        """Return the ``cell`` and its sizes."""
        capture, layout = self.timed
        sizes = self.bench.sizes
        return {
            "cell": self.title, "views": capture.count, "film": sizes.speed_film,
            "texels": layout.count, "resolution": sizes.speed_texels,
        }  # fmt: skip

    @cached_property
    def reference(self) -> Any:
        """Path-traced posterior of some texels, the reference of all agreements."""
        return reference_of(self.bench, self.capture, self.layout)

    @cached_property
    def timed(self) -> tuple[Capture, Texels]:
        """Capture and texels on which run times are measured."""
        return timed_setting(self.bench, self.case)

    def curves(self, curve: Callable[[SpeedCase, Variant], list[Record]]) -> Record:
        """Return the scaling curves of the presets ``default`` and ``fixed``, by label."""
        scaled = [v for v in self.variants if v.label.endswith((" default", " fixed"))]
        return {variant.label: curve(self, variant) for variant in scaled}

    def point(self, value: int, run: Callable[[], Any], reference: Any = None) -> Record:
        """Return a point of a scaling curve: ``value``, ``seconds`` and ``pearson``."""
        reference = reference or self.reference
        # Half the repeats of the table of run times, because there are many points.
        timed = time_warm(run, (self.bench.sizes.repeats + 1) // 2)
        seen = np.array(reference.coverage) > 0
        entropy = np.array(timed.result.entropy)[np.array(reference.subset)[seen]]
        rho = pearson(entropy, np.array(reference.entropy)[seen])
        return {"value": value, "seconds": timed.seconds, "pearson": rho}

    def points(self, values: Sequence[int]) -> Sequence[int]:
        """Return the values of a scaling curve that are measured: every ``stride``-th."""
        return values[:: self.bench.sizes.stride]


def timed_setting(bench: BenchRun, case: Case) -> tuple[Capture, Texels]:
    """Return the capture and the texels on which run times are measured."""
    capture = bench.capture(case, _timed_name(bench), film=bench.sizes.speed_film)
    return capture, texels(capture.mesh, bench.sizes.speed_texels)


def _timed_name(bench: BenchRun) -> str:
    size = bench.sizes.speed_film
    return "capture" if size == bench.sizes.film else f"capture_{size}"


def estimate_once(folder: str, resolution: int, label: str) -> Record:
    """Estimate once, as in the first run of a user (see ``timing.in_new_process``).

    Args:
        folder: Folder of the capture.
        resolution: Texels per side.
        label: Label of the variant.

    Returns:
        ``timings`` by stage in seconds, ``seconds`` in total, number of compiled ``kernels``.
    """
    variant = next(v for v in VARIANTS if v.label == label)
    capture = load_capture(folder)
    timed = time_once(partial(variant.estimate, capture, texels(capture.mesh, resolution)))
    return {"timings": timed.timings, "seconds": timed.seconds, "kernels": timed.compiled}


def time_estimators(timing: SpeedCase) -> Record:
    """Return seconds per stage by label: warm (median), cold (one new process), and in kernels."""
    bench, records = timing.bench, {}
    capture, layout = timing.timed
    folder = bench.folder / "cells" / timing.name / _timed_name(bench)
    for variant in timing.variants:
        with bench.progress.stage(f"Timing {variant.label}, warm"):
            timed = time_warm(partial(variant.estimate, capture, layout), bench.sizes.repeats)
        with bench.progress.stage(f"Timing {variant.label}, cold"):
            cold = in_new_process(
                estimate_once, folder=str(folder), resolution=bench.sizes.speed_texels,
                label=variant.label,
            )  # fmt: skip
        records[variant.label] = {
            "warm": timed.timings, "warm_seconds": timed.seconds, "repeats": timed.runs,
            "cold": cold,
            "kernels": kernels_of(partial(variant.estimate, capture, layout)),
        }  # fmt: skip
    return records


def by_degree(timing: SpeedCase, variant: Variant) -> list[Record]:
    """Return time and agreement by highest SH degree; empty for methods without SH."""
    if variant.method != "spectrum":
        return []
    return [
        timing.point(degree, partial(
            replace(variant, switches={**variant.switches, "degree": degree}).estimate,
            timing.capture, timing.layout))
        for degree in timing.points(DEGREES)
    ]  # fmt: skip


def by_grid(timing: SpeedCase, variant: Variant) -> list[Record]:
    """Return time and agreement by number of nodes per axis of the grid."""
    run = partial(variant.estimate, timing.capture, timing.layout)
    shape: Any = run().posterior.grid
    sizes = [n for n in timing.points(NODES) if n ** len(shape.axes) <= MAX_BINS]
    grids = {n: replace(shape, **dict.fromkeys(shape.axes, n)) for n in sizes}
    return [timing.point(n, partial(run, grid=grid)) for n, grid in grids.items()]


def by_views(timing: SpeedCase, variant: Variant) -> list[Record]:
    """Return time and agreement by number of views; the reference has the same views."""
    whole, rows = timing.capture, []
    for count in sorted({min(count, whole.count) for count in VIEWS}):
        capture = even_views(whole, count)
        reference = reference_of(timing.bench, capture, timing.layout)
        run = partial(variant.estimate, capture, timing.layout)
        rows.append(timing.point(count, run, reference))
    return rows


def by_samples(timing: SpeedCase) -> Record:
    """Return time of the reference by samples per ray, and agreement with the most samples."""
    most = timing.bench.sizes.reference_spp
    counts = [spp for spp in timing.points(SAMPLES) if spp < most] + [most]
    references = list(_references(timing, counts))
    best = np.array(references[-1].entropy)
    return {"reference": [
        {
            "value": spp,
            "seconds": reference.seconds,
            # The largest number agrees with itself; its halves measure its noise.
            "pearson": pearson(reference.entropy, best) if spp < most else None,
        }
        for spp, reference in zip(counts, references, strict=True)
    ]}  # fmt: skip


def _references(timing: SpeedCase, counts: Sequence[int]) -> Iterable[Any]:
    for spp in counts:
        with timing.bench.progress.stage(f"Reference with {spp} samples"):
            yield reference_of(timing.bench, timing.capture, timing.layout, spp=spp)


def brute_force(timing: SpeedCase) -> Record:
    """Extrapolate the time of the path-traced posterior of all texels from a sample.

    seconds = pairs x psi x spp / (rays per second), where a ray is one camera path, pairs are
    visible (texel, view) pairs, and psi is the number of materials: 512 of the grid, or 32,
    which suffice for direct light. The rate is measured on the texels of the reference with all
    samples, 8 materials and compiled kernels; larger batches are not faster.
    """
    capture, layout = timing.timed
    few, spp = PrincipledGrid(2, 2, 2), timing.bench.sizes.reference_spp
    for seed in range(2):  # the first compiles
        sample = reference_of(
            timing.bench, capture, layout, method="brute", spp=spp, grid=few, seed=seed, cache=None
        )
    pairs = int(observe(capture, layout).coverage.sum(dtype=np.int64))
    rate = sample.rays / sample.seconds
    return {
        "sample_rays": sample.rays,
        "sample_seconds": sample.seconds,
        "rays_per_second": rate,
        "pairs": pairs,
        "psi": PLAIN_PSI,
        "spp": spp,
        "seconds": pairs * PLAIN_PSI * spp / rate,
        "linear_seconds": pairs * LINEAR_PSI * spp / rate,
    }


def time_gather(timing: SpeedCase) -> Record:
    """Compare the visibility pass with bare visibility rays, on a fine mesh."""
    sizes, (capture, _) = timing.bench.sizes, timing.timed
    if int(capture.mesh.face_count()) < MIN_TRIANGLES:
        capture = fine_capture(capture.count, sizes.speed_film)
    return measure_gather(capture, sizes.speed_texels, sizes.repeats)


def time_from_files(timing: SpeedCase) -> Record:
    """Time all stages from the files of a capture to entropy.exr.

    Returns:
        By method: ``warm``, with ``stages`` and ``seconds`` as spreads; ``cold``, the result of
        ``run_from_files`` in a new process without compiled kernels, with ``formula_mib``, the
        memory estimate of ``svu entropy``.
    """
    bench, records = timing.bench, {}
    capture, layout = timing.timed
    assert capture.source is not None
    for method, model in (("angular", "default"), ("spectrum", "spectrum")):
        arguments: dict[str, Any] = {"source": str(capture.source), "method": method,
                                 "resolution": bench.sizes.speed_texels}  # fmt: skip
        runs = [run_from_files(**arguments) for _ in range(WARM_UP + bench.sizes.repeats)][WARM_UP:]
        cold = in_new_process(run_from_files, **arguments)
        pixels = sum(image.shape[0] * image.shape[1] for image in capture.images)
        need = Need("entropy", Sizes([(pixels, 1)]), (layout.count, 1), model)
        records[method] = {
            "warm": {
                "stages": {stage: spread([run["stages"][stage] for run in runs])
                           for stage in runs[0]["stages"]},
                "seconds": spread([run["seconds"] for run in runs]),
            },
            "cold": {**cold, "formula_mib": need.bytes / 2**20},
        }  # fmt: skip
    return records


def run_from_files(source: str, resolution: int, method: Any) -> Record:
    """Run all stages once, from the files of a capture to entropy.exr.

    Returns:
        ``stages`` in seconds, ``seconds`` in total, and the number of compiled ``kernels``.
    """
    progress = Progress()
    dr.sync_thread()
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="svu-maps-") as target:
        with progress.stage("Loading photographs"):
            capture = load_capture(source)
        with progress.stage("Laying out texels"):
            layout = texels(capture.mesh, resolution)
        estimated = estimate(capture, layout, method, progress=progress)
        with progress.stage("Writing entropy.exr"):
            write_maps(estimated, target)
        taken = time.perf_counter() - start
    compiled = sum(progress.kernels.values())
    return {"stages": dict(progress.timings), "seconds": taken, "kernels": compiled}


def find_bars(record: Record) -> list[Bar]:
    """Return the bars of run times."""
    bars = []
    for case in record["cells"]:
        bars.append(Bar("rays per second of the visibility pass over bare ray_test",
                        case["rows"]["gather"]["ratio"], RATIO_BAR, least=True))  # fmt: skip
        for method, figures in case["rows"]["whole_way"].items():
            name, cold = f"files to entropy.exr, {method}", figures["cold"]
            memory = (cold["peak_mib"] or 0.0) / cold["formula_mib"]
            bars += [
                Bar(
                    f"{name}: compiled kernels",
                    figures["warm"]["seconds"]["median"],
                    WARM_BAR_S,
                    "s",
                ),
                Bar(f"{name}: new process, no kernels", cold["process_seconds"], COLD_BAR_S, "s"),
                Bar(f"{name}: peak memory over the formula", memory, MEMORY_BAR),
            ]
    return bars


PARTS = (
    Measurement("estimators", time_estimators),
    Measurement("degree", lambda timing: timing.curves(by_degree)),
    Measurement("grid", lambda timing: timing.curves(by_grid)),
    Measurement("views", lambda timing: timing.curves(by_views)),
    Measurement("reference_spp", by_samples),
    Measurement("brute", brute_force),
    Measurement("gather", time_gather),
    Measurement("whole_way", time_from_files),
)


def _experiment(bench: BenchRun, selection: Selection) -> Experiment:
    return Experiment(
        "speed", [SpeedCase(bench, selection.cases[0], selection.variants)], whole=True
    )


STUDY = Study(title="Run times", experiment=_experiment, tables=speed_tables, bars=find_bars,
              plots={"scaling": scaling})  # fmt: skip
