"""Presets: frozen options of each method, with ranges and reasons.

``paper`` is the published method. ``default`` is the most accurate; the same values serve all
scenes. ``fast`` is less accurate. ``fixed`` (angular only) assumes a noise of 8 % of the mean
radiance instead of estimating it, as comparisons with path-traced references require. Presets
differ in single options, so an ablation is ``preset("paper", errors="mean")``.
"""

from dataclasses import dataclass, fields, replace
from math import inf
from typing import Any, Literal, overload

from svu_mi.core.validation import require, require_ranges, require_types
from svu_mi.errors import OptionError, excerpt

Method = Literal["angular", "spectrum"]
GridSpacing = Literal["uniform", "dielectric"]
ChannelRule = Literal["grey", "sum"]
NoiseRule = Literal["fixed", "relative"]

Fresnel = Literal["none", "schlick", "split_sum"]
Lobe = Literal["gaussian", "ggx"]
Diffuse = Literal["lambert", "disney"]
Parameters = Literal["principled", "specular"]
AngularChannels = Literal["grey", "joint"]
AngularNoise = Literal["estimated", "fixed", "relative", "heteroscedastic"]
Errors = Literal["mean", "sum"]
BandLimit = Literal["photographs", "growing"]


class _Channels:
    """Option ``channels``, which the presets of all methods have."""

    channels: Any

    @property
    def colors(self) -> int:
        """Number of processed colour channels: 3, or 1 for their mean."""
        return 1 if self.channels == "grey" else 3


@dataclass(frozen=True, kw_only=True)
class Preset(_Channels):
    """Options of the spectrum estimator; defaults form the preset ``default``.

    Example:
        >>> svu.Preset().degree
        6
        >>> svu.preset("paper", method="spectrum", degree=5)
        Preset(name='paper', degree=5, ...)
    """

    name: str = "default"

    degree: int = 6
    """Highest degree l* of the fit and of the sum in Eq. 11; the paper uses 5 and 6."""

    regularizer: float = 1e-2
    """lambda of Eq. 12; the paper uses 1e-3 and 1e-2."""

    penalize_constant: bool = False
    """True: R_00 = e^0 = 1 (Eq. 12 as printed). False: l = 0, the diffuse term, is unpenalised."""

    band_limit: BandLimit = "photographs"
    """Band limit of the light in guidance. ``photographs``: as in the estimate; ``growing``: higher
    with each chosen view (Eq. 13 as printed). See ``GuidanceOptions``."""

    undo_prefilter: bool = False
    """True: use alpha^2 - alpha'^2 in the likelihood, because the light is band-limited at
    alpha' = v^(-1/2) and the photographs are not. Off, because it is less accurate: the regulariser
    attenuates the photographs, too, and roughness below v^(-1/4) becomes indistinguishable."""

    occluded: bool = True
    """True: the object occludes light, in the mirror direction and in the irradiance."""

    rays: int = 64
    """Number of light cells traced for the irradiance; half of them are above a texel's horizon."""

    albedo: bool = True
    """True: scale lobes by GGX's directional albedo. Only for ``PrincipledGrid``, because Ks
    already scales a lobe."""

    parameters: Parameters = "principled"
    """``principled``: posterior over (roughness, metallic, base colour), using degrees l >= 0;
    ``specular``: posterior over (roughness, Ks), using l > 0, as in the paper."""

    bounded_alpha: bool = True
    """True: alpha = max(roughness^2, 1e-3), as in Mitsuba's BSDF; False: alpha = roughness^2."""

    spacing: GridSpacing = "dielectric"
    """Nodes of Ks: ``uniform`` on [0, 1], or ``dielectric``: 0.04 + 0.96 t^2, t uniform."""

    channels: ChannelRule = "grey"
    """``grey``: fit the mean of R, G and B; ``sum``: add the distances d of R, G and B. ``sum``
    implies a posterior over (roughness, Ks)."""

    noise: NoiseRule = "relative"
    """Unit of ``sigma``. ``fixed``: squared radiance (depends on exposure); ``relative``: mean
    observed power of the capture."""

    sigma: float = 0.004
    """Standard deviation of the power of a degree, in the unit given by ``noise``."""

    constant_sigma: float = 0.06
    """Standard deviation of sqrt(S(0)): in radiance if ``noise`` is ``fixed``, otherwise relative
    to the square root of the capture's mean power."""

    def __post_init__(self) -> None:
        require_types(self)
        # dr.sh_eval supports l <= 9. Values beyond the other limits make the fit singular or
        # 1 / sigma^2 infinite in double precision.
        require_ranges(
            self, degree=(1, 9), regularizer=(1e-12, 1e12), sigma=(1e-30, 1e30),
            constant_sigma=(1e-30, 1e30), rays=(16, 4096),
        )  # fmt: skip

    @property
    def principled(self) -> bool:
        """True if the posterior is over principled parameters."""
        return self.parameters == "principled" and self.channels == "grey"


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Options of the SH fit of each texel's light (Eq. 12); defaults as in the paper.

    Samples are the directions that the texel mirrors into the v photographs. The light is first
    band-limited at alpha' = v^(-1/2) (Sec. 3.3.2).

    Example:
        >>> svu.preset("paper", method="angular", fit=svu.Fit(degree=5)).fit.degree
        5
    """

    degree: int = 6
    """Highest degree l*; the paper uses 5 and 6."""

    regularizer: float = 1e-3
    """lambda; the paper uses 1e-3 and 1e-2."""

    penalize_constant: bool = True
    """True: R_00 = e^0 = 1 as printed; False: l = 0 is unpenalised."""

    undo_prefilter: bool = False
    """True: lobes of squared width alpha^2 - alpha'^2 instead of alpha^2, because the light is
    already band-limited at alpha'."""

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(self, degree=(1, 9), regularizer=(1e-12, 1e12))


