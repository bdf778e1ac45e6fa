"""Presets: named, frozen sets of a method's switches.

``paper`` is the method as printed; ``default`` is our best, one setting for all scenes;
``fast`` trades accuracy for time; ``fixed`` (angular only) assumes a noise of 8 % of the mean
radiance instead of estimating it, which is what a path-traced reference is compared with.
Each difference between them is a single switch, so an ablation is
``preset("paper", penalize_constant=False)``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, overload

from svu_mi.errors import OptionError
from svu_mi.switches import AngularPreset as AngularPreset
from svu_mi.switches import Fit as Fit
from svu_mi.switches import Preset as Preset

Method = Literal["angular", "spectrum"]


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
