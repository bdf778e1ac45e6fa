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
    _spectrum("paper, relative noise", main=True, base="paper", noise="relative", sigma=0.01),
    _spectrum("default", main=True),
    _spectrum("constant penalised", penalize_constant=True),
    _spectrum("band-limit not undone", undo_prefilter=False),
    _spectrum("uniform Ks", spacing="uniform"),
    _spectrum("channels summed", channels="sum"),
    _spectrum("least of three channels", channels="minimum"),
    _spectrum("fixed noise", noise="fixed", sigma=0.1),
    _spectrum("unknown noise", noise="marginal"),
    _spectrum("degree 4", degree=4),
    _spectrum("degree 5", degree=5),
    _spectrum("degree 8", degree=8),
    _spectrum("regularizer 1e-2", regularizer=1e-2),
    _spectrum("regularizer 1e-1", regularizer=1e-1),
)

# --- angular: ADD VARIANTS HERE -----------------------------------------------------------
ANGULAR: tuple[Variant, ...] = (
    _angular("default", main=True),
    # _angular("Schlick's Fresnel", fresnel="schlick"),
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
