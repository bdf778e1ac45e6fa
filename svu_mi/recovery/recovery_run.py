"""Inputs of one recovery: estimate, neighbours, regularisers and settings, made on demand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from math import sqrt
from pathlib import Path
from typing import Any, get_args

from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, OptionError
from svu_mi.geometry.neighbors import Neighbors, neighbors
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import NAMES
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.recovery.checkpoint import Checkpoint
from svu_mi.recovery.initialisation import estimate_for_textures, known_parameters
from svu_mi.recovery.paper_settings import PaperSettings
from svu_mi.recovery.recovery_hash import recovery_digests
from svu_mi.recovery.recovery_options import Method, PathOptions, ShOptions
from svu_mi.recovery.regularizers.global_sharing import GlobalSharing
from svu_mi.recovery.regularizers.total_variation import TotalVariation
from svu_mi.recovery.sh.likelihood import QuadraticPrior
from svu_mi.recovery.svbrdf_textures import Textures, scene_textures, uniform_textures

LossTerm = Callable[[dict[str, Any]], Any]


@dataclass
class RecoveryRun:
    """Inputs of one recovery, each made when it is first needed.

    Attributes:
        method, start, sharing, progress: as for ``recover``.
        options: of the parts of the method, by name (``method_options``).
        observed: the photographs.
        given: the estimate that recovery starts from, or None.
        names: parameters to recover; those that the estimate knows leave the list.
        estimate_used: whether ``estimate`` was used.
        surface_neighbors: of the texels, None until ``around`` is used.
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
    _variations: dict[tuple[str, float], LossTerm] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.capture, self.texels = self.observed.capture, self.observed.texels
        if not self.observed.visibility.scale > 0:
            raise CaptureError(
                f"No texel of '{self.capture.shape.id()}' is seen with any radiance; check poses "
                "(camera space is +X left, +Y up, +Z forward), masks and exposures."
            )
        self.known = {} if self.given is None else known_parameters(self.given)
        self.paper = PaperSettings(self.given, self.known)
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
        settings |= {"parameters": list(self.names), "sharing": self._sharing_record()}
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

    def _sharing_record(self) -> bool | dict[str, Any]:
        """Return how texels share: False, True for a prior in common, or the rule of Eq. 14, 15."""
        if isinstance(self.sharing, GlobalSharing):
            return self.sharing.record()
        used = [one for one in self.options.values() if one.sharing]
        if not self.sharing or not used:
            return False
        if all(one.common_prior for one in used):
            return True
        rule = self.paper.record()
        if any(one.common_prior for one in used):  # one part of sh+path has it so, one so
            rule["prior in common, too"] = True
        return rule

    @property
    def around(self) -> Neighbors:
        """The texels' neighbours on the surface."""
        if self.surface_neighbors is None:
            with self.progress.stage("Finding neighbours"):
                self.surface_neighbors = neighbors(self.texels, self.capture.mesh)
        return self.surface_neighbors

    @cached_property
    def _paper_sharing(self) -> GlobalSharing:
        """The paper's sharing; both parts of a recovery have the same."""
        return self.paper.sharing(self.observed, self.around, self.progress)

    @cached_property
    def estimate(self) -> Estimate:
        """Posterior of every texel; with a prior in common if that is how they share."""
        self.estimate_used = True
        return estimate_for_textures(
            self.given, self.observed, progress=self.progress,
            robust=0 if self.method == "path" else self.options["sh"].robust,
            sharing=self.sharing is True
            and any(one.common_prior and one.sharing > 0 for one in self.options.values()),
        )  # fmt: skip

    @property
    def posterior(self) -> Posterior[CalibratedKernel]:
        """The posterior of ``estimate``, in colour."""
        posterior = self.estimate.posterior
        assert isinstance(posterior.kernel, CalibratedKernel)
        return posterior

    def tv_neighbors(self, options: ShOptions | PathOptions) -> Neighbors:
        """Return the neighbours of total variation."""
        return self.around if options.tv_space == "surface" else neighbors(self.texels)

    def tv_weight(self, options: ShOptions | PathOptions) -> float:
        """Return the weight of total variation: in nats, what edges cost does not depend on the
        resolution, whose steps from texel to texel are the smaller, the more there are."""
        in_nats = isinstance(options, ShOptions) and options.loss == "statistics"
        return options.tv * (sqrt(self.texels.count) if in_nats else 1.0)

    def total_variation(self, options: ShOptions | PathOptions) -> LossTerm:
        """Return total variation; parts of a recovery with the same settings share one."""
        key = options.tv_space, options.tv_epsilon
        if key not in self._variations:
            around = self.tv_neighbors(options)
            self._variations[key] = per_texture(
                TotalVariation(self.texels, around, epsilon=options.tv_epsilon)
            )
        return self._variations[key]

    def free(self, textures: Textures) -> dict[str, object]:
        """Return the textures to recover, by name."""
        return {name: tensor for name, tensor in textures.items() if name in self.names}

    def sharing_term(self, options: ShOptions | PathOptions) -> LossTerm | None:
        """Return the term that pulls uncertain texels, None without one."""
        if not self.sharing or not options.sharing:
            return None
        if isinstance(self.sharing, GlobalSharing):
            return per_texture(self.sharing)
        if not options.common_prior:
            return per_texture(self._paper_sharing)
        if isinstance(options, ShOptions) and options.loss == "statistics":
            return None  # its posterior has the prior already
        return QuadraticPrior.weighted_by_information(self.posterior, self.texels)

    def default_start(self) -> Textures:
        """Return 0.5, known values, and the scene's own of parameters that are not recovered."""
        middle = uniform_textures(self.texels)
        others = [n for n in NAMES if n not in self.names and n not in self.known]
        own = scene_textures(self.capture, self.texels) if others else middle
        known = {n: uniform_textures(self.texels, v)[n] for n, v in self.known.items()}
        return middle.but(**{n: own[n] for n in others}, **known)


def per_texture(rule: Callable[[Any], Any]) -> LossTerm:
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


def check_choices(
    method: str, sharing: GlobalSharing | bool, parameters: Sequence[str]
) -> tuple[str, ...]:
    """Refuse invalid choices; return the names of parameters in their usual order."""
    if method not in get_args(Method):
        raise OptionError(f"Unknown method {method!r}; use one of {', '.join(get_args(Method))}.")
    if not isinstance(sharing, bool | GlobalSharing):
        raise OptionError(
            f"recover(): sharing must be True, False or a GlobalSharing, got {sharing!r}; weights "
            "are options (sh=, path=)."
        )
    unknown = [name for name in parameters if name not in NAMES]
    if unknown or not parameters:
        raise OptionError(
            f"recover(): parameters must be one or more of {', '.join(NAMES)}, got "
            f"{', '.join(map(str, parameters)) or 'none'}."
        )
    return tuple(name for name in NAMES if name in parameters)
