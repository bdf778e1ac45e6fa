"""Light from the photographs themselves: coarse to fine, materials and light together.

Light and what the object is made of explain photographs together. For given light the posterior
of a texel's parameters is closed-form on our statistics (``materials``); for given materials
radiance is linear in the light (``transport``). So they take turns, but every step of the light
knows how far the materials would follow it: their parameters are eliminated from its normal
equations (``refine``). What no photograph tells stays as the prior of light has it (``prior``).

Samples say little at first, by a factor that falls from round to round: under constant light, where
it begins, nothing is known of any material.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from svu_mi.capture import Capture
from svu_mi.illumination.background import SD as BACKGROUND_SD
from svu_mi.illumination.background import Looks
from svu_mi.illumination.doubt import possible, remarks_of, widening_of
from svu_mi.illumination.found_gains import FoundGains
from svu_mi.illumination.level import Level, level_of
from svu_mi.illumination.materials import Moments, columns_of, misfit_of, tempered
from svu_mi.illumination.options import LightOptions
from svu_mi.illumination.prior import prior_of, refined
from svu_mi.illumination.record import LightEstimate
from svu_mi.illumination.refine import Fit, Known, system_of
from svu_mi.illumination.samples import Samples
from svu_mi.illumination.transport import Columns, Transport
from svu_mi.observed import Observed
from svu_mi.options import AngularPreset
from svu_mi.options import preset as find_preset
from svu_mi.pipeline import Estimate, observed_of
from svu_mi.progress import Progress
from svu_mi.surface import Texels

MOVED = 0.8  # misfit of light that moves, relative to one that stands still, if it does
HEAT, COOLING = 12.0, 0.6  # how much less samples say at first, and from round to round
ALBEDO = 0.5  # base colour that the first light goes by

Told = Callable[[int, int], None]


def estimate_light(
    source: Capture | Observed | Estimate,
    texels: Texels | None = None,
    options: LightOptions | None = None,
    progress: Progress | None = None,
) -> LightEstimate:
    """Find the light that photographs were taken under in the photographs themselves.

    Args:
        source: photographs; whatever light the capture has is not looked at.
        texels: of the object, some of which are looked at; those of the source if it has them.
        options: see there.
        progress: shows what is going on.

    Raises:
        OptionError: no texels, or others than the source's.
        CaptureError: no texel is seen in enough photographs, or all of them are black.
    """
    options, progress = options or LightOptions(), progress or Progress()
    switches: AngularPreset = find_preset("default", method="angular")
    observed = observed_of(source, texels, progress)
    with progress.stage("Choosing texels"):
        samples = Samples.of(observed, switches, options.texels)
    fit, misfit = _found(_Search(observed.capture, samples, switches, options), progress)
    with progress.stage("Asking what else the light may be"):
        columns = columns_of(fit.transport, np.exp(fit.x), switches)
        level = _level(fit, columns, switches)
        found = possible(fit, options.draws, options.seed)
        widening = widening_of(fit.transport, columns, found.draws, level, switches)
    return LightEstimate(
        logarithm=fit.x + level.best, draws=found.draws + level.best, cell_sd=found.cell_sd,
        scale_sd=level.sd, misfit=misfit, widening=widening,
        moves=fit.transport.moves, texels=samples.texels, remarks=remarks_of(level, found),
        gains=fit.gains,
    )  # fmt: skip


def _level(fit: Fit, columns: Columns, switches: AngularPreset) -> Level:
    """Ask for the level of light, if it was not looked at."""
    if fit.seen:
        return Level(np.zeros(3), BACKGROUND_SD, np.zeros(3), anchored=True)
    return level_of(fit.transport.samples, columns, switches)


@dataclass(frozen=True)
class _Search:
    """What light is found from."""

    capture: Capture
    samples: Samples
    switches: AngularPreset
    options: LightOptions

    def world(self, moves: bool) -> World:
        """Return what is looked at where the light stands still, or turns with the cameras."""
        looks = None
        if self.options.background != "none":
            looks = Looks.of(self.capture, moves=moves)
        return World(self.samples, self.switches, looks, moves, self.options.gains)


def _found(search: _Search, progress: Progress) -> tuple[Fit, tuple[float, float]]:
    """Return the light in the world that explains the photographs, and the misfit of both."""
    options, misfit = search.options, [np.nan, np.nan]
    tried = (False, True) if options.moves is None else (options.moves,)
    worlds = {moves: search.world(moves) for moves in tried}
    first, *finer = options.depths
    coarse, steps = {}, len(tried) * first[1] + sum(rounds for _, rounds in finer)
    with progress.stage("Finding the light", steps) as stage:
        for number, moves in enumerate(tried):
            told = partial(_add, stage.update, number * first[1], steps)
            coarse[moves] = worlds[moves].light((first,), told=told)
            misfit[moves] = coarse[moves].misfit
        moves = tried[0] if len(tried) == 1 else misfit[True] < MOVED * misfit[False]
        told = partial(_add, stage.update, len(tried) * first[1], steps)
        fit = worlds[moves].light(tuple(finer), coarse[moves], told)
    return fit, (misfit[False], misfit[True])


def _add(told: Told, before: int, total: int, done: int, _: int) -> None:
    told(before + done, total)


@dataclass(frozen=True)
class World:
    """Samples, and how they came about: what light is found in.

    Attributes:
        samples: of some texels.
        switches: of the posterior of their parameters.
        looks: at the light itself, if there are any.
        moves: whether the light turns with the cameras.
        gains: whether photographs have gains that are not known.
    """

    samples: Samples
    switches: AngularPreset
    looks: Looks | None = None
    moves: bool = False
    gains: bool = False

    def light(
        self, depths: tuple[tuple[int, int], ...], start: Fit | None = None,
        told: Told | None = None,
    ) -> Fit:  # fmt: skip
        """Find the light.

        Args:
            depths: numbers of cells, and rounds at each.
            start: light of fewer cells to go on from; constant light by default.
            told: called with rounds done, of how many.
        """
        fit, heat, done = start, HEAT if start is None else 1.0, 0
        total = sum(rounds for _, rounds in depths)
        gains = start.gains if start else FoundGains.start(self.samples) if self.gains else None
        for number, rounds in depths:
            stage = _Stage.of(self, number, coarse=start is None)
            x = _even(self.samples, number) if fit is None else refined(fit.x, number)
            for _ in range(rounds):
                fit = stage.round(x, gains, heat)
                x, gains, heat, done = fit.x, fit.gains, max(heat * COOLING, 1.0), done + 1
                if told is not None:
                    told(done, total)
        assert fit is not None
        return fit


@dataclass(frozen=True)
class _Stage:
    """Rounds with one number of cells.

    Attributes:
        transport: all samples, with their gains.
        known: what is known of the cells without them.
        leveled: whether the level of light is searched for by itself: light of the wrong shape
            could not be too dim, so not at first; nor where it is seen.
    """

    world: World
    transport: Transport
    known: Known
    leveled: bool

    @staticmethod
    def of(world: World, number: int, *, coarse: bool) -> _Stage:
        seen = None if world.looks is None else world.looks.at(number)
        transport = Transport.of(world.samples, number, world.moves)
        return _Stage(world, transport, Known(prior_of(number), seen),
                      not coarse and seen is None)  # fmt: skip

    def round(self, x: np.ndarray, gains: FoundGains | None, heat: float) -> Fit:
        """Take one step of materials, light (N, 3) and gains."""
        now, transport = tempered(self.world.switches, heat), without_gains(self.transport, gains)
        columns = columns_of(transport, np.exp(x), now)
        step = level_of(transport.samples, columns, now).best if self.leveled else np.zeros(3)
        posterior = Moments.of(transport.samples, columns).posterior(now, np.exp(step))
        x = x + step
        known = self.known if gains is None else replace(self.known, gains=gains.logarithm)
        system = system_of(transport, x, posterior, now.overdispersion, known)
        change = system.step()
        x = x + change[: len(x)]
        if gains is not None:
            left_out = gains.odd
            if heat == 1:
                gains = gains.judged(self.world.samples, system.found, posterior.noise)
            gains, common = gains.stepped(change[len(x) :], left_out)
            x = x + common
        misfit = misfit_of(posterior, self.world.samples.unit)
        left = without_gains(self.transport, gains)
        return Fit(left, x, system, misfit, self.known.seen is not None, gains)


def without_gains(transport: Transport, gains: FoundGains | None) -> Transport:
    """Return samples and cells of photographs without their gains, or of those that fit."""
    if gains is None:
        return transport
    samples = transport.samples.without(gains.odd).divided(gains.factor)
    return replace(transport, samples=samples)


def _even(samples: Samples, number: int) -> np.ndarray:
    """Logarithms of constant light, of the photographs' colour: (number, 3)."""
    mean = samples.radiance.mean(axis=0, dtype=np.float64)
    return np.tile(np.log(np.maximum(mean, 1e-3 * samples.unit) / ALBEDO), (number, 1))
