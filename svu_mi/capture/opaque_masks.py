"""Removal of ``mask`` BSDFs that hide nothing, as exporters write them around each material."""

from typing import Any

import mitsuba as mi
import numpy as np


def remove_opaque_masks(state: Any) -> None:
    """Replace each ``mask`` of constant opacity 1 in a parsed scene by the BSDF within it."""
    kinds = mi.Properties.Type
    for node in reversed(state.nodes):  # children follow their parents
        mask = node.props
        if mask.plugin_name() != "mask" or not _is_opaque(mask):
            continue
        inner = [key for key in mask.keys() if mask.type(key) == kinds.ResolvedReference]  # noqa: SIM118
        if len(inner) == 1:  # otherwise Mitsuba refuses it
            bsdf = mi.Properties(state.nodes[mask[inner[0]].index()].props)
            bsdf.set_id(mask.id())
            node.props = bsdf


def _is_opaque(mask: Any) -> bool:
    kinds = mi.Properties.Type
    constant = "opacity" in mask and mask.type("opacity") in (kinds.Float, kinds.Color)
    return constant and bool(np.all(np.array(mask["opacity"], np.float64) >= 1))