@dataclass(frozen=True, kw_only=True)
class AngularPreset(_Channels):
    """Options of the angular estimator; defaults form the preset ``default``.

    Options marked (calibrated) apply only if ``noise`` is ``estimated``.

    Example:
        >>> svu.AngularPreset(cells=512).occluded
        True
        >>> svu.estimate(capture, texels, preset=svu.AngularPreset(metals=0.5)).preset.metals
        0.5
    """

    name: str = "default"

    fresnel: Fresnel = "split_sum"
    """Fresnel term of narrow lobes (prefiltered light). ``none``: R0; ``schlick``: at the angle
    theta_o (Eq. 6); ``split_sum``: averaged over the lobe."""

    lobe: Lobe = "ggx"
    """Shape of narrow lobes. ``gaussian``: degree l is scaled by exp(-(alpha l)^2) (Eq. 6);
    ``ggx``: as in Mitsuba."""

    fit: Fit | None = None
    """None: narrow lobes read light prefiltered for each width. A ``Fit``: lobes convolve a
    spherical harmonic fit of each texel's mirrored light (the paper's SH model). A fit requires
    ``cells=0`` and Gaussian lobes around the mirror direction."""

    off_specular: bool = True
    """True: centres of narrow lobes are shifted from the mirror direction towards the normal."""

    cells: int = 1024
    """Number of fine light cells. Their visibility is traced, and wide lobes are sums over them.
    0: no visibility is traced, and all lobes read prefiltered light."""

    occluded: bool = True
    """True: the object occludes light, in the irradiance and in lobes."""

    bounces: bool = False
    """True: the object also receives light from itself, as bright as it is in the photographs.
    Requires ``occluded`` and ``cells``. Light from other shapes is included in any case."""

    diffuse: Diffuse = "disney"
    """``disney``: Mitsuba's diffuse lobe, with retro-reflection; ``lambert``: constant."""

    parameters: Parameters = "principled"
    """``principled``: posterior over (roughness, metallic, base colour); ``specular``: over
    (roughness, Ks), with the diffuse term that minimises the error of each bin."""

    channels: AngularChannels = "joint"
    """``grey``: the mean of R, G and B, with a grey base colour; ``joint``: shared roughness and
    metallic, and a base colour (or Ks) per channel with the others marginalised."""

    noise: AngularNoise = "estimated"
    """``estimated``: noise of each texel from its residual (``posterior/noise.py``). The other
    rules assume ``sigma`` for the root mean squared error over views. ``fixed``: in radiance;
    ``relative``: relative to the capture's mean radiance; ``heteroscedastic``: relative, and
    increasing with the radiance of the sample."""

    sigma: float = 0.08
    """Standard deviation of a texel's root mean squared error, in the unit given by ``noise``;
    ignored if ``noise`` is ``estimated``. It does not decrease with the number of views, because
    errors of the reflection model exceed camera noise."""

    errors: Errors = "mean"
    """``mean`` of squared errors over views; or their ``sum`` (Eq. 4 as printed), which makes the
    posterior narrower with each view. Must be ``mean`` if ``noise`` is ``estimated``."""

    assumed: float = 0.02
    """s_0: noise of a sample if few views show the texels, relative to the mean radiance
    (calibrated)."""

    overdispersion: float = 3.5
    """Overdispersion tau: N samples with correlated errors count as N / tau (calibrated)."""

    folds: int = 6
    """Number of clusters of cameras that are held out in turn to test error bars; if texels change
    more than their standard deviations permit, these are increased. 0: no test (calibrated)."""

    degrees: float = 4.0
    """Degrees of freedom nu of the noise prior. The prior counts as nu samples with the noise of
    the median texel (calibrated)."""

    knee: float = 0.5
    """kappa: radiance above which noise increases in proportion to radiance, relative to the mean
    radiance (calibrated)."""

    edges: float = 60.0
    """eta: increase of the noise variance with the variance of nearby pixels. On image edges, small
    errors of the pose change the sample (calibrated)."""

    metals: float = 0.8
    """Prior probability that metallic is exactly 0 or 1 (calibrated)."""

    metal_share: float | None = None
    """Prior probability that metallic is 1 where it is 0 or 1. None: learned from the object by
    ``estimate``, between 0.06 and 0.83; otherwise 0.5 (calibrated)."""

    bare_metals: float = 0.5
    """Prior probability that a channel of a metal's base colour is that of bare metals, about 0.4
    to 1; other metals have any colour but black. 0: the prior of base colour is uniform for metals,
    too (calibrated)."""

    levels: int = 12
    """Number of roughness levels of the statistics, which are interpolated in between (calibrated;
    otherwise statistics are gathered at the grid's nodes)."""

    parts: int = 42
    """Minimum number of quadrature nodes of roughness (calibrated)."""

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(
            self, sigma=(1e-12, 1e12), assumed=(1e-12, 1e12), overdispersion=(1, 1e6),
            degrees=(1e-6, 1e6), knee=(1e-6, 1e6), edges=(0, 1e6), metals=(0, 0.99),
            bare_metals=(0, 0.99), levels=(4, 64), parts=(2, 512), folds=(0, 60),
        )  # fmt: skip
        if self.noise == "estimated" and self.parameters != "principled":
            raise OptionError(
                "AngularPreset: noise='estimated' requires parameters='principled'; for "
                "parameters='specular', use noise='relative'."
            )
        share = 0.5 if self.metal_share is None else self.metal_share
        is_share = 0.001 <= share <= 0.999
        require(self, is_share, "metal_share", "in [0.001, 0.999], or None to learn it")
        traced = self.cells == 0 or 256 <= self.cells <= 4096
        require(self, traced, "cells", "in [256, 4096], or 0 to trace none")
        require(
            self, self.with_surfaces or not self.bounces, "bounces",
            "False without cells and occlusion, as in fast",
        )  # fmt: skip
        if self.fit is not None:
            self._require_printed()
        if self.errors == "sum" and self.noise == "estimated":
            raise OptionError(
                "AngularPreset: errors='sum' requires noise='fixed', 'relative' or "
                "'heteroscedastic', not 'estimated'."
            )

    def _require_printed(self) -> None:
        """Raise an error unless lobes are as in Eq. 6, which a ``fit`` requires."""
        require(self, self.cells == 0, "cells", "0 with a fit, which has no visibility")
        require(self, self.lobe == "gaussian", "lobe", "'gaussian' with a fit")
        require(self, self.fresnel != "split_sum", "fresnel", "'schlick' or 'none' with a fit")
        require(self, not self.off_specular, "off_specular", "False with a fit")
        require(self, not self.occluded, "occluded", "False with a fit")

    @property
    def traced(self) -> bool:
        """True if the visibility of light cells is traced."""
        return self.cells > 0

    @property
    def with_surfaces(self) -> bool:
        """True if the light from other surfaces is modelled."""
        return self.traced and self.occluded

    def kappa(self, unit: float) -> float:
        """Return the radiance above which weights of samples decrease; infinity if they are equal.

        Args:
            unit: mean radiance of the photographs.
        """
        return {"estimated": self.knee * unit, "heteroscedastic": unit}.get(self.noise, inf)


