"""Presets: named, frozen sets of a method's switches, each with its range and its reason.

``paper`` is the method as printed; ``default`` is our best, one setting for all scenes;
``fast`` trades accuracy for time; ``fixed`` (angular only) assumes a noise of 8 % of the mean
radiance instead of estimating it, which is what a path-traced reference is compared with.
Each difference between them is a single switch, so an ablation is
``preset("paper", penalize_constant=False)``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from math import inf
from typing import Any, Literal, overload

from svu_mi.core.validation import require, require_ranges, require_types
from svu_mi.errors import OptionError

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
    """Colour channels of the presets of all methods."""

    channels: Any

    @property
    def colors(self) -> int:
        """Number of colour channels that are looked at: 3, or 1 for their mean."""
        return 1 if self.channels == "grey" else 3


@dataclass(frozen=True, kw_only=True)
class Preset(_Channels):
    """Switches of the spectrum estimator; the defaults are those of ``default``."""

    name: str = "default"

    degree: int = 6
    """Highest degree l* of the fit and of the sum in Eq. 11; the paper uses 5 and 6."""

    regularizer: float = 1e-2
    """lambda of Eq. 12; the paper uses 1e-3 and 1e-2."""

    penalize_constant: bool = False
    """R_00 = e^0 = 1 as Eq. 12 prints it; False leaves l = 0, the diffuse term, free."""

    band_limit: BandLimit = "photographs"
    """Light that guidance judges candidates in: that of the estimate, or (Eq. 13 as printed) one
    that is sharper with every view chosen; see ``GuidanceOptions``."""

    undo_prefilter: bool = False
    """Use alpha^2 - alpha'^2 in the likelihood: the photographs are not band-limited, the
    light is (alpha' = v^(-1/2)). But the fit attenuates what it regularises in the photographs
    as well, and roughness below v^(-1/4) becomes one: measured, it is worse."""

    occluded: bool = True
    """No light comes from where the object itself stands: in the mirror direction, and in the
    irradiance."""

    rays: int = 64
    """Cells of the light that the irradiance is traced for; half of them are above a texel."""

    albedo: bool = True
    """Rough lobes reflect less than all light, by GGX's directional albedo; on a grid of
    principled parameters, as Ks in itself is the scale of a lobe."""

    parameters: Parameters = "principled"
    """``principled``: a posterior over (roughness, metallic, base colour), in which degree 0
    takes part; ``specular``: over (roughness, Ks), l > 0 alone, as in the paper."""

    bounded_alpha: bool = True
    """alpha = max(roughness^2, 1e-3), as Mitsuba's BSDF has it; False leaves out the bound."""

    spacing: GridSpacing = "dielectric"
    """Nodes of Ks: ``uniform`` on [0, 1], or ``dielectric``: 0.04 + 0.96 t^2, t uniform."""

    channels: ChannelRule = "grey"
    """How R, G, B combine: ``grey`` fits their mean; ``sum`` adds them in d, over (roughness, Ks)
    whatever ``parameters`` say."""

    noise: NoiseRule = "relative"
    """``fixed``: sigma in squared radiance (depends on exposure); ``relative``: sigma times
    the capture's mean observed power."""

    sigma: float = 0.004
    """Standard deviation of a degree's power, in the unit that ``noise`` says."""

    constant_sigma: float = 0.06
    """Standard deviation of sqrt(S(0)), in radiance if ``noise`` is ``fixed``, else relative
    to the square root of the capture's mean power."""

    def __post_init__(self) -> None:
        require_types(self)
        # dr.sh_eval ends at 9; double precision beyond: a singular fit, an infinite 1 / sigma^2.
        require_ranges(
            self, degree=(1, 9), regularizer=(1e-12, 1e12), sigma=(1e-30, 1e30),
            constant_sigma=(1e-30, 1e30), rays=(16, 4096),
        )  # fmt: skip

    @property
    def principled(self) -> bool:
        """Whether the posterior is over principled parameters."""
        return self.parameters == "principled" and self.channels == "grey"


@dataclass(frozen=True, kw_only=True)
class Fit:
    """How light is expanded in spherical harmonics at every texel (Eq. 12), as printed.

    The samples are those that the texel mirrors into its photographs; light is band-limited at
    alpha' = v^(-1/2) for v photographs first (Sec. 3.3.2).
    """

    degree: int = 6
    """Highest degree l*; the paper uses 5 and 6."""

    regularizer: float = 1e-3
    """lambda; the paper uses 1e-3 and 1e-2."""

    penalize_constant: bool = True
    """R_00 = e^0 = 1 as printed; False leaves l = 0 free."""

    undo_prefilter: bool = False
    """Lobes of width alpha^2 - alpha'^2 instead of alpha^2, since light is filtered already."""

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(self, degree=(1, 9), regularizer=(1e-12, 1e12))


@dataclass(frozen=True, kw_only=True)
class AngularPreset(_Channels):
    """Switches of the angular estimator; the defaults are those of ``default``."""

    name: str = "default"

    fresnel: Fresnel = "split_sum"
    """Of lobes that are looked up; ``none``: R0; ``schlick`` at theta_o, as Eq. 6 has it;
    ``split_sum``: averaged over the lobe."""

    lobe: Lobe = "ggx"
    """Of lobes that are looked up; ``gaussian``: degrees fall off as exp(-(alpha l)^2) (Eq. 6);
    ``ggx``: Mitsuba's."""

    fit: Fit | None = None
    """Light of lobes: None looks it up in maps that are filtered for each width; a ``Fit`` expands
    what every texel mirrors in spherical harmonics, which lobes then convolve: the paper's SH
    model. Nothing is traced then (``cells=0``), and lobes are Gaussian around the mirror."""

    off_specular: bool = True
    """Lobes that are looked up lean from the mirror direction towards the normal."""

    cells: int = 1024
    """Fine cells of the light, whose visibility is traced and which wide lobes are summed over;
    0: nothing is traced, light is hidden from nowhere, and all lobes look filtered light up."""

    occluded: bool = True
    """Light that the object itself hides is missing, from the irradiance and from lobes."""

    diffuse: Diffuse = "disney"
    """``disney``: Mitsuba's diffuse lobe, with retro-reflection; ``lambert``: constant."""

    parameters: Parameters = "principled"
    """``principled``: a posterior over (roughness, metallic, base colour); ``specular``: over
    (roughness, Ks), with the diffuse term at its best for each cell."""

    channels: AngularChannels = "joint"
    """``grey``: the mean of R, G, B and a grey base colour; ``joint``: one roughness and
    metallic for all, a base colour (or Ks) for each channel, the others marginalised."""

    noise: AngularNoise = "estimated"
    """``estimated``: of every texel, from the photographs (``posterior/noise.py``), and every
    view counts. The others take the mean squared error over views: ``fixed``: sigma in radiance;
    ``relative``: sigma times the capture's mean radiance; ``heteroscedastic``: that, growing with
    the sample's own radiance."""

    sigma: float = 0.08
    """Standard deviation of a texel's root mean squared error, in the unit that ``noise``
    says, unless that is estimated. The error is the model's more than the camera's: it does not
    average out over views."""

    errors: Errors = "mean"
    """Squared errors of views: their ``mean``, or their ``sum``, as printed, so that many views
    say more than few (estimated: always all views)."""

    assumed: float = 0.02
    """s_0: noise of a sample where too few views tell, as a part of the mean radiance
    (estimated)."""

    overdispersion: float = 3.5
    """tau: so many samples say what one would if their errors were independent (estimated)."""

    degrees: float = 4.0
    """nu: so many samples of the median texel's noise are added to a texel's own (estimated)."""

    knee: float = 0.5
    """Radiance from which noise grows with it, as a part of the mean radiance (estimated)."""

    edges: float = 60.0
    """eta: how much noise grows with the variance of the pixels that a sample is read from, since
    on an edge of a photograph a little beside is something else (estimated)."""

    metals: float = 0.8
    """Prior probability that metallic is 0 or 1, nothing in between (estimated)."""

    levels: int = 8
    """Levels of roughness that statistics are gathered at, between which they are interpolated
    (estimated; the others take the grid's nodes)."""

    parts: int = 42
    """Parts of roughness that are integrated over, at least (estimated)."""

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(
            self, sigma=(1e-12, 1e12), assumed=(1e-12, 1e12), overdispersion=(1, 1e6),
            degrees=(1e-6, 1e6), knee=(1e-6, 1e6), edges=(0, 1e6), metals=(0, 0.99),
            levels=(4, 64), parts=(2, 512),
        )  # fmt: skip
        if self.noise == "estimated" and self.parameters != "principled":
            raise OptionError(
                "AngularPreset: noise='estimated' is for parameters='principled'; over "
                "(roughness, Ks), use noise='relative'."
            )
        traced = self.cells == 0 or 256 <= self.cells <= 4096
        require(self, traced, "cells", "in [256, 4096], or 0 to trace none")
        if self.fit is not None:
            self._require_printed()
        if self.errors == "sum" and self.noise == "estimated":
            raise OptionError(
                "AngularPreset: noise='estimated' counts views itself; errors='sum' is "
                "for noise='fixed', 'relative' or 'heteroscedastic'."
            )

    def _require_printed(self) -> None:
        """Light that is fitted texel by texel has the lobes of Eq. 6, and no others."""
        require(self, isinstance(self.fit, Fit), "fit", "a Fit, or None")
        require(self, self.cells == 0, "cells", "0 with a fit, which traces nothing")
        require(self, self.lobe == "gaussian", "lobe", "'gaussian' with a fit")
        require(self, self.fresnel != "split_sum", "fresnel", "'schlick' or 'none' with a fit")
        require(self, not self.off_specular, "off_specular", "False with a fit")
        require(self, not self.occluded, "occluded", "False with a fit")

    @property
    def traced(self) -> bool:
        """Whether anything is traced that light arrives from."""
        return self.cells > 0

    def kappa(self, unit: float) -> float:
        """Return the radiance around which samples begin to count less; infinite if none does.

        Args:
            unit: mean radiance of the photographs.
        """
        return {"estimated": self.knee * unit, "heteroscedastic": unit}.get(self.noise, inf)


@dataclass(frozen=True, kw_only=True)
class Skip:
    """Work that is left out because the result is the same without; all of it by default.

    Texels outside the charts are never work. ``Skip(unseen=False)`` turns one off, to see what
    it saves; ``NOTHING`` turns off all.
    """

    unseen: bool = True
    """Texels that no photograph shows: no occlusion rays, no statistics, no fit."""

    pairs: bool = True
    """Texels and views that do not face each other, or where no usable pixel is: no ray; and
    wherever a view does not see a texel, no look-up, no reflection model."""

    blind: bool = True
    """Views that show no texel."""

    channels: bool = True
    """Under grey light and in grey photographs, one channel stands for three."""

    levels: bool = True
    """Roughness that the prior excludes: no filtered light, no statistics, where these are gathered
    at the grid's nodes. (Energies that the prior excludes are never computed.)"""


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
    "fast": AngularPreset(name="fast", channels="grey", cells=0, parts=14),
    # The paper states no sigma. That of a sum over 25 views, as many as see a texel of a sphere of
    # 60 cameras, which weighs as much as .08 does for their mean.
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
    base: str | AnyPreset = ..., *, method: Literal["spectrum"] = ..., **switches: object
) -> Preset: ...
@overload
def preset(
    base: str | AnyPreset = ..., *, method: Literal["angular"], **switches: object
) -> AngularPreset: ...
@overload
def preset(base: str | AnyPreset = ..., *, method: Method, **switches: object) -> AnyPreset: ...
def preset(
    base: str | AnyPreset = "default", *, method: Method = "spectrum", **switches: object
) -> AnyPreset:
    """Return a named preset, with single switches replaced.

    Args:
        base: ``paper``, ``default``, ``fast``, ``fixed`` (angular only), or a preset to start
            from.
        method: the estimator it is for; each has switches of its own.
        **switches: fields of ``Preset`` or ``AngularPreset`` to replace, such as ``degree=5``.

    Raises:
        OptionError: an unknown preset, method or switch, a preset of another method, or a
            value outside its range.
    """
    if method not in METHODS:
        raise OptionError(f"Unknown method {method!r}; use one of {', '.join(METHODS)}.")
    kind, named = METHODS[method]
    if isinstance(base, str):
        _require(base, method, "preset", {key: list(there) for key, (_, there) in METHODS.items()})
        base = named[base]
    kinds = {key: [field.name for field in fields(each)] for key, (each, _) in METHODS.items()}
    for switch in switches:
        _require(switch, method, "switch", kinds)
    if not isinstance(base, kind):
        raise OptionError(
            f"A preset of method {method!r} must be a name or a {kind.__name__}, got {base!r}."
        )
    return replace(base, **switches) if switches else base


def _require(name: str, method: str, what: str, known: dict[str, list[str]]) -> None:
    """Refuse a name that a method does not have, and say which one does."""
    if name not in known[method]:
        others = [other for other in known if name in known[other]]
        raise OptionError(
            f"Unknown {what} {name!r}; method {method!r} has {', '.join(sorted(known[method]))}."
            + (f" {name!r} is one of method {others[0]!r}." if others else "")
        )
