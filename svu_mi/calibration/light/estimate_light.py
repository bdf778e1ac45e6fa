"""Light estimated from photographs, coarse to fine, jointly with the materials.

For given light the posterior of a texel's parameters is closed-form on our statistics
and radiance is linear in the light for given materials (``light_transport``). They alternate, with
the materials eliminated from the normal equations of the light (``gauss_newton``). Directions that
the photographs do not determine keep their prior (``light_prior``).

The likelihood is annealed, since materials are unknown under the constant light of the start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

import numpy as np

from svu_mi.calibration.exposure import starting_gains, step_gains, without_gains
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
    misfit_of,
)
from svu_mi.calibration.light.light_uncertainty import (
    LightScale,
    remarks_of,
    sample_lights,
    scale_of,
    widening_of,
)
from svu_mi.capture.capture import Capture
from svu_mi.core.progress import Progress
from svu_mi.geometry.texels import Texels
from svu_mi.posterior.estimate import Estimate, observations_of
from svu_mi.posterior.observations import Observed
from svu_mi.presets import AngularPreset
from svu_mi.presets import preset as find_preset

MOVED = 0.8  # misfit of light that moves, relative to one that stands still, if it does
ALBEDO = 0.5  # base colour that the brightness of the first light assumes


def estimate_light(
    source: Capture | Observed | Estimate,
    texels: Texels | None = None,
    options: LightOptions | None = None,
    progress: Progress | None = None,
) -> LightEstimate:
    """Estimate the light that photographs were taken under from the photographs.

    Args:
        source: photographs; the light of the capture, if any, is ignored.
        texels: of the object, a subset of which is used; those of ``source`` by default.
        options: see there.
        progress: displays the progress.

    Raises:
        OptionError: no texels, or others than the source's.
        CaptureError: no texel is seen in enough photographs, or all of them are black.
    """
    options, progress = options or LightOptions(), progress or Progress()
    switches: AngularPreset = find_preset("default", method="angular")
    observed = observations_of(source, texels, progress)
    with progress.stage("Choosing texels"):
        samples = TexelSamples.of(observed, switches, options.texels)
    problems = {}
    for moves in (False, True) if options.moves is None else (options.moves,):
        is_seen = options.background == "distant"
        background = BackgroundPixels.of(observed.capture, moves=moves) if is_seen else None
        problems[moves] = LightProblem(samples, switches, background, moves, options.gains)
    fit, misfit = _estimate(problems, options, progress)
    with progress.stage("Asking what else the light may be"):
        columns = columns_of(fit.transport, np.exp(fit.x), switches)
        if fit.seen:  # background pixels show the level directly
            scale = LightScale(np.zeros(3), BACKGROUND_SD, np.zeros(3), anchored=True)
        else:
            scale = scale_of(fit.transport.samples, columns, switches)
        lights = sample_lights(fit, options.draws, options.seed)
        widening = widening_of(fit.transport, columns, lights.draws, scale, switches)
    return LightEstimate(
        logarithm=fit.x + scale.best, draws=lights.draws + scale.best, cell_sd=lights.cell_sd,
        scale_sd=scale.sd, misfit=misfit, widening=widening,
        moves=fit.transport.moves, texels=samples.texels, remarks=remarks_of(scale, lights.cell_sd),
        gains=fit.gains,
    )  # fmt: skip


def _estimate(
    problems: dict[bool, LightProblem], options: LightOptions, progress: Progress
) -> tuple[LightFit, tuple[float, float]]:
    """Return the light in the world that explains the photographs, and the misfit of both."""
    first, *finer = options.depths
    total = len(problems) * first[1] + sum(rounds for _, rounds in finer)
    with progress.stage("Finding the light", total) as stage:
        done = count(1)

        def report() -> None:
            stage.update(next(done), total)

        coarse = {m: problem.solve((first,), None, report) for m, problem in problems.items()}
        still, moving = (coarse[m].misfit if m in coarse else np.nan for m in (False, True))
        moves = next(iter(problems)) if len(problems) == 1 else moving < MOVED * still
        fit = problems[moves].solve(tuple(finer), coarse[moves], report)
    return fit, (still, moving)


@dataclass(frozen=True)
class LightProblem:
    """Samples and assumptions that light is estimated from.

    Attributes:
        samples: of some texels.
        switches: of the posterior of their parameters.
        looks: background pixels that show the light, if any.
        moves: whether the light turns with the cameras.
        gains: whether photographs have unknown gains.
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
            depths: numbers of cells, and rounds at each.
            start: light of fewer cells to continue from; constant light by default.
            after_round: called after every round.
        """
        fit, heat = start, HEAT if start is None else 1.0
        gains = start.gains if start else starting_gains(self.samples) if self.gains else None
        for number, rounds in depths:
            seen = None if self.looks is None else self.looks.at(number)
            priors = LightPriors(prior_of(number), seen)
            whole = Transport.of(self.samples, number, self.moves)
            # Light of the wrong shape could not be too dim, so its level is free at first.
            leveled = start is not None and seen is None
            if fit is None:  # constant light of the photographs' colour
                mean = self.samples.radiance.mean(axis=0, dtype=np.float64)
                least = 1e-3 * self.samples.unit
                x = np.tile(np.log(np.maximum(mean, least) / ALBEDO), (number, 1))
            else:
                x = refined(fit.x, number)
            for _ in range(rounds):
                fit = self._step(whole, priors, (x, gains, heat), leveled)
                x, gains, heat = fit.x, fit.gains, max(heat * COOLING, 1.0)
                if after_round is not None:
                    after_round()
        assert fit is not None
        return fit

    def _step(
        self, whole: Transport, priors: LightPriors,
        state: tuple[np.ndarray, FoundGains | None, float], leveled: bool,
    ) -> LightFit:  # fmt: skip
        """Take one step of materials, light (N, 3) and gains."""
        x, gains, heat = state
        now, transport = annealed(self.switches, heat), without_gains(whole, gains)
        columns = columns_of(transport, np.exp(x), now)
        step = scale_of(transport.samples, columns, now).best if leveled else np.zeros(3)
        posterior = SampleMoments.of(transport.samples, columns).posterior(now, np.exp(step))
        x = x + step
        tau, logarithm = now.overdispersion, None if gains is None else gains.logarithm
        system = normal_equations(transport, np.exp(x), posterior, tau, priors, logarithm)
        change = system.step()
        if gains is not None:
            noise = posterior.kernel.noise if heat == 1 else None
            gains, common = step_gains(gains, self.samples, system, change[len(x) :], noise)
            x = x + common
        x = x + change[: len(x)]
        misfit = misfit_of(posterior, self.samples.unit)
        normalized = without_gains(whole, gains)
        return LightFit(normalized, x, system, misfit, priors.seen is not None, gains)
