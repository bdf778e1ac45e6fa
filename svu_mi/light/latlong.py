"""Grids of lat-long maps: directions, quadrature weights, resampling."""

import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.core.arrays import to_drjit
from svu_mi.core.memory import light_bytes
from svu_mi.core.validation import require_memory
from svu_mi.errors import SceneError, excerpt

SKY_GRID = (512, 257)  # columns and rows of a sampled procedural sky
FINEST = 130  # columns and rows that resolve degree 64; smaller maps are upsampled
LONGEST = 2048  # largest number of columns or rows after upsampling


def emitter_label(emitter: Any) -> str:
    """Return an emitter's id and file name for messages."""
    file = re.search(r'filename = "(.+)"', str(emitter))
    name = f"Emitter '{emitter.id()}'"
    return name if file is None else f"{name} ({excerpt(file[1])})"


def envmap_pixels(emitter: Any, otherwise: np.ndarray) -> np.ndarray:
    """Return pixels (H, W, 3) of an ``envmap``, or ``otherwise`` for other emitters."""
    if emitter.class_name() != "EnvironmentMapEmitter":
        return otherwise
    data = mi.traverse(emitter)["data"]
    pixels = data.array.numpy().reshape(data.shape)  # data.numpy() would copy
    return pixels[:, 1:-1, :3]  # Mitsuba 3.9 stores a halo column on each side


def grid_size(emitter: Any) -> tuple[int, int]:
    """Return (columns, rows) of the sampling grid; small maps are upsampled."""
    if emitter.class_name() != "EnvironmentMapEmitter":
        return SKY_GRID
    rows, columns = mi.traverse(emitter)["data"].shape[:2]
    columns -= 2  # Mitsuba 3.9 stores a halo column on each side
    require_memory(
        light_bytes((columns, rows)), f"{emitter_label(emitter)}: {columns} x {rows} pixels",
        "reduce the map; 2048 x 1024 pixels are sufficient", SceneError,
    )  # fmt: skip
    # Odd multiples of the map's size, so that its own nodes are sampled.
    finer = int(np.ceil(max(FINEST / columns, FINEST / (rows - 1))))
    times = (min(finer, LONGEST // side) for side in (columns, rows))
    across, down = (max(1, number + 1 - number % 2) for number in times)
    return columns * across, (rows - 1) * down + 1


MAX_SIZE = (2048, 1025)  # columns and rows; sufficient for the narrowest lobe
BAND = 2**17  # nodes sampled at once, 20 MB


def sample_emitter(emitter: Any, to_world: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """Sample an emitter at lat-long nodes; grids above ``MAX_SIZE`` are averaged."""
    across, down = min(columns, MAX_SIZE[0]), min(rows, MAX_SIZE[1])
    solid = quadrature(rows)
    flux, weight = np.zeros((down, across, 3)), np.zeros(down)
    below, around = row_weights(down, rows), column_weights(across, columns)
    height = max(BAND // columns, 1)
    for top in range(0, rows, height):
        band = slice(top, min(top + height, rows))
        local = directions(columns, rows, band)
        radiance = radiance_from(emitter, local.reshape(-1, 3) @ to_world.T).reshape(local.shape)
        if across < columns:
            turned = np.moveaxis(radiance, 1, 0)
            shared = around @ turned.reshape(columns, -1) / around.sum(axis=1)[:, None]
            radiance = np.moveaxis(shared.reshape(across, -1, 3), 0, 1)
        if down == rows:
            flux[band] = radiance
            continue
        share = below[:, band] * solid[None, band]
        flux += (share @ radiance.reshape(len(radiance), -1)).reshape(flux.shape)
        weight += share.sum(axis=1)
    return flux if down == rows else flux / weight[:, None, None]


def directions(columns: int, rows: int, band: slice = slice(None)) -> np.ndarray:
    """Return local directions (rows, columns, 3) of a lat-long grid; ``band`` selects rows."""
    theta = (np.pi * np.arange(rows) / (rows - 1))[band]
    phi = 2 * np.pi * (np.arange(columns) + 0.5) / columns
    sin, cos = np.sin(theta)[:, None], np.cos(theta)[:, None]
    y = np.broadcast_to(cos, (len(theta), columns))
    return np.stack([sin * np.sin(phi), y, -sin * np.cos(phi)], axis=-1)


def radiance_from(emitter: Any, world: np.ndarray) -> np.ndarray:
    """Return radiance (N, 3) from an emitter in world directions (N, 3)."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(world))
    si.wi = -to_drjit(mi.Vector3f, world.T.astype(np.float32))
    return np.broadcast_to(emitter.eval(si).numpy().T.astype(np.float64), world.shape).copy()


def quadrature(rows: int) -> np.ndarray:
    """Return Clenshaw-Curtis weights in cos(theta) of a grid's rows."""
    n = rows - 1
    j = np.arange(rows)
    k = np.arange(1, n // 2 + 1)
    b = np.where(2 * k == n, 1.0, 2.0)
    series = 1 - (b / (4 * k**2 - 1) * np.cos(2 * np.outer(j, k) * np.pi / n)).sum(axis=1)
    return np.where((j == 0) | (j == n), 1.0, 2.0) * series / n


def row_weights(fewer: int, rows: int) -> scipy.sparse.csr_array:
    """Return sparse weights (fewer, rows) that downsample rows."""
    return _linear_weights(np.linspace(0, fewer - 1, rows), fewer, wrap=False)


def column_weights(fewer: int, columns: int) -> scipy.sparse.csr_array:
    """Return sparse weights (fewer, columns) that downsample columns."""
    return _linear_weights((np.arange(columns) + 0.5) * fewer / columns - 0.5, fewer, wrap=True)


def _linear_weights(place: np.ndarray, count: int, wrap: bool) -> scipy.sparse.csr_array:
    """Return sparse linear weights (count, N) of N positions on ``count`` nodes."""
    first = np.floor(place).astype(int)
    part = place - first
    both = [x % count if wrap else np.minimum(x, count - 1) for x in (first, first + 1)]
    points = np.arange(len(place))
    nodes = (np.concatenate(both), np.concatenate([points, points]))
    shares = np.concatenate([1 - part, part])
    return scipy.sparse.csr_array((shares, nodes), shape=(count, len(place)))
