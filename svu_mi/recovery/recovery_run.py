"""Inputs of a recovery: estimate, neighbours, regularisers and settings."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import Key, capture_parts
from svu_mi.core.progress import Progress
from svu_mi.core.validation import require_known
from svu_mi.errors import CaptureError, OptionError
from svu_mi.geometry.neighbors import Neighbors, neighbors
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import NAMES
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.empirical_bayes import with_empirical_prior
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.recovery.adam import descend
from svu_mi.recovery.checkpoint import Checkpoint
from svu_mi.recovery.initialisation import estimate_for_textures, known_parameters, posterior_means
from svu_mi.recovery.paper_settings import PaperSettings
from svu_mi.recovery.recovery_options import Method, PathOptions, ShOptions
from svu_mi.recovery.regularizers.global_sharing import GlobalSharing
from svu_mi.recovery.regularizers.total_variation import TotalVariation
from svu_mi.recovery.sh.likelihood import QuadraticPrior, SmoothedStart
from svu_mi.recovery.svbrdf_textures import Textures, scene_textures, uniform_textures

START_SMOOTHING = 0.6  # factor of the TV weight: weaker, to keep material edges (example scenes)
LossTerm = Callable[[dict[str, Any]], Any]


@dataclass
class RecoveryRun:
    """Inputs of a recovery, each computed on first use.

    Attributes:
        method, start, sharing, progress: Arguments of ``recover``.
        options: Options by part of the method (``method_options``).
        observed: Capture with texels, visibility and light.
        given: Estimate passed to ``recover``, or None.
        names: Parameters to recover, except for known parameters of ``given``.
        estimate_used: True once ``estimate`` was computed.
        surface_neighbors: Neighbours of the texels; None until ``around`` is computed.
    """

    method: Method
    observed: Observed
    given: Estimate | None
    names: tuple[str, ...]
    options: dict[str, Any]
    start: Textures | None
    sharing: GlobalSharing | bool
    progress: Progress
    estimate_used: bool = field(default=False, init=False)
    surface_neighbors: Neighbors | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.capture, self.texels = self.observed.capture, self.observed.texels
        if not self.observed.visibility.scale > 0:
            raise CaptureError(
                f"No photograph shows a texel of '{self.capture.shape.id()}' with radiance above "
                "0; check poses (camera space is +X left, +Y up, +Z forward), masks and exposures."
            )
        self.known = {} if self.given is None else known_parameters(self.given)
        self.paper = PaperSettings(self.given, self.known)
        left = tuple(name for name in self.names if name not in self.known)
        if not left:
            raise OptionError(
                f"recover(): the estimate fixes all parameters to recover "
                f"({', '.join(self.names)}); estimate without known=."
            )
        self.names = left

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All settings that affect the result, except for the capture, as JSON values."""
        settings: dict[str, Any] = {"method": self.method}
        settings |= {name: asdict(own) for name, own in self.options.items()}
        settings |= {"parameters": list(self.names), "sharing": self._sharing_record()}
        if (given := self.given) is not None:
            settings["estimate"] = {
                "method": given.method, **asdict(given.preset), "known": self.known
            }  # fmt: skip
        return settings

    def checkpoint(self, path: str | Path, resume: bool, seconds: float) -> Checkpoint:
        """Return a checkpoint with the settings and input digests of this run."""
        posterior = None if self.given is None else self.given.posterior
        content = recovery_digests(self.capture, self.texels, self.start, self.sharing, posterior)
        return Checkpoint(path, self.settings, content=content, resume=resume, every=seconds)

    def _sharing_record(self) -> bool | dict[str, Any]:
        """Return ``sharing`` for the record: False, True (common prior) or its settings."""
        if isinstance(self.sharing, GlobalSharing):
            return self.sharing.record()
        used = [one for one in self.options.values() if one.sharing]
        if not self.sharing or not used:
            return False
        if all(one.common_prior for one in used):
            return True
        rule = self.paper.record()
        if any(one.common_prior for one in used):  # the parts of sh+path differ
            rule["prior in common, too"] = True
        return rule

    @property
    def around(self) -> Neighbors:
        """Neighbours of the texels on the surface."""
        if self.surface_neighbors is None:
            with self.progress.stage("Finding neighbours"):
                self.surface_neighbors = neighbors(self.texels, self.capture.mesh)
        return self.surface_neighbors

    @cached_property
    def _paper_sharing(self) -> GlobalSharing:
        """Global sharing of the paper, common to both parts of a recovery."""
        return self.paper.sharing(self.observed, self.around, self.progress)

    @cached_property
    def estimate(self) -> Estimate:
        """Per-texel posterior, under a common prior if that is the kind of sharing."""
        self.estimate_used = True
        robust = 0 if self.method == "path" else self.options["sh"].robust
        estimated = estimate_for_textures(self.given, self.observed, robust, self.progress)
        shares = self.sharing is True and any(
            one.common_prior and one.sharing > 0 for one in self.options.values()
        )
        given = None if self.given is None else self.given.posterior.kernel
        if not (shares or (isinstance(given, CalibratedKernel) and given.learned)):
            return estimated
        near = self.smoothed(estimated, NAMES, ShOptions(), posterior_means(estimated))
        with self.progress.stage("Learning the common prior"):
            values = {name: near.at(self.texels, name) for name in NAMES}
            learned = with_empirical_prior(estimated.posterior, smoothed=values)
        return replace(estimated, posterior=learned)

    def smoothed(
        self, estimated: Estimate, names: Sequence[str], options: ShOptions, means: Textures
    ) -> Textures:
        """Smooth posterior means by total variation, weighted by their inverse variances."""
        if not options.tv:
            return means
        variation = START_SMOOTHING * self.tv_weight(options), options.tv_epsilon
        around = self.tv_neighbors(options)
        smoothing = SmoothedStart.of(estimated.posterior, self.texels, names, around, variation)
        with self.progress.stage("Smoothing the start", options.smoothing.steps) as stage:
            start, steps = smoothing.start(means), smoothing.options(options.smoothing)
            descent = descend(smoothing, start, steps, progress=stage)
        return smoothing.laid_out(means, descent.values)

    @property
    def posterior(self) -> Posterior[CalibratedKernel]:
        """RGB posterior of ``estimate``."""
        posterior = self.estimate.posterior
        assert isinstance(posterior.kernel, CalibratedKernel)
        return posterior

    def tv_neighbors(self, options: ShOptions | PathOptions) -> Neighbors:
        """Return the neighbours for total variation, on the surface or in the texture."""
        return self.around if options.tv_space == "surface" else neighbors(self.texels)

    def tv_weight(self, options: ShOptions | PathOptions) -> float:
        """Return the weight of total variation.

        In nats it is multiplied by sqrt(T), so that the cost of an edge is independent of T.
        """
        in_nats = isinstance(options, ShOptions) and options.loss == "statistics"
        return options.tv * (sqrt(self.texels.count) if in_nats else 1.0)

    def total_variation(self, options: ShOptions | PathOptions) -> LossTerm:
        """Return the total variation term."""
        around = self.tv_neighbors(options)
        widths = {"epsilon": options.tv_epsilon, "edge": options.tv_edge}
        return per_texture(TotalVariation(self.texels, around, **widths))

    def free(self, textures: Textures) -> dict[str, object]:
        """Return the textures to recover, by name."""
        return {name: tensor for name, tensor in textures.items() if name in self.names}

    def sharing_term(self, options: ShOptions | PathOptions) -> LossTerm | None:
        """Return the loss term of sharing; None if disabled, or part of the data loss."""
        if not self.sharing or not options.sharing:
            return None
        if isinstance(self.sharing, GlobalSharing):
            return per_texture(self.sharing)
        if not options.common_prior:
            return per_texture(self._paper_sharing)
        if isinstance(options, ShOptions) and options.loss == "statistics":
            return None  # the posterior already contains the common prior
        return QuadraticPrior.weighted_by_information(self.posterior, self.texels)

    def default_start(self) -> Textures:
        """Return 0.5 for textures to recover, and known or scene values for others."""
        middle = uniform_textures(self.texels)
        others = [n for n in NAMES if n not in self.names and n not in self.known]
        own = scene_textures(self.capture, self.texels) if others else middle
        known = {n: uniform_textures(self.texels, v)[n] for n, v in self.known.items()}
        return middle.but(**{n: own[n] for n in others}, **known)


