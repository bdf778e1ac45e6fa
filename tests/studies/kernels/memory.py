"""Memory: what the allocator handed out at most, and what the README says a run takes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

MIB = 2**20
BASE_MIB, BYTES_PER_PIXEL = 200, 20
BYTES_PER_TEXEL = {"angular": 3000, "spectrum": 560}  # with their default presets


def resident_formula(method: str, pixels: int, texels: int) -> float:
    """Return the README's figure for resident memory, in MiB.

    Args:
        method: of ``estimate``.
        pixels: of all photographs.
        texels: of the charts.
    """
    return BASE_MIB + (BYTES_PER_PIXEL * pixels + BYTES_PER_TEXEL[method] * texels) / MIB


def allocated(function: Callable[[], Any]) -> float:
    """Return the most memory, in MiB, that Dr.Jit's allocator held while a function ran.

    On a GPU that of the device. What was held before counts as well.
    """
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    function()
    dr.sync_thread()
    return dr.detail.malloc_watermark(dr.backend_v(mi.Float)) / MIB
