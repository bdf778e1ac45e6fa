"""Settings of recovery: how to descend, and on what.

Frozen; every run writes them down, and can be repeated from them.
"""

from __future__ import annotations

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
    """How gradient descent (Adam) runs.

    Attributes:
        steps: at most so many.
        learning_rate: of the first step, in units of the parameters (all in [0, 1]).
        final_rate: of the last, as a part of ``learning_rate``; it falls geometrically.
        tolerance: stop when the mean loss over a window has fallen by less than this part of
            itself since the window before; 0 never stops early.
        window: steps of such a window.
        low, high: bounds of every parameter; values are projected onto them after each step.
        scales: factors of the rates of single parameters, by name; 1 for all others.
        beta_1, beta_2: how long Adam remembers gradients and their squares.
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
        object.__setattr__(self, "scales", dict(self.scales))  # the caller's may change
        require_types(self)
        for name in ("steps", "window"):
            require(self, getattr(self, name) >= 1, name, "a whole number, at least 1")
        for name in ("tolerance", "beta_1", "beta_2"):
            require(self, 0 <= getattr(self, name) < 1, name, "in [0, 1)")
        require(self, 0 < self.learning_rate < inf, "learning_rate", "positive")
        require(self, 0 < self.final_rate <= 1, "final_rate", "in (0, 1]")
        require(self, -inf < self.low < self.high < inf, "low", "a number below high")
        require(self, all(0 <= scale < inf for scale in self.scales.values()), "scales",
                "numbers that are not negative, by parameter")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ShOptions:
    """Recovery by the SH reflection model.

    Attributes:
        loss: ``statistics``: what photographs say by the calibrated posterior, which costs the same
            for any number of them; or, as in the paper, ``angular``: mean absolute error over
            all samples; ``coefficients`` and ``spectrum``: those of SH expansions.
        closed_form: start from the mean of every texel's posterior, smoothed, instead of 0.5
            everywhere (``statistics``).
        smoothing: how to descend where this start is smoothed; with ``tv`` 0 it is not.
        robust: number of re-weighted passes, after each of which the squared error is nearer to
            an absolute one (``statistics``).
        tv: weight of total variation; with ``statistics`` in nats per texel and multiplied by the
            square root of the number of texels, as steps from one to the next get smaller.
        tv_space: where neighbours are: on the ``surface``, across the seams of UV charts; or, as
            in the paper, in the ``texture``, to the right and below.
        tv_epsilon: differences far below it count as squares; 0, as printed, for absolute values.
        sharing: weight of a ``GlobalSharing``, if there is any. A prior in common has none, but
            there is none either if this is 0.
        common_prior: share by a prior of all texels (``posterior/empirical_bayes.py``);
            else as the paper prints Eq. 14 and 15 (``GlobalSharing.printed``), by the posterior
            of Eq. 11.
        descent: how to descend.
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
    """Recovery by Mitsuba's own loop.

    Attributes:
        epochs: times every usable pixel is looked at; ``descent.steps`` is not used.
        pixels_per_batch: of one step, drawn from all views; None for as many as a photograph has on
            average.
        spp: paths per pixel.
        max_depth: longest path; 2 is direct light only; None takes that of the scene's integrator.
        loss: of a pixel: ``l2``; ``l1``, as in the paper; or ``relative``: l2 over the squared
            radiance, which noise in dark photographs biases.
        halves: trace a batch in two passes instead of three, where the paths of a pixel serve each
            other in halves; an odd ``spp`` has none.
        tv: weight of total variation.
        tv_space, tv_epsilon: as for ``ShOptions``.
        sharing: weight of global sharing, if there is any; 0 for none.
        common_prior: share by a prior that texels have in common: they are pulled towards what
            they probably are under it; else as for ``ShOptions``.
        seed: of batches and paths.
        descent: how to descend.
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
    sharing: float = 8.0
    common_prior: bool = True
    seed: int = 0
    descent: DescentOptions = field(
        default_factory=lambda: DescentOptions(
            learning_rate=0.05, final_rate=0.02, beta_2=0.99,
            # Base colour first: what light there is in all must be right before its shape is.
            scales={"roughness": 0.2, "metallic": 0.2},
        )
    )  # fmt: skip

    def __post_init__(self) -> None:
        require_types(self)
        require(self, 0 < self.epochs < inf, "epochs", "positive")
        size = self.pixels_per_batch
        require(self, size is None or (isinstance(size, int) and 1 <= size < 2**32),
                "pixels_per_batch", "at least 1, or None")  # fmt: skip
        require(self, 1 <= self.spp < 2**16, "spp", "in [1, 65535]")
        depth = self.max_depth
        require(self, depth is None or (isinstance(depth, int) and (depth >= 2 or depth == -1)),
                "max_depth", "at least 2, -1 for paths of any length, or None")  # fmt: skip
        _require_weights(self)
        require(self, 0 <= self.seed < 2**32, "seed", "in [0, 2^32)")


def _require_weights(options: ShOptions | PathOptions) -> None:
    """Refuse regularisers with an invalid weight."""
    for name in ("tv", "tv_epsilon", "sharing"):
        require(options, 0 <= getattr(options, name) < inf, name, "at least 0")


_PAPER = ShOptions(
    loss="angular", closed_form=False, tv=1e-2, tv_space="texture", tv_epsilon=0.0,
    sharing=1e-2, common_prior=False,
    descent=DescentOptions(steps=200, learning_rate=0.01, final_rate=1.0),
)  # fmt: skip

_PAPER_PATH = PathOptions(
    # As many rays as a photograph has, and ten epochs: the paper does not say; its code does so.
    # In halves, the error of 32 paths would be that of twice 16: an absolute error is not linear.
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
        spp=4,
        tv=0.5,
        descent=DescentOptions(learning_rate=0.005, beta_2=0.99),
    ),
    "paper_polish": replace(_PAPER_PATH, epochs=1.0, spp=16),
}

PAPER_PRESETS = ("paper", "coefficients", "spectrum", "paper_polish")

# Of sh+path: the presets of its two parts. After sh, the start is as good as many epochs: what is
# left is detail, no cause for noise.
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
    """Return the options of the parts of a method, by name; the preset's where none are given."""
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
            + (f" {name!r} is one of method {others[0]!r}." if others else "")
        )
    return known[name]