@dataclass(frozen=True, kw_only=True)
class Skip:
    """Optimisations that do not change results; all are enabled by default.

    To measure one, disable it; ``NOTHING`` disables all. Texels outside the charts are never
    computed.

    Example:
        >>> slow = svu.estimate(capture, texels, skip=svu.Skip(unseen=False))
        >>> np.allclose(slow.entropy, estimate.entropy, atol=1e-4)
        True
    """

    unseen: bool = True
    """Skip occlusion rays, statistics and fits of texels that no photograph shows."""

    pairs: bool = True
    """Trace no ray for pairs of texel and view that face away from each other or have no usable
    pixel. Read no pixel and compute no reflection for pairs that are not visible."""

    blind: bool = True
    """Skip views that show no texel."""

    channels: bool = True
    """Compute one channel instead of three if light or photographs are grey."""

    levels: bool = True
    """Skip prefiltered light and statistics of roughness nodes that the prior excludes. (If noise
    is estimated, statistics need all levels.)"""


NOTHING = Skip(unseen=False, pairs=False, blind=False, channels=False, levels=False)


PRESETS: dict[str, Preset] = {
    "default": Preset(),
    "fast": Preset(name="fast", degree=4),
    "paper": Preset(
        name="paper", penalize_constant=True, undo_prefilter=False, bounded_alpha=False,
        regularizer=1e-3, occluded=False, albedo=False, parameters="specular",
        spacing="uniform", channels="sum", noise="fixed", sigma=0.1, band_limit="growing",
    ),
}  # fmt: skip