def per_texture(rule: Callable[[Any], Any]) -> LossTerm:
    """Return a loss term: the sum of the regulariser ``rule`` over all textures."""
    return lambda textures: sum(rule(texture) for texture in textures.values())


def require_resolution(texels: Texels, start: Textures | None) -> None:
    """Raise an error for less than 2 x 2 texels, or a ``start`` of another resolution."""
    if min(texels.resolution) < 2:
        width, height = texels.resolution
        raise OptionError(
            f"Textures need at least 2 x 2 texels, got {width} x {height}; increase the resolution."
        )
    if start is not None:
        start.require_resolution(texels)


def ordered(parameters: Sequence[str]) -> tuple[str, ...]:
    """Return the names of parameters in canonical order; raise OptionError if unknown."""
    require_known(parameters, NAMES, "parameter")
    if not parameters:
        raise OptionError(f"recover(): name one or more parameters of {', '.join(NAMES)}.")
    return tuple(name for name in NAMES if name in parameters)


def recovery_digests(
    capture: Capture, texels: Texels, start: Textures | None, sharing: GlobalSharing | bool,
    posterior: Posterior | None,
) -> dict[str, str]:  # fmt: skip
    """Return digests of a recovery's inputs by name, which identify the run of a checkpoint."""
    # Normals follow from the shape, whose digest tolerates rounding.
    digests = {"layout of texels": _digest(texels.index, texels.position)}
    if start is not None:
        digests["textures to start from"] = _digest(*(tensor for _, tensor in start.items()))
    if isinstance(sharing, GlobalSharing):
        digests["seeds of sharing"] = _digest(sharing.weights, sharing.seeds, [sharing.anchored])
    if posterior is not None:
        noise = getattr(posterior.kernel, "noise", np.empty(0))
        axes = posterior.axes.values()
        digests["posterior"] = _digest(posterior.prior, *axes, noise, posterior.entropy())
    return capture_parts(capture) | digests


def _digest(*arrays: Any) -> str:
    return Key(*(np.array(array) for array in arrays)).digest()
