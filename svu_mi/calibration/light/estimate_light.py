"""Estimation of light from photographs, coarse to fine, jointly with the materials.

Given the light, the posterior of each texel is closed-form. Given the materials, radiance is linear
in the light (``light_transport``). Both steps alternate; materials are eliminated from the normal
equations of the light (``gauss_newton``). Directions that the photographs do not determine keep
their prior (``light_prior``).

The likelihood is annealed, as materials are unknown under the initial constant light.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from svu_mi.calibration.exposure import starting_gains, step_gains, without_gains
from svu_mi.calibration.light.dim_light import with_level_of_dim_cells
from svu_mi.calibration.light.gauss_newton import LightFit, LightPriors, normal_equations
from svu_mi.calibration.light.light_estimate import FoundGains, LightEstimate
from svu_mi.calibration.light.light_options import LightOptions
from svu_mi.calibration.light.light_prior import BACKGROUND_SD, BackgroundPixels, prior_of, refined
from svu_mi.calibration.light.light_samples import TexelSamples
from svu_mi.calibration.light.light_transport import (
    COOLING,
    HEAT,
    SampleMoments,
    Transport,
    annealed,
    columns_of,
)
from svu_mi.calibration.light.light_uncertainty import (
    LightScale,
    remarks_of,
    sample_lights,
    scale_of,
    widening_of,
)
from svu_mi.capture.capture import Capture
from svu_mi.capture.scene import has_lamps
from svu_mi.core.progress import Progress
from svu_mi.geometry.texels import Texels
from svu_mi.posterior.estimate import Estimate, observations_of
from svu_mi.posterior.observations import Observed
from svu_mi.presets import AngularPreset
from svu_mi.presets import preset as find_preset

REFITS = 2  # iterations without outliers
FEWEST, FEW = 300, 450  # texels of the coarsest cells, and of first iterations with finer ones
WHOLE = 2  # last iterations with finer cells, with all texels
MOVED = 0.8  # moving light is chosen if its misfit relative to fixed light is smaller
ALBEDO = 0.5  # base colour assumed for the initial brightness


def estimate_light(
    source: Capture | Observed | Estimate,
    texels: Texels | None = None,
    options: LightOptions | None = None,
    progress: Progress | None = None,
) -> LightEstimate:
    """Estimate the environment map of a capture from its photographs.

    Args:
        source: Photographs; the light of the capture, if any, is ignored.
        texels: Texels of the object; a subset is used (default: the texels of ``source``).
        options: Options of the estimate.
        progress: Display of the progress.

    Raises:
        OptionError: ``texels`` is missing, or differs from the texels of ``source``.
        CaptureError: No texel is seen in enough photographs, or all photographs are black.

    Example:
        >>> options = svu.LightOptions(texels=100, depths=((64, 2),), moves=False)
        >>> light = svu.estimate_light(capture, texels, options)
        >>> light.cells, light.radiance.shape
        (64, (129, 256, 3))
    """
    options, progress = options or LightOptions(), progress or Progress()
    switches: AngularPreset = find_preset("default", method="angular", bare_metals=0.0)
    observed = observations_of(source, texels, progress)
    if has_lamps(observed.capture):
        _ = observed.lighting  # refuses lamps
    with progress.stage("Choosing texels"):
        samples = TexelSamples.of(observed, switches, options.texels, options.known)
    problems = {}
    for moves in (False, True) if options.moves is None else (options.moves,):
        is_seen = options.background == "distant"
        background = BackgroundPixels.of(observed.capture, moves=moves) if is_seen else None
        problems[moves] = LightProblem(samples, switches, background, moves, options.gains)
    fit, misfit = _estimate(problems, options, progress)
    with progress.stage("Estimating the uncertainty of the light"):
        if not fit.seen:
            half, known = options.texels // 2, options.known
            others = TexelSamples.of(observed, switches, half, known, offset=0)
            unseen = without_gains(Transport.of(others, len(fit.x), fit.transport.moves), fit.gains)
            fit = replace(fit, x=with_level_of_dim_cells(unseen, fit.x, switches))
        columns = columns_of(fit.transport, np.exp(fit.x), switches)
        if fit.seen:  # background pixels determine the level
            scale = LightScale(np.zeros(3), BACKGROUND_SD, np.zeros(3), anchored=True)
        else:
            scale = scale_of(fit.transport.samples, columns, switches)
        lights = sample_lights(fit, options.draws, options.seed)
        widening = widening_of(fit.transport, fit.x, lights.draws, scale, switches)
    return LightEstimate(
        logarithm=fit.x + scale.best, draws=lights.draws + scale.best, cell_sd=lights.cell_sd,
        scale_sd=scale.sd, tint_sd=scale.tint, misfit=misfit, widening=widening,
        moves=fit.transport.moves, texels=samples.texels, remarks=remarks_of(scale, lights.cell_sd),
        gains=fit.gains,
    )  # fmt: skip


def _estimate(
    problems: "dict[bool, LightProblem]", options: LightOptions, progress: Progress
) -> tuple[LightFit, tuple[float, float]]:
    """Return the better of fixed and moving light, and the misfits of both."""
    first, *finer = options.depths
    total = len(problems) * first[1] + sum(rounds for _, rounds in finer)
    with progress.stage("Estimating the light", total) as stage:
        done = count(1)

        def report() -> None:
            stage.update(next(done), total)

        few = FEWEST if finer else options.texels
        coarse = {
            m: replace(problem, samples=problem.samples.thinned(few)).solve((first,), None, report)
            for m, problem in problems.items()
        }
        still, moving = (coarse[m].misfit if m in coarse else np.nan for m in (False, True))
        moves = next(iter(problems)) if len(problems) == 1 else moving < MOVED * still
        fit = problems[moves].solve(tuple(finer), coarse[moves], report)
    return fit, (still, moving)


@dataclass(frozen=True)
class LightProblem:
    """Samples and assumptions of the estimate of the light.

    Attributes:
        samples: Samples of selected texels.
        switches: Preset of the posterior of materials.
        looks: Background pixels that show the light, or None.
        moves: True if the light moves with the cameras.
        gains: True if gains of photographs are unknown.
    """

    samples: TexelSamples
    switches: AngularPreset
    looks: BackgroundPixels | None = None
    moves: bool = False
    gains: bool = False

    def solve(
        self, depths: tuple[tuple[int, int], ...], start: LightFit | None = None,
        after_round: Callable[[], None] | None = None,
    ) -> LightFit:  # fmt: skip
        """Estimate the light.

        Args:
            depths: Pairs (number of cells, number of iterations).
            start: Fit with fewer cells to start from (default: constant light).
            after_round: Callback after each iteration.
        """
        fit, heat = start, HEAT if start is None else 1.0
        gains = start.gains if start else starting_gains(self.samples) if self.gains else None
        for number, rounds in depths:
            seen = None if self.looks is None else self.looks.at(number)
            priors = LightPriors(prior_of(number), seen)
            thinned = self.samples.thinned(FEW)
            whole = Transport.of(self.samples, number, self.moves)
            few = whole if thinned is self.samples else Transport.of(thinned, number, self.moves)
            # The level of initial light, whose shape is wrong, stays unconstrained.
            leveled = start is not None and seen is None
            if fit is None:  # constant light with the mean colour of the photographs
                mean = self.samples.radiance.mean(axis=0, dtype=np.float64)
                least = 1e-3 * self.samples.unit
                x = np.tile(np.log(np.maximum(mean, least) / ALBEDO), (number, 1))
            else:
                x = refined(fit.x, number)
            # A photograph that is excluded cannot show the light that it alone mirrors: outliers
            # are flagged once the cells are fitted to all photographs.
            gains = gains and replace(gains, odd=np.zeros_like(gains.odd))
            for left in reversed(range(rounds)):
                flags = left == 0 and heat == 1
                transport = whole if left < WHOLE else few
                fit = self._step(transport, priors, (x, gains, heat), leveled, flags)
                x, gains, heat = fit.x, fit.gains, max(heat * COOLING, 1.0)
                if after_round is not None:
                    after_round()
            if gains is not None and gains.odd.any():
                for _ in range(REFITS):
                    fit = self._step(whole, priors, (x, gains, heat), leveled, flags=False)
                    x, gains = fit.x, fit.gains
        assert fit is not None
        return fit

    def _step(
        self, given: Transport, priors: LightPriors,
        state: tuple[np.ndarray, FoundGains | None, float], leveled: bool, flags: bool,
    ) -> LightFit:  # fmt: skip
        """Run one iteration on materials, light (N, 3) and gains; ``flags`` updates outliers."""
        x, gains, heat = state
        now, transport = annealed(self.switches, heat), without_gains(given, gains)
        columns = columns_of(transport, np.exp(x), now)
        step = scale_of(transport.samples, columns, now).best if leveled else np.zeros(3)
        posterior = SampleMoments.of(transport.samples, columns).posterior(now, np.exp(step))
        x = x + step
        tau, logarithm = now.overdispersion, None if gains is None else gains.logarithm
        system = normal_equations(transport, np.exp(x), posterior, tau, priors, logarithm)
        change = system.step()
        if gains is not None:
            noise = posterior.kernel.noise if flags else None
            gains, common = step_gains(gains, given.samples, system, change[len(x) :], noise)
            x = x + common
        x = x + change[: len(x)]
        misfit = float(np.median(posterior.kernel.noise)) / self.samples.unit
        normalized = without_gains(given, gains)
        return LightFit(normalized, x, system, misfit, priors.seen is not None, gains)