ANGULAR_PRESETS: dict[str, AngularPreset] = {
    "default": AngularPreset(),
    "fixed": AngularPreset(name="fixed", channels="grey", noise="relative"),
    "fast": AngularPreset(
        name="fast", channels="grey", cells=0, parts=14, folds=0, bare_metals=0.0, metal_share=0.5
    ),
    # The paper gives no sigma. 0.4 for a sum over 25 views equals 0.08 for their mean; about 25 of
    # 60 cameras on a sphere see a texel.
    "paper": AngularPreset(
        name="paper", channels="grey", noise="relative", sigma=0.4, errors="sum", fit=Fit(),
        fresnel="schlick", lobe="gaussian", off_specular=False, cells=0, occluded=False,
        diffuse="lambert",
    ),
}  # fmt: skip


AnyPreset = Preset | AngularPreset
METHODS: dict[str, tuple[Any, dict[str, Any]]] = {
    "spectrum": (Preset, PRESETS), "angular": (AngularPreset, ANGULAR_PRESETS),
}  # fmt: skip


@overload
def preset(
    base: str | AnyPreset = ..., *, method: Literal["spectrum"], **switches: object
) -> Preset: ...
@overload
def preset(
    base: str | AnyPreset = ..., *, method: Literal["angular"] = ..., **switches: object
) -> AngularPreset: ...
@overload
def preset(base: str | AnyPreset = ..., *, method: Method, **switches: object) -> AnyPreset: ...
def preset(
    base: str | AnyPreset = "default", *, method: Method = "angular", **switches: object
) -> AnyPreset:
    """Return a preset of a method, with some options replaced.

    Args:
        base: ``paper``, ``default``, ``fast``, ``fixed`` (angular only), or a preset object.
        method: ``angular`` returns an ``AngularPreset``, ``spectrum`` a ``Preset``.
        **switches: options to replace, such as ``degree=5``.

    Raises:
        OptionError: an unknown preset, method or option, a preset of another method, or a
            value outside its range.

    Example:
        >>> svu.preset("fast").cells
        0
        >>> svu.preset("paper", method="spectrum", penalize_constant=False).regularizer
        0.001
    """
    kind, named = METHODS[method]
    if isinstance(base, str):
        _require(base, method, "preset", {key: list(there) for key, (_, there) in METHODS.items()})
        base = named[base]
    kinds = {key: [field.name for field in fields(each)] for key, (each, _) in METHODS.items()}
    for switch in switches:
        _require(switch, method, "switch", kinds)
    if not isinstance(base, kind):
        raise OptionError(
            f"preset(): method {method!r} has {kind.__name__} objects, got {excerpt(base, 60)}."
        )
    return replace(base, **switches) if switches else base


def _require(name: str, method: str, what: str, known: dict[str, list[str]]) -> None:
    """Raise an error if a method lacks ``name``; suggest the method that has it."""
    if name not in known[method]:
        others = [other for other in known if name in known[other]]
        raise OptionError(
            f"Unknown {what} {name!r}; method {method!r} has {', '.join(sorted(known[method]))}."
            + (f" For {name!r}, use method {others[0]!r}." if others else "")
        )
