"""Reference posterior p(psi | B, L): path tracing of every psi, without approximations."""

import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
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

LANES = 1 << 20  # (texel, view) pairs per batch, visible or not
Renderer = Callable[[UniformScene, VisiblePairs, tuple[int, int]], Render]  # batch k of n


def reference_posterior(
    source: Capture | Observed | Estimate, texels: Texels | None = None,
    subset: int | np.ndarray = 1000, spp: int = 32, *, grid: PrincipledGrid | None = None,
    sigma: float = 0.08, max_depth: int = 2, method: Method = "linear", seed: int = 0,
    noise: Noise = "relative", errors: Errors = "mean", cache: str | Path | None = None,
    progress: Progress | None = None,
) -> Reference:  # fmt: skip
    """Path trace the posterior of roughness, metallic and a grey base colour (Eq. 1-5).

    The object gets one uniform ``principled`` material psi after the other (specular 0.5). Every
    visible (texel, view) pair is traced as a ray from the camera to the texel. With observed and
    traced radiance b and r (means of the channels), p ~ exp(-energy) and energy(psi) = mean over
    the texel's views of w (b - r(psi))^2 / (2 s^2). Here s is ``sigma`` times the mean observed
    radiance of the capture, and w is 1 or depends on ``noise``. The Monte Carlo variance of r is
    not subtracted: that makes the entropy worse (``squared_errors.py``).

    Args:
        source: Capture (scene, photographs and light; not modified), or an estimate of one, whose
            visibility is reused.
        texels: Texels of ``capture.mesh``; default: the estimate's texels.
        subset: Number of texels to draw from all visible ones (all if fewer), or an array of
            texel indices.
        spp: Paths per psi and pair; even, at least 2.
        grid: Nodes of psi; default 8 x 8 x 8.
        sigma: Standard deviation of the likelihood relative to the mean radiance.
        noise: Noise model. ``relative``: equal for all samples, as in the preset ``fixed``.
            ``heteroscedastic``: grows with the sample's radiance, w = 1 / (1 + (b / mean)^2).
            ``estimated``: the likelihood of the angular preset ``default``, in colour and summed
            over views; ignores ``sigma``.
        errors: Aggregation over views: ``mean``, or ``sum`` as printed in Eq. 3. For ``sum``, use
            a larger ``sigma``, such as 0.4 (preset ``paper``).
        max_depth: Largest number of path edges; 2 is direct light.
        method: ``linear`` renders four psi per roughness and derives the others, which is exact
            for direct light; ``brute`` renders all.
        seed: Seed of the subset and the paths; all psi share their random numbers.
        cache: Folder to read results from and write them to; None disables the cache.
        progress: Receiver of stages and timings.

    Raises:
        OptionError: an option is out of range, or ``subset`` contains an invalid index.
        CaptureError: no texel is visible in any photograph, or all visible texels are black.
        OutputError: the cache cannot be written.

    Example:
        >>> reference = svu.reference_posterior(capture, texels, subset=20, spp=4)
        >>> reference.entropy.shape, reference.method
        ((20,), 'linear')
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
        traced = trace_tables(seen, chosen, options, partial(_renderer, options, stage.update))
    if path is not None:
        cached.store(path, traced)
    return Reference.of(traced, options, cached=False)


def trace_tables(
    observed: Observed, chosen: np.ndarray, options: ReferenceOptions, renderer: Renderer
) -> TracedTables:
    """Trace (n,) ``chosen`` texels in batches of bounded memory."""
    dr.sync_thread()
    start = time.perf_counter()
    target, estimated = UniformScene.of(observed.capture), options.noise == "estimated"
    size = max(LANES // observed.views.number, 1)
    batches = [chosen[first : first + size] for first in range(0, len(chosen), size)]
    tables, weights, brightness, coverage, rays, dropped = [], [], [], [], 0, 0
    for number, batch in enumerate(batches):
        pairs = visible_pairs(observed, to_drjit(mi.UInt32, batch.astype(np.uint32)), target)
        render = renderer(target, pairs, (number, len(batches)))
        mean = TexelMeans(pairs.texel, len(batch))
        weight = _weights(pairs, observed, options.noise)
        weighted = replace(mean, weight=weight)
        if estimated:
            tables.append(render_sums(pairs.radiance, weighted, options.levels, render))
            weights.append(weighted.total(np.ones(pairs.count)))
        else:
            derive = derive_all if options.method == "linear" else render_all
            tables.append(derive(pairs.observed, weighted, options.grid, render))
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
    """Return weights of squared errors, (P,); None if all are 1."""
    if noise == "relative":
        return None
    if noise == "heteroscedastic":
        return noise_weight(pairs.observed, observed.visibility.scale)
    default = AngularPreset()
    return noise_weight(pairs.observed, default.knee * observed.unit, pairs.contrast, default.edges)


def _renderer(
    options: ReferenceOptions, update: Callable[[int, int], None], target: UniformScene,
    pairs: VisiblePairs, batch: tuple[int, int],
) -> Render:  # fmt: skip
    """Return a function that renders a material psi for a batch of (texel, view) pairs."""
    integrator = mi.load_dict({"type": "path", "max_depth": options.max_depth})
    # A seed per batch, shared by all psi.
    number, batches = batch
    seed = int(np.random.default_rng((options.seed, number)).integers(2**63))
    done, total = itertools.count(number * options.renders + 1), batches * options.renders

    def render(psi: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        if not pairs.count:
            return np.zeros((0, 3)), np.zeros((0, 3))
        target.paint(psi)
        halves = trace(target.scene, integrator, pairs.rays, options.spp, seed)
        update(next(done), total)
        return halves

    return render


def _choose_texels(
    wanted: int | np.ndarray, seen: Visibility, capture: Capture, seed: int
) -> np.ndarray:
    """Return (n,) int64 texel indices: ``wanted``, or a sorted random choice of seen texels."""
    visible = np.flatnonzero(seen.coverage.numpy())
    if len(visible) == 0:
        raise CaptureError(
            f"No texel of '{capture.shape.id()}' is visible in any photograph; check the poses "
            "and masks."
        )
    if not seen.scale > 0:
        raise CaptureError(
            f"'{capture.shape.id()}' is black in all photographs, so sigma, relative to the mean "
            "radiance, would be 0; check the photographs."
        )
    if isinstance(wanted, np.ndarray):
        return wanted
    count = min(wanted, len(visible))
    return np.sort(np.random.default_rng(seed).choice(visible, count, replace=False))
