"""One recovery under way: what is prepared, what starts, and what is descended on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from math import sqrt
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, OptionError
from svu_mi.geometry.neighbors import Neighbors, neighbors
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import NAMES
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.recovery.adam import Descent, Objective, descend
from svu_mi.recovery.checkpoint import Checkpoint
from svu_mi.recovery.initialisation import estimate_for_textures, known_parameters, posterior_means
from svu_mi.recovery.paper_settings import PaperSettings
from svu_mi.recovery.path.pixel_loss import path_objective
from svu_mi.recovery.recovery_hash import recovery_digests
from svu_mi.recovery.recovery_options import Method, PathOptions, ShOptions
from svu_mi.recovery.regularizers.global_sharing import GlobalSharing
from svu_mi.recovery.regularizers.total_variation import TotalVariation
from svu_mi.recovery.relighting import path_length
from svu_mi.recovery.sh.angular_l1_loss import angular_objective
from svu_mi.recovery.sh.likelihood import Likelihood, QuadraticPrior, SmoothedStart
from svu_mi.recovery.sh.spectral_loss import spectral_objective
from svu_mi.recovery.svbrdf_textures import Textures, lay_out, scene_textures, uniform_textures

# Chosen on our own scenes:
START_SMOOTHING = (
    0.6  # part of total variation that smooths a start, whose texels must tell materials apart
)
PRIOR_WEIGHT = 0.5  # weight of the pull towards posterior means, which know the prior

Regularization = Callable[[dict[str, Any]], Any]


@dataclass
class RecoveryRun:
    """One recovery: its parts are made when they are first needed.

    Attributes:
        method, start, sharing, progress: as for ``recover``.
        options: of the parts of the method, by name (``method_options``).
        observed: the photographs.
        given: the estimate that it goes on from, if there is one.
        names: parameters to recover; those that the estimate knows leave the list.
        asked: whether ``estimate`` was used.
        found_neighbors: those of the texels on the surface, if ``around`` was used.
    """

    method: Method
    observed: Observed
    given: Estimate | None
    names: tuple[str, ...]
    options: dict[str, Any]
    start: Textures | None
    sharing: GlobalSharing | bool
    progress: Progress
    asked: bool = field(default=False, init=False)
    found_neighbors: Neighbors | None = field(default=None, init=False)
    _variations: dict[tuple[str, float], Regularization] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.capture, self.texels = self.observed.capture, self.observed.texels
        if not self.observed.visibility.scale > 0:
            raise CaptureError(
                f"No texel of '{self.capture.shape.id()}' is seen with any radiance; check poses "
                "(camera space is +X left, +Y up, +Z forward), masks and exposures."
            )
        self.known = {} if self.given is None else known_parameters(self.given)
        self.printed = PaperSettings(self.given, self.known)
        left = tuple(name for name in self.names if name not in self.known)
        if not left:
            raise OptionError(
                "recover(): nothing is left to recover, because the estimate takes "
                f"{', '.join(self.names)} as known; estimate without known=."
            )
        self.names = left

    @cached_property
    def settings(self) -> dict[str, Any]:
        """Everything that the result depends on, besides the capture, as JSON has it."""
        settings: dict[str, Any] = {"method": self.method}
        settings |= {name: asdict(own) for name, own in self.options.items()}
        settings |= {"parameters": list(self.names), "sharing": self._shares()}
        if (given := self.given) is not None:
            settings["estimate"] = {
                "method": given.method, **asdict(given.preset), "known": self.known
            }  # fmt: skip
        return settings

    def checkpoint(self, path: str | Path, resume: bool, seconds: float) -> Checkpoint:
        """Return the checkpoint of this run, with digests of its inputs."""
        posterior = None if self.given is None else self.given.posterior
        content = recovery_digests(self.capture, self.texels, self.start, self.sharing, posterior)
        return Checkpoint(path, self.settings, content=content, resume=resume, every=seconds)

    def _shares(self) -> bool | dict[str, Any]:
        """Return how texels share: not at all, by a prior in common (True), or by which rule."""
        if isinstance(self.sharing, GlobalSharing):
            return self.sharing.record()
        used = [one for one in self.options.values() if one.sharing]
        if not self.sharing or not used:
            return False
        if all(one.common_prior for one in used):
            return True
        rule = self.printed.record()
        if any(one.common_prior for one in used):  # one part of sh+path has it so, one so
            rule["prior in common, too"] = True
        return rule

    @property
    def around(self) -> Neighbors:
        """The texels' neighbours on the surface."""
        if self.found_neighbors is None:
            with self.progress.stage("Finding neighbours"):
                self.found_neighbors = neighbors(self.texels, self.capture.mesh)
        return self.found_neighbors

    @cached_property
    def _printed_sharing(self) -> GlobalSharing:
        """The paper's sharing; both parts of a recovery have the same."""
        return self.printed.sharing(self.observed, self.around, self.progress)

    @cached_property
    def estimate(self) -> Estimate:
        """What is known of every texel; with a prior in common if that is how they share."""
        self.asked = True
        return estimate_for_textures(
            self.given, self.observed, progress=self.progress,
            robust=0 if self.method == "path" else self.options["sh"].robust,
            sharing=self.sharing is True
            and any(one.common_prior and one.sharing > 0 for one in self.options.values()),
        )  # fmt: skip

    @property
    def posterior(self) -> Posterior[CalibratedKernel]:
        """That of ``estimate``, in colour."""
        posterior = self.estimate.posterior
        assert isinstance(posterior.kernel, CalibratedKernel)
        return posterior

    def run(self, checkpoint: Checkpoint | None) -> tuple[Textures, Descent]:
        """Recover; the last descent is the one that is saved."""
        textures = self.start or self._given_or_middle()
        if self.method != "path":
            textures, descent = self._sh(textures, checkpoint if self.method == "sh" else None)
        if self.method != "sh":
            textures, descent = self._path(textures, checkpoint)
        return textures, descent

    def _sh(self, start: Textures, checkpoint: Checkpoint | None) -> tuple[Textures, Descent]:
        options = self.options["sh"]
        data = self._sh_data(options)
        if options.loss == "statistics" and options.closed_form and self.start is None:
            start = self._smoothed(start.but(**self._free(posterior_means(self.estimate))))
        rule = self._sharing(options)
        return self._descend("Descending (SH)", start, data, options, rule, checkpoint)

    def _sh_data(self, options: ShOptions) -> Objective:
        """Return how far textures are from the photographs."""
        if options.loss == "statistics":
            likelihood = Likelihood.of(self.posterior, self.texels)
            pull = QuadraticPrior.of(self.posterior, self.texels)
            if len(self.names) + len(self.known) < len(NAMES):
                return likelihood  # means are those of all colours, say, not of the one that stays
            return lambda textures, step: (
                likelihood(textures, step) + PRIOR_WEIGHT * pull(textures, step)
            )
        with self.progress.stage("Gathering statistics"):
            if options.loss == "angular":
                model = replace(self.printed.switches("angular"), channels="joint")
                return angular_objective(self.observed, model)
            of_spectra = self.printed.switches("spectrum")
            return spectral_objective(self.observed, of_spectra, options.loss)

    def _smoothed(self, start: Textures) -> Textures:
        """Let neighbours decide where a texel alone cannot: photographs only by what they say
        of each, a mean and a variance."""
        options = self.options["sh"]
        if not options.tv:
            return start
        variation = START_SMOOTHING * self._tv(options), options.tv_epsilon
        smoothing = SmoothedStart.of(
            self.posterior, self.texels, self.names, self._neighbors(options), variation
        )
        with self.progress.stage("Smoothing the start", options.smoothing.steps) as stage:
            descent = descend(
                smoothing, smoothing.start(start), smoothing.options(options.smoothing),
                progress=stage,
            )  # fmt: skip
        return smoothing.laid_out(start, descent.values)

    def _neighbors(self, options: ShOptions | PathOptions) -> Neighbors:
        """Return the neighbours that total variation is taken between."""
        return self.around if options.tv_space == "surface" else neighbors(self.texels)

    def _tv(self, options: ShOptions | PathOptions) -> float:
        """Return the weight of total variation: in nats, what edges cost does not depend on the
        resolution, whose steps from texel to texel are the smaller, the more there are."""
        in_nats = isinstance(options, ShOptions) and options.loss == "statistics"
        return options.tv * (sqrt(self.texels.count) if in_nats else 1.0)

    def _variation(self, options: ShOptions | PathOptions) -> Regularization:
        """Return total variation; parts of a recovery with the same settings share one."""
        key = options.tv_space, options.tv_epsilon
        if key not in self._variations:
            around = self._neighbors(options)
            self._variations[key] = per_texture(
                TotalVariation(self.texels, around, epsilon=options.tv_epsilon)
            )
        return self._variations[key]

    def _free(self, textures: Textures) -> dict[str, object]:
        return {name: tensor for name, tensor in textures.items() if name in self.names}

    def _path(self, start: Textures, checkpoint: Checkpoint | None) -> tuple[Textures, Descent]:
        options = self.options["path"]
        if options.max_depth is None:
            options = replace(options, max_depth=path_length(self.capture.scene))
        with self.progress.stage("Preparing rays"):
            data = path_objective(
                self.capture, self.texels, options, fixed=start, views=self.observed.views
            )
        options = replace(options, descent=replace(options.descent, steps=data.steps))
        rule = self._sharing(options)
        return self._descend("Descending (path tracing)", start, data, options, rule, checkpoint)

    def _descend(
        self, title: str, start: Textures, data: Objective, options: ShOptions | PathOptions,
        sharing: Regularization | None, checkpoint: Checkpoint | None,
    ) -> tuple[Textures, Descent]:  # fmt: skip
        fixed = {name: tensor for name, tensor in start.items() if name not in self.names}
        rules = [(options.sharing, sharing)] if sharing else []
        if options.tv:
            rules.insert(0, (self._tv(options), self._variation(options)))
        objective = regularized(data, rules, fixed)
        with self.progress.stage(title, options.descent.steps) as stage:
            descent = descend(
                objective, self._free(start), options.descent,
                checkpoint=checkpoint, progress=stage,
            )  # fmt: skip
        textures = Textures(**(fixed | descent.values))
        # Nothing pulls gutters along where texels alone are compared.
        return lay_out(
            self.texels, {name: textures.at(self.texels, name) for name in NAMES}
        ), descent

    def _sharing(self, options: ShOptions | PathOptions) -> Regularization | None:
        """Return what pulls uncertain texels beside the data, if anything does."""
        if not self.sharing or not options.sharing:
            return None
        if isinstance(self.sharing, GlobalSharing):
            return per_texture(self.sharing)
        if not options.common_prior:
            return per_texture(self._printed_sharing)
        if isinstance(options, ShOptions) and options.loss == "statistics":
            return None  # its posterior has the prior already
        return QuadraticPrior.by_trust(self.posterior, self.texels)

    def _given_or_middle(self) -> Textures:
        """Return textures to start from: 0.5, what is known, and what the scene says of others."""
        middle = uniform_textures(self.texels)
        others = [n for n in NAMES if n not in self.names and n not in self.known]
        own = scene_textures(self.capture, self.texels) if others else middle
        known = {n: uniform_textures(self.texels, v)[n] for n, v in self.known.items()}
        return middle.but(**{n: own[n] for n in others}, **known)


def regularized(
    data: Objective, rules: Sequence[tuple[float, Regularization]], fixed: dict[str, Any]
) -> Objective:
    """Return the objective data + sum of weight * rule(textures); ``fixed`` textures are not
    optimised."""
    weights = [dr.opaque(mi.Float, weight) for weight, _ in rules]

    def objective(textures: dict[str, Any], step: int) -> Any:
        every = fixed | textures
        loss = data(every, step)
        for weight, (_, rule) in zip(weights, rules, strict=True):
            loss += weight * rule(every)
        return loss

    return objective


def per_texture(rule: Callable[[Any], Any]) -> Regularization:
    """Return a regulariser of one texture as one of all: the sum over them."""
    return lambda textures: sum(rule(texture) for texture in textures.values())


def require_resolution(texels: Texels, start: Textures | None) -> None:
    """Refuse texels that make no texture, or none like the one to start from."""
    if min(texels.resolution) < 2:
        width, height = texels.resolution
        raise OptionError(
            f"Textures need at least 2 texels per side, got {width} x {height}; use more."
        )
    if start is not None:
        start.require_resolution(texels)
