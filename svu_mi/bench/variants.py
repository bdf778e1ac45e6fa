"""The estimators that are compared. The one file to edit when there is a new one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, get_args, get_type_hints

from svu_mi.errors import OptionError
from svu_mi.options import preset
from svu_mi.pipeline import estimate


@dataclass(frozen=True)
class Variant:
    """One estimator.

    Attributes:
        label: unique; the name in tables and plots.
        method: of ``svu_mi.pipeline.estimate``.
        base: named preset to start from.
        switches: fields of the preset that differ.
        main: compared in every table and plot, and timed cold; the others are single
            switches, shown as differences to ``default`` of their method.
    """

    label: str
    method: Any  # the literal type that estimate() asks for
    base: str
    switches: dict[str, Any] = field(default_factory=dict)
    main: bool = False

    @property
    def preset(self) -> Any:
        """The preset with its switches replaced."""
        return preset(self.base, method=self.method, **self.switches)


def _spectrum(label: str, main: bool = False, base: str = "default", **switches: Any) -> Variant:
    return Variant(f"spectrum {label}", "spectrum", base, switches, main)


def _angular(label: str, main: bool = False, base: str = "default", **switches: Any) -> Variant:
    return Variant(f"angular {label}", "angular", base, switches, main)


SPECTRUM = (
    _spectrum("paper", main=True, base="paper"),
    _spectrum("paper, relative noise", main=True, base="paper", noise="relative", sigma=0.02),
    _spectrum("default", main=True),
    _spectrum("constant penalised", penalize_constant=True),
    _spectrum("band-limit undone", undo_prefilter=True),
    _spectrum("no occlusion", occluded=False),
    _spectrum("no albedo", albedo=False),
    _spectrum("roughness and Ks only", parameters="specular"),
    _spectrum("roughness and Ks only, uniform Ks", parameters="specular", spacing="uniform"),
    _spectrum("channels joint", channels="joint"),
    _spectrum("channels summed", channels="sum"),
    _spectrum("least of three channels", channels="minimum"),
    _spectrum("unknown noise", noise="marginal"),
    _spectrum("half the sigma", sigma=0.002),
    _spectrum("twice the sigma", sigma=0.008),
    _spectrum("degree 4", degree=4),
    _spectrum("degree 8", degree=8),
    _spectrum("regularizer 1e-3", regularizer=1e-3),
    _spectrum("regularizer 1e-1", regularizer=1e-1),
)

ANGULAR = (
    _angular("default", main=True),
    _angular("fast", main=True, base="fast"),
    _angular("calibrated", main=True, base="calibrated"),
    _angular("as printed", base="paper"),
    _angular("fast, Fresnel: none", base="fast", fresnel="none"),
    _angular("fast, Fresnel: Schlick at theta_o", base="fast", fresnel="schlick"),
    _angular("fast, lobe: Gaussian", base="fast", lobe="gaussian"),
    _angular("fast, no off-specular shift", base="fast", off_specular=False),
    _angular("nothing occluded", occluded=False),
    _angular("all lobes looked up", cells=0),
    _angular("512 cells", cells=512),
    _angular("2048 cells", cells=2048),
    _angular("Lambert", diffuse="lambert"),
    _angular("roughness and Ks only", parameters="specular"),
    _angular("channels joint", channels="joint"),
    _angular("unknown noise", noise="marginal"),
    _angular("half the sigma", sigma=0.04),
    _angular("twice the sigma", sigma=0.16),
)

VARIANTS = SPECTRUM + ANGULAR


def available(variants: tuple[Variant, ...] = VARIANTS) -> tuple[Variant, ...]:
    """Return the variants that this version's ``estimate`` and presets know."""
    methods = get_args(get_type_hints(estimate)["method"])
    return tuple(v for v in variants if v.method in methods and _known(v))


def _known(variant: Variant) -> bool:
    try:
        _ = variant.preset
    except OptionError:
        return False
    return True
