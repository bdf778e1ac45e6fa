"""The estimators that are compared. The one file to edit when there is a new one."""

from __future__ import annotations

from collections.abc import Collection
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
            switches, shown as differences to ``base_of`` their label.
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

# The reference assumes the noise that ``fixed`` does: what changes the model is compared there.
ANGULAR = (
    _angular("default", main=True),
    _angular("fixed", main=True, base="fixed"),
    _angular("fast", main=True, base="fast"),
    _angular("default, channels grey", channels="grey"),
    _angular("default, any metallic alike", metals=0.0),
    _angular("default, edges count", edges=0.0),
    _angular("SH model", base="paper", main=True, errors="mean", sigma=0.08),
    _angular("fixed, looked up", base="fixed", cells=0),
    _angular("fixed, looked up, Fresnel: none", base="fixed", cells=0, fresnel="none"),
    _angular("fixed, looked up, Fresnel: Schlick at theta_o", base="fixed", cells=0,
             fresnel="schlick"),
    _angular("fixed, looked up, lobe: Gaussian", base="fixed", cells=0, lobe="gaussian"),
    _angular("fixed, looked up, no off-specular shift", base="fixed", cells=0,
             off_specular=False),
    _angular("fixed, nothing occluded", base="fixed", occluded=False),
    _angular("fixed, 512 cells", base="fixed", cells=512),
    _angular("fixed, 2048 cells", base="fixed", cells=2048),
    _angular("fixed, Lambert", base="fixed", diffuse="lambert"),
    _angular("fixed, roughness and Ks only", base="fixed", parameters="specular"),
    _angular("fixed, channels joint", base="fixed", channels="joint"),
    _angular("fixed, noise grows", base="fixed", noise="heteroscedastic", sigma=0.16),
    _angular("fixed, unknown noise", base="fixed", noise="marginal"),
    _angular("fixed, half the sigma", base="fixed", sigma=0.04),
    _angular("fixed, twice the sigma", base="fixed", sigma=0.16),
)  # fmt: skip

VARIANTS = SPECTRUM + ANGULAR


def base_of(label: str, labels: Collection[str]) -> str:
    """Return what a switch is a difference to: the variant that it is named after, up to the last
    comma, or ``default`` of its method."""
    named = label.rpartition(", ")[0]
    return named if named in labels else f"{label.split()[0]} default"


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
