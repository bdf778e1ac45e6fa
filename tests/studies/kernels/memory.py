"""Memory: what the allocator handed out at most, and what a run is announced to take."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.needs import Need

MIB = 2**20
MODEL_OF = {"angular": "default", "spectrum": "spectrum"}  # with their default presets


def resident_formula(method: str, pixels: int, texels: int) -> float:
    """Return what ``svu entropy`` announces of resident memory, in MiB.

    Args:
        method: of ``estimate``.
        pixels: of all photographs.
        texels: of the charts.
    """
    return Need("entropy", [(pixels, 1)], (texels, 1), model=MODEL_OF[method]).bytes / MIB


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
