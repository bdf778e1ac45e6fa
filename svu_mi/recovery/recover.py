"""Recovery of SVBRDF textures from photographs (Sec. 5.2 to 5.4).

Gradient descent with Adam minimises, over the textures psi,

    L(psi) = L_data(psi) + w_TV TV(psi) + w_S L_S(psi)

sh:       L_data compares photographs with a reflection model; psi starts at the posterior means
path:     L_data compares photographs with renderings by Mitsuba's prb; psi starts at 0.5
sh+path:  sh, then one epoch of path

TV is the total variation between neighbouring texels. L_S is global sharing (Eq. 14, 15): it pulls
uncertain texels towards certain ones with similar posteriors.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.capture.capture import Capture
from svu_mi.capture.surroundings import path_length
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import NAMES
from svu_mi.posterior.estimate import Estimate, capture_and_texels, observations_of
from svu_mi.posterior.observations import Observed
from svu_mi.recovery.adam import Descent, Objective, descend
from svu_mi.recovery.checkpoint import Checkpoint
from svu_mi.recovery.initialisation import posterior_means
from svu_mi.recovery.path.pixel_loss import path_objective
from svu_mi.recovery.recovery_options import Method, PathOptions, ShOptions, method_options
from svu_mi.recovery.recovery_result import Recovery
from svu_mi.recovery.recovery_run import LossTerm, RecoveryRun, ordered, require_resolution
from svu_mi.recovery.regularizers.global_sharing import GlobalSharing
from svu_mi.recovery.sh.angular_l1_loss import angular_objective
from svu_mi.recovery.sh.likelihood import Likelihood, QuadraticPrior
from svu_mi.recovery.sh.spectral_loss import spectral_objective
from svu_mi.recovery.svbrdf_textures import Textures, lay_out

PRIOR_WEIGHT = 0.5  # weight of the quadratic prior around the posterior means (example scenes)
Result = tuple[Textures, Descent]


def recover(
    source: Capture | Observed | Estimate, texels: Texels | None = None, method: Method = "sh",
    preset: str = "default", *, sharing: GlobalSharing | bool = False, tv: float | None = None,
    parameters: Sequence[str] = NAMES, start: Textures | None = None, sh: ShOptions | None = None,
    path: PathOptions | None = None, checkpoint: str | Path | None = None, resume: bool = False,
    checkpoint_seconds: float = 30.0, progress: Progress | None = None,
) -> Recovery:  # fmt: skip
    """Recover the textures of an object from its photographs (Sec. 5.2 to 5.4).

    Args:
        source: Capture, or its estimate. ``sh`` starts at the estimate's posterior means; other
            posteriors than the RGB default are recomputed. Known parameters stay fixed.
        texels: Texels of ``capture.mesh``, one per texture pixel; optional with an estimate.
        method: ``sh`` compares photographs with a reflection model, ``path`` with renderings by
            Mitsuba's ``prb``; ``sh+path`` runs ``sh``, then one epoch of ``path``.
        preset: ``default`` or ``paper``. ``coefficients`` and ``spectrum`` select the paper's
            other losses for ``sh`` and ``sh+path`` (with the paper's epoch of ``path``).
            ``polish`` and ``paper_polish`` run the epoch of ``sh+path`` alone (``path`` only).
        sharing: Regularisation of uncertain texels by similar ones. True learns a common prior;
            with presets of the paper, True applies Eq. 14 and 15 to the posterior of Eq. 11 (from
            ``source`` if that is over (roughness, Ks)). A ``GlobalSharing`` is used as given.
        tv: Weight of total variation; replaces ``tv`` in ``sh`` and ``path``.
        parameters: Textures to recover; the others keep ``start`` or the scene's values.
        start: Initial textures; default: smoothed posterior means (sh) or 0.5 (path).
        sh: Options of ``sh``, instead of the preset's.
        path: Options of ``path``, instead of the preset's.
        checkpoint: File (.npz) to which the state of the last descent is saved.
        resume: True to continue from ``checkpoint`` if the file exists.
        checkpoint_seconds: Seconds between saved states.
        progress: Display of stages; collects timings.

    Raises:
        OptionError: An option is invalid, or the checkpoint belongs to another run.
        ShapeError: The resolution of ``start`` differs from the texels'.
        CaptureError: No texel is seen in any photograph.
        SvuError: The loss or a gradient is NaN or infinite.
        OutputError: The checkpoint cannot be read or written.

    Example:
        >>> textures = svu.recover(estimate, tv=0.3).textures
        >>> textures.base_color.shape, textures.roughness.shape
        ((64, 64, 3), (64, 64, 1))
    """
    if resume and checkpoint is None:
        raise OptionError("recover(): resume=True needs a checkpoint to resume from.")
    names = ordered(parameters)
    options, progress = method_options(method, preset, sh, path, tv), progress or Progress()
    require_resolution(capture_and_texels(source, texels)[1], start)
    observed = observations_of(source, texels, progress)
    with progress.stage("Checking the light"):
        _ = observed.distant_light  # raises an error for a black environment map before any work
    given = source if isinstance(source, Estimate) else None
    run = RecoveryRun(method, observed, given, names, options, start, sharing, progress)
    saved = None if checkpoint is None else run.checkpoint(checkpoint, resume, checkpoint_seconds)
    textures = start or run.default_start()
    if method != "path":
        textures, descent = _recover_by_sh(run, textures, saved if method == "sh" else None)
    if method != "sh":
        textures, descent = _recover_by_path(run, textures, saved)
    return Recovery(
        method=method, texels=run.texels, textures=textures, coverage=observed.coverage,
        losses=descent.losses, stopped=descent.stopped, settings=run.settings,
        timings=progress.timings, estimate=run.estimate if run.estimate_used else None,
        around=run.surface_neighbors,
    )  # fmt: skip


def _recover_by_sh(run: RecoveryRun, start: Textures, checkpoint: Checkpoint | None) -> Result:
    """Fit the reflection model, starting at smoothed posterior means."""
    options = run.options["sh"]
    data = _sh_loss(run, options)
    if options.loss == "statistics" and options.closed_form and run.start is None:
        means = start.but(**run.free(posterior_means(run.estimate)))
        start = run.smoothed(run.estimate, run.names, options, means)
    return _minimise(run, "Descending (SH)", start, data, options, checkpoint)


def _sh_loss(run: RecoveryRun, options: ShOptions) -> Objective:
    """Return the data loss: -log p(B | psi) + quadratic prior, or a loss of the paper."""
    if options.loss == "statistics":
        likelihood = Likelihood.of(run.posterior, run.texels)
        prior = QuadraticPrior.of(run.posterior, run.texels)
        if len(run.names) + len(run.known) < len(NAMES):
            return likelihood  # the means ignore that some parameters are fixed at other values
        return lambda psi, step: likelihood(psi, step) + PRIOR_WEIGHT * prior(psi, step)
    with run.progress.stage("Gathering statistics"):
        if options.loss == "angular":
            model = replace(run.paper.switches("angular"), channels="joint")
            return angular_objective(run.observed, model)
        return spectral_objective(run.observed, run.paper.switches("spectrum"), options.loss)


def _recover_by_path(run: RecoveryRun, start: Textures, checkpoint: Checkpoint | None) -> Result:
    """Fit path-traced renderings to batches of pixels of the photographs."""
    options = run.options["path"]
    if run.capture.flash is not None:
        raise OptionError("recover(): the method path supports no flash; use the method sh.")
    if options.max_depth is None:
        options = replace(options, max_depth=path_length(run.capture.scene))
    views = run.observed.views
    with run.progress.stage("Preparing rays"):
        data = path_objective(run.capture, run.texels, options, fixed=start, views=views)
    options = replace(options, descent=replace(options.descent, steps=data.steps))
    return _minimise(run, "Descending (path tracing)", start, data, options, checkpoint)


def _minimise(
    run: RecoveryRun, title: str, start: Textures, data: Objective,
    options: ShOptions | PathOptions, checkpoint: Checkpoint | None,
) -> Result:  # fmt: skip
    """Minimise L over the parameters to recover; others keep the values of ``start``."""
    sharing = run.sharing_term(options)
    terms = [(options.sharing, sharing)] if sharing else []
    if options.tv:
        terms.insert(0, (run.tv_weight(options), run.total_variation(options)))
    fixed = {name: tensor for name, tensor in start.items() if name not in run.names}
    objective = regularized(data, terms, fixed)
    with run.progress.stage(title, options.descent.steps) as stage:
        descent = descend(
            objective, run.free(start), options.descent, checkpoint=checkpoint, progress=stage
        )
    textures = Textures(**(fixed | descent.values))
    # Losses that compare texels have no gradient in the gutters, so these are filled again.
    return lay_out(run.texels, {name: textures.at(run.texels, name) for name in NAMES}), descent


def regularized(
    data: Objective, terms: Sequence[tuple[float, LossTerm]], fixed: dict[str, Any]
) -> Objective:
    """Return the loss ``data`` + sum of weight * term; terms also read ``fixed``."""
    weights = [dr.opaque(mi.Float, weight) for weight, _ in terms]

    def objective(textures: dict[str, Any], step: int) -> Any:
        every = fixed | textures
        loss = data(every, step)
        for weight, (_, term) in zip(weights, terms, strict=True):
            loss += weight * term(every)
        return loss

    return objective
