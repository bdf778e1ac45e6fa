"""Reference p(psi | B, L) by path tracing every psi, without the estimators' approximations."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.core.arrays import to_drjit
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError
from svu_mi.evaluation import reference_cache as cached
from svu_mi.evaluation.path_trace import UniformScene, trace
from svu_mi.evaluation.reference import Reference, TracedTables
from svu_mi.evaluation.reference_options import Method, Noise, ReferenceOptions, check_subset
from svu_mi.evaluation.squared_errors import Render, TexelMeans, derive_all, render_all, render_sums
from svu_mi.evaluation.visible_pairs import VisiblePairs, visible_pairs
from svu_mi.geometry.texels import Texels
from svu_mi.geometry.visibility import Visibility
from svu_mi.posterior.estimate import Estimate, capture_and_texels, observations_of
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.posterior.observations import Observed
from svu_mi.presets import AngularPreset, Errors
from svu_mi.statistics.statistics import noise_weight

LANES = 1 << 20  # (texel, view) pairs in memory at a time, visible or not


def reference_posterior(
    source: Capture | Observed | Estimate, texels: Texels | None = None,
    subset: int | np.ndarray = 1000, spp: int = 32, *, grid: PrincipledGrid | None = None,
    sigma: float = 0.08, max_depth: int = 2, method: Method = "linear", seed: int = 0,
    noise: Noise = "relative", errors: Errors = "mean", cache: str | Path | None = None,
    progress: Progress | None = None,
) -> Reference:  # fmt: skip
    """Path trace the posterior of roughness, metallic and a grey base colour (Eq. 1-5).

    The object gets one uniform ``principled`` material psi after the other (specular 0.5), and
    every visible (texel, view) pair is traced as a ray from the camera to the texel. With b and r
    the observed and traced radiance, means of the three channels, p ~ exp(-energy) and
    energy(psi) = mean over the texel's views of w (b - r(psi))^2 / (2 s^2), where s is ``sigma``
    times the mean observed radiance of the whole capture, and w is 1 unless ``noise`` has it fall
    off. The Monte Carlo variance of r stays in the square: what is free of it gives a worse
    entropy (RMSE against 1024 spp at 32 spp: .065 in place of .042).

    Args:
        source: a capture (scene, photographs and light; nothing of it is modified); or an
            estimate of one, which knows the visibility of texels.
        texels: texels of ``capture.mesh``; those of the estimate if there is one.
        subset: that many texels, drawn at random from those that some view sees (all if there
            are fewer), or an array of indices into the T texels.
        spp: paths per psi and pair; even.
        grid: nodes of psi; 8 x 8 x 8 by default.
        sigma: standard deviation of the likelihood, as a part of the mean radiance.
        noise: ``relative``: that, for all samples, as the preset ``fixed`` has it;
            ``heteroscedastic``: it grows with a sample's own radiance b,
            w = 1 / (1 + (b / mean)^2); ``estimated``: the likelihood of the angular preset
            ``default``, of all views and in colour, and ``sigma`` is not used.
        errors: of views: their ``mean``; or their ``sum``, as the paper prints Eq. 3, for which
            ``sigma`` should be larger: .4 is that of the preset ``paper``.
        max_depth: longest path; 2 is direct light.
        method: ``linear`` renders 4 psi per roughness and derives the others, exactly, for
            direct light; ``brute`` renders all.
        seed: of the subset and of the paths; all psi share their random numbers.
        cache: folder where results are kept, and looked for.
        progress: shows what is going on and collects timings.

    Raises:
        OptionError: an option is out of range, or ``subset`` names texels that do not exist.
        CaptureError: no texel is seen in any photograph, or all that is seen is black.
        OutputError: the cache cannot be written.
    """
    grid = grid or PrincipledGrid()
    options = ReferenceOptions(spp, grid, sigma, max_depth, method, seed, noise, errors)
    capture, layout = capture_and_texels(source, texels)
    wanted = check_subset(subset, layout.count)
    progress = progress or Progress()
    path = cached.locate(cache, capture, layout, wanted, options) if cache is not None else None
    if path is not None and (known := cached.load(path, options)) is not None:
        return known
    seen = observations_of(source, texels, progress)
    chosen = _choose_texels(wanted, seen.visibility, capture, seed)
    with progress.stage("Tracing the reference") as stage:
        traced = _trace(seen, chosen, options, stage.update)
    if path is not None:
        cached.store(path, traced)
    return Reference.of(traced, options, cached=False)


def _trace(
    observed: Observed,
    chosen: np.ndarray,
    options: ReferenceOptions,
    update: Callable[[int, int], None],
) -> TracedTables:
    """Work through the texels in batches of bounded memory."""
    dr.sync_thread()
    start = time.perf_counter()
    target, estimated = UniformScene.of(observed.capture), options.noise == "estimated"
    size = max(LANES // observed.views.number, 1)
    batches = [chosen[first : first + size] for first in range(0, len(chosen), size)]
    total, rays, dropped = len(batches) * options.renders, 0, 0
    tables, weights, brightness, coverage = [], [], [], []
    for number, batch in enumerate(batches):
        pairs = visible_pairs(observed, to_drjit(mi.UInt32, batch.astype(np.uint32)), target)
        renderer = _renderer(target, pairs, options, number, lambda done: update(done, total))
        mean = TexelMeans(pairs.texel, len(batch))
        weight = _weights(pairs, observed, options.noise)
        weighted = replace(mean, weight=weight)
        if estimated:
            tables.append(render_sums(pairs.radiance, weighted, options.levels, renderer))
            weights.append(weighted.total(np.ones(pairs.count)))
        else:
            derive = derive_all if options.method == "linear" else render_all
            tables.append(derive(pairs.observed, weighted, options.grid, renderer))
        brightness.append(mean.mean(pairs.observed))
        coverage.append(mean.pairs)
        rays += pairs.count * options.renders * options.spp
        dropped += pairs.dropped
    table, scale = np.concatenate(tables, axis=-1 if estimated else 1), observed.visibility.scale
    dr.sync_thread()
    return TracedTables(
        subset=chosen, tables=table if estimated else table / (2 * (options.sigma * scale) ** 2),
        weight=np.concatenate(weights) if estimated else None,
        coverage=np.concatenate(coverage), brightness=np.concatenate(brightness), scale=scale,
        unit=observed.unit, seconds=time.perf_counter() - start, rays=rays, dropped=dropped,
    )  # fmt: skip


def _weights(pairs: VisiblePairs, observed: Observed, noise: Noise) -> np.ndarray | None:
    """(P,) weights of the squared deviations; None is 1 for all."""
    if noise == "relative":
        return None
    if noise == "heteroscedastic":
        return noise_weight(pairs.observed, observed.visibility.scale)
    default = AngularPreset()
    return noise_weight(pairs.observed, default.knee * observed.unit, pairs.contrast, default.edges)


def _renderer(
    target: UniformScene, pairs: VisiblePairs, options: ReferenceOptions, batch: int,
    update: Callable[[int], None],
) -> Render:  # fmt: skip
    """Return a function that renders a psi for a batch of pairs."""
    integrator = mi.load_dict({"type": "path", "max_depth": options.max_depth})
    # Own random numbers for each batch, the same for all psi.
    seed = int(np.random.default_rng((options.seed, batch)).integers(2**63))
    done = itertools.count(batch * options.renders + 1)

    def render(psi: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        if not pairs.count:
            return np.zeros((0, 3)), np.zeros((0, 3))
        target.paint(psi)
        halves = trace(target.scene, integrator, pairs.rays, options.spp, seed)
        update(next(done))
        return halves

    return render


def _choose_texels(
    wanted: int | np.ndarray, seen: Visibility, capture: Capture, seed: int
) -> np.ndarray:
    """Return (n,) int64 indices; random ones are seen, and sorted, so neighbours stay together."""
    visible = np.flatnonzero(seen.coverage.numpy())
    if len(visible) == 0:
        raise CaptureError(
            f"No texel of '{capture.shape.id()}' is seen in any photograph, so there is nothing "
            "to trace; check the poses and masks."
        )
    if not seen.scale > 0:
        raise CaptureError(
            f"'{capture.shape.id()}' is black in all photographs, so sigma, a fraction of the "
            "mean radiance, would be 0; check the photographs."
        )
    if isinstance(wanted, np.ndarray):
        return wanted
    count = min(wanted, len(visible))
    return np.sort(np.random.default_rng(seed).choice(visible, count, replace=False))
