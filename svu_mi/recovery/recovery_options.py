"""Options of recovery, and their presets. Each run records its options."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, Literal

from svu_mi.core.validation import require, require_types
from svu_mi.errors import OptionError

ShLoss = Literal["statistics", "angular", "coefficients", "spectrum"]
PathLoss = Literal["l1", "l2", "relative"]
TvSpace = Literal["surface", "texture"]
Method = Literal["sh", "path", "sh+path"]


@dataclass(frozen=True, kw_only=True)
class DescentOptions:
    """Options of gradient descent with Adam.

    Attributes:
        steps: Maximum number of steps, at least 1 (default 200; ``sh`` 100). Raise it if the loss
            still falls at the end. ``path`` ignores it (``PathOptions.epochs``).
        learning_rate: Rate of the first step, > 0, in parameter units (default 0.01; ``sh`` 0.02,
            ``path`` 0.05). Lower it if the loss oscillates.
        final_rate: Ratio of the last rate to the first, in (0, 1] (default 0.1; ``path`` 0.02).
            The rate falls geometrically; 1 keeps it constant.
        tolerance: Relative decrease of the mean loss from one window to the next, in [0, 1), below
            which the descent stops. Default 0: all steps. Set it, e.g. to 1e-3, to save time.
        window: Steps per window of ``tolerance``, at least 1 (default 25). Raise it for noisy
            losses.
        low, high: Bounds of all parameters (default 0 and 1), applied after each step. Tighten
            them to exclude extreme values.
        scales: Factors >= 0 of the rates, by parameter (default 1). 0 keeps a parameter constant.
        beta_1, beta_2: Decay rates of Adam's means of gradients and of their squares, in [0, 1)
            (default 0.9 and 0.999; ``path`` 0.99 for the latter). Raise them for noisy gradients.

    Example:
        >>> svu.DescentOptions(steps=50, scales={"roughness": 0.2}).learning_rate
        0.01
    """

    steps: int = 200
    learning_rate: float = 0.01
    final_rate: float = 0.1
    tolerance: float = 0.0
    window: int = 25
    low: float = 0.0
    high: float = 1.0
    scales: Mapping[str, float] = field(default_factory=dict)
    beta_1: float = 0.9
    beta_2: float = 0.999

    def __post_init__(self) -> None:
        object.__setattr__(self, "scales", dict(self.scales))  # independent of the caller's
        require_types(self)
        for name in ("steps", "window"):
            require(self, getattr(self, name) >= 1, name, "a whole number, at least 1")
        for name in ("tolerance", "beta_1", "beta_2"):
            require(self, 0 <= getattr(self, name) < 1, name, "in [0, 1)")
        require(self, 0 < self.learning_rate < inf, "learning_rate", "positive")
        require(self, 0 < self.final_rate <= 1, "final_rate", "in (0, 1]")
        require(self, -inf < self.low < self.high < inf, "low", "a number below high")
        require(self, all(0 <= scale < inf for scale in self.scales.values()), "scales",
                "finite numbers >= 0, by parameter")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ShOptions:
    """Options of recovery by the reflection model.

    Attributes:
        loss: Data loss. ``statistics`` (default): likelihood of the calibrated posterior, at a cost
            independent of the number of photographs. To reproduce the paper: ``angular`` (mean
            absolute error of radiance), ``coefficients`` or ``spectrum`` (of SH expansions).
        closed_form: True (default) to start at the smoothed posterior means, False for 0.5
            (``statistics`` only). Disable it to test the dependence on the start.
        smoothing: Options of the descent that smooths posterior means (240 steps, rate 0.05); it is
            skipped if ``tv`` is 0.
        robust: Number of re-weighting passes, 0 to 20 (default 0), that bring the squared error
            closer to an absolute error (``statistics`` only). Use 2 or 3 against outliers.
        tv: Weight of total variation, >= 0 (default 0.6). Unit with ``statistics``: nats per texel,
            times the square root of the number of texels. Raise it for noisy textures.
        tv_space: Space of neighbours: ``surface`` (default), across chart seams; or, as in the
            paper, ``texture``: the texels to the right and below.
        tv_epsilon: Difference, >= 0 in parameter units, below which total variation is quadratic
            (default 0.01). 0 for absolute values, as in the paper.
        tv_edge: Difference, >= 0, above which total variation is logarithmic, so that small regions
            keep their contrast (default 0.2; ``path`` 0). 0: linear, as in the paper.
        sharing: Weight of a ``GlobalSharing``, >= 0 (default 160). Raise it to pull uncertain
            texels harder. 0 disables all sharing; a common prior ignores other values.
        common_prior: True (default) to share by a learned prior of all texels
            (``posterior/empirical_bayes.py``). False for Eq. 14 and 15 of the paper, with the
            posterior of Eq. 11.
        descent: Options of the descent (100 steps, rate 0.02).

    Example:
        >>> options = svu.ShOptions(tv=0.3, descent=svu.DescentOptions(steps=20))
        >>> len(svu.recover(estimate, sh=options).losses)
        20
    """

    loss: ShLoss = "statistics"
    closed_form: bool = True
    smoothing: DescentOptions = field(
        default_factory=lambda: DescentOptions(steps=240, learning_rate=0.05)
    )
    robust: int = 0
    tv: float = 0.6
    tv_space: TvSpace = "surface"
    tv_epsilon: float = 1e-2
    tv_edge: float = 0.2
    sharing: float = 160.0
    common_prior: bool = True
    descent: DescentOptions = field(
        default_factory=lambda: DescentOptions(steps=100, learning_rate=0.02)
    )

    def __post_init__(self) -> None:
        require_types(self)
        require(self, 0 <= self.robust <= 20, "robust", "in [0, 20]")
        _require_weights(self)


@dataclass(frozen=True, kw_only=True)
class PathOptions:
    """Options of recovery by differentiable path tracing.

    Attributes:
        epochs: Passes over all usable pixels, > 0 (default 60); determines the number of steps.
            Lower it to save time.
        pixels_per_batch: Pixels per step, from all views, at least 1 (default 65536). None: mean
            number per photograph. Lower it if memory is short.
        spp: Paths per pixel, 1 to 65535 (default 2). Raise it if gradients are noisy.
        max_depth: Maximum path length: 2 for direct light, -1 for any length. Default None: the
            value of the scene's integrator.
        loss: Loss of a pixel: ``l2`` (default); ``l1``, as in the paper; or ``relative`` (l2
            divided by squared radiance). Use ``relative`` for dark textures; noise biases it.
        halves: True (default) to use each half of a pixel's paths for the gradient of the other.
            This saves one of three passes if ``spp`` is even. Disable it for ``l1``.
        tv: Weight of total variation, >= 0 (default 2). Raise it for noisy textures.
        tv_space, tv_epsilon, tv_edge: See ``ShOptions``.
        sharing: Weight of sharing, >= 0 (default 8); 0 disables it.
        common_prior: True (default) to pull texels towards their posterior means under a learned
            prior; for False, see ``ShOptions``.
        seed: Seed of batches and paths, 0 to 2^32 - 1 (default 0). Vary it to measure noise.
        descent: Options of the descent (rates 0.05 to 0.001; roughness and metallic a fifth).

    Example:
        >>> options = svu.PathOptions(epochs=0.5, pixels_per_batch=4096)
        >>> svu.recover(estimate, method="path", path=options).method
        'path'
    """

    epochs: float = 60.0
    pixels_per_batch: int | None = 1 << 16
    spp: int = 2
    max_depth: int | None = None
    loss: PathLoss = "l2"
    halves: bool = True
    tv: float = 2.0
    tv_space: TvSpace = "surface"
    tv_epsilon: float = 1e-2
    tv_edge: float = 0.0
    sharing: float = 8.0
    common_prior: bool = True
    seed: int = 0
    descent: DescentOptions = field(
        default_factory=lambda: DescentOptions(
            learning_rate=0.05, final_rate=0.02, beta_2=0.99,
            # Base colour converges first: overall brightness before the shape of highlights.
            scales={"roughness": 0.2, "metallic": 0.2},
        )
    )  # fmt: skip

    def __post_init__(self) -> None:
        require_types(self)
        require(self, 0 < self.epochs < inf, "epochs", "positive")
        size = self.pixels_per_batch
        require(self, size is None or 1 <= size < 2**32,
                "pixels_per_batch", "at least 1, or None")  # fmt: skip
        require(self, 1 <= self.spp < 2**16, "spp", "in [1, 65535]")
        depth = self.max_depth
        require(self, depth is None or depth >= 2 or depth == -1,
                "max_depth", "at least 2, -1 for paths of any length, or None")  # fmt: skip
        _require_weights(self)
        require(self, 0 <= self.seed < 2**32, "seed", "in [0, 2^32)")


def _require_weights(options: ShOptions | PathOptions) -> None:
    """Raise an error for negative, infinite or NaN weights of regularisers."""
    for name in ("tv", "tv_epsilon", "tv_edge", "sharing"):
        require(options, 0 <= getattr(options, name) < inf, name, "at least 0")


_PAPER = ShOptions(
    loss="angular", closed_form=False, tv=1e-2, tv_space="texture", tv_epsilon=0.0,
    tv_edge=0.0, sharing=1e-2, common_prior=False,
    descent=DescentOptions(steps=200, learning_rate=0.01, final_rate=1.0),
)  # fmt: skip

_PAPER_PATH = PathOptions(
    # Batch size and epochs follow the paper's code; the paper does not give them.
    # No halves: the absolute error is not linear, so two halves of 16 paths differ from 32 paths.
    epochs=10.0, pixels_per_batch=None, spp=32, loss="l1", halves=False,
    tv=1e-2, tv_space="texture", tv_epsilon=0.0, sharing=1e-2, common_prior=False,
    descent=DescentOptions(learning_rate=0.02, final_rate=1.0),
)  # fmt: skip

SH_PRESETS: dict[str, ShOptions] = {
    "default": ShOptions(),
    "paper": _PAPER,
    "coefficients": replace(_PAPER, loss="coefficients"),
    "spectrum": replace(_PAPER, loss="spectrum"),
}

PATH_PRESETS: dict[str, PathOptions] = {
    "default": PathOptions(),
    "paper": _PAPER_PATH,
    "polish": PathOptions(
        epochs=1.0,
        pixels_per_batch=1 << 14,
        spp=16,
        loss="l1",  # squared errors of glossy interreflection outweigh all others
        halves=False,
        tv=0.1,
        descent=DescentOptions(learning_rate=0.01, beta_2=0.99),
    ),
    "paper_polish": replace(_PAPER_PATH, epochs=1.0, spp=16),
}

PAPER_PRESETS = ("paper", "coefficients", "spectrum", "paper_polish")

# Presets of both parts of sh+path. Textures of sh are close to the optimum, so path uses low rates
# and more paths: noise would undo the result.
BOTH_PRESETS: dict[str, tuple[str, str]] = {
    "default": ("default", "polish"),
    "paper": ("paper", "paper_polish"),
    "coefficients": ("coefficients", "paper_polish"),
    "spectrum": ("spectrum", "paper_polish"),
}


PRESETS_OF: dict[str, Mapping[str, Any]] = {
    "sh": SH_PRESETS, "path": PATH_PRESETS, "sh+path": BOTH_PRESETS,
}  # fmt: skip


def method_options(
    method: Method, preset: str, sh: ShOptions | None = None, path: PathOptions | None = None,
    tv: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return options by part of a method; ``sh`` and ``path`` replace the preset's."""
    names = _preset(preset, method) if method == "sh+path" else (preset,)
    options = {}
    for part, name in zip(method.split("+"), names, strict=True):
        own = _preset(name, part)
        options[part] = {"sh": sh, "path": path}[part] or own
    return options if tv is None else {part: replace(own, tv=tv) for part, own in options.items()}


def _preset(name: str, method: str) -> Any:
    known = PRESETS_OF[method]
    if name not in known:
        others = [other for other, theirs in PRESETS_OF.items() if name in theirs]
        raise OptionError(
            f"Unknown preset {name!r} of method {method!r}; use one of {', '.join(known)}."
            + (f" {name!r} is a preset of method {others[0]!r}." if others else "")
        )
    return known[name]
