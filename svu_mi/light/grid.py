"""How finely an environment emitter is sampled."""

from __future__ import annotations

import re
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.errors import SceneError, excerpt
from svu_mi.limits import require_memory
from svu_mi.needs import light_bytes

SKY_GRID = (512, 257)  # columns, rows at which a procedural sky is sampled
FINEST = 130  # columns and rows that resolve degree 64; smaller maps are sampled finer
LONGEST = 2048  # columns and rows beyond which a long and thin map is not


def label_of(emitter: Any) -> str:
    """Return an emitter's name, with that of its map if it has one."""
    file = re.search(r'filename = "(.+)"', str(emitter))
    name = f"Emitter '{emitter.id()}'"
    return name if file is None else f"{name} ({excerpt(file[1])})"


def map_of(emitter: Any, otherwise: np.ndarray) -> np.ndarray:
    """Return the pixels (H, W, 3) of an ``envmap``, and something else for other emitters."""
    if emitter.class_name() != "EnvironmentMapEmitter":
        return otherwise
    data = mi.traverse(emitter)["data"]
    pixels = data.array.numpy().reshape(data.shape)  # no copy, which data.numpy() would be
    return pixels[:, 1:-1, :3]  # Mitsuba 3.9 keeps one halo column on each side


def grid_size(emitter: Any) -> tuple[int, int]:
    """Return (columns, rows): the map's own nodes, so that quadrature sees each texel once.

    On too few nodes a constant is not orthogonal to high degrees. A small map is sampled
    between its nodes too, an odd number of times so that they stay among the samples.

    Raises:
        SceneError: the map is too large for the memory that there is.
    """
    if emitter.class_name() != "EnvironmentMapEmitter":
        return SKY_GRID
    rows, columns = mi.traverse(emitter)["data"].shape[:2]
    columns -= 2  # Mitsuba 3.9 keeps one halo column on each side
    require_memory(
        light_bytes((columns, rows)), f"{label_of(emitter)}: {columns} x {rows} pixels",
        "shrink the map; 2048 x 1024 show all that is looked up", SceneError,
    )  # fmt: skip
    finer = int(np.ceil(max(FINEST / columns, FINEST / (rows - 1))))
    across, down = (_odd(min(finer, LONGEST // side)) for side in (columns, rows))
    return columns * across, (rows - 1) * down + 1


def _odd(number: int) -> int:
    """Return the least odd number that is not below, and at least 1."""
    return max(1, number + 1 - number % 2)
