"""Objectives with regularisers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.recovery.descent import Objective

Rule = Callable[[dict[str, Any]], Any]


def regularized(
    data: Objective, rules: Sequence[tuple[float, Rule]], fixed: dict[str, Any] | None = None
) -> Objective:
    """Return an objective with regularisers: data + sum of weight * rule(textures).

    Args:
        data: the objective of the photographs.
        rules: pairs of a weight and a function of all textures, by name.
        fixed: textures that the functions need and that are not optimised.
    """
    weights = [dr.opaque(mi.Float, weight) for weight, _ in rules]

    def objective(textures: dict[str, Any], step: int) -> Any:
        loss = data((fixed or {}) | textures, step)
        for weight, (_, rule) in zip(weights, rules, strict=True):
            loss += weight * rule((fixed or {}) | textures)
        return loss

    return objective


def each(rule: Callable[[Any], Any]) -> Rule:
    """Return a regulariser of one texture as one of all: the sum over them."""
    return lambda textures: sum(rule(texture) for texture in textures.values())
