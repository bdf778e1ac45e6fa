"""Memory layout of per-texel values: blocks of 16 texels.

N rows of S values are stored as (ceil(S / 16), N, 16), so a packet of lanes reads few memory pages.
In an array of shape (N, S) it would read N pages, which is five times slower.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.core.local_memory import scatter_strided

BLOCK = 16


def block_size(rows: int, count: int) -> int:
    """Return the size of an array of N rows of S texels."""
    return -(-count // BLOCK) * rows * BLOCK


def texel_offset(lane: Any, rows: Any) -> Any:
    """Return the index of a texel's first value; the stride is ``BLOCK``."""
    return (lane // BLOCK) * (rows * BLOCK) + lane % BLOCK


def write_blocks(kind: Any, columns: list[Any], count: int, others: Any = ()) -> Any:
    """Write the values of all lanes to blocks; evaluate ``others`` in the same kernel."""
    target = empty_blocks(kind, len(columns), count)
    place = texel_offset(dr.arange(mi.UInt32, count), len(columns))
    target = scatter_strided(target, columns, place, mi.UInt32(BLOCK))
    dr.eval(target, others)
    return target


def empty_blocks(kind: Any, rows: int, count: int) -> Any:
    """Allocate blocks for N rows of S values; only the last block is cleared."""
    values = dr.empty(kind, block_size(rows, count))
    if count % BLOCK:
        last = dr.opaque(mi.UInt32, block_size(rows, count) - rows * BLOCK)
        place = last + dr.arange(mi.UInt32, rows * BLOCK)
        dr.scatter(values, dr.zeros(kind), place, mode=dr.ReduceMode.NoConflicts)
        dr.eval(values)
    return values


def to_blocks(kind: Any, table: np.ndarray) -> Any:
    """Convert values, (N, S), to blocks of type ``kind``."""
    padded = np.pad(table, ((0, 0), (0, -table.shape[1] % BLOCK)))
    return to_drjit(kind, np.moveaxis(padded.reshape(len(table), -1, BLOCK), 1, 0).ravel())


def from_blocks(values: Any, rows: int, count: int) -> np.ndarray:
    """Convert blocks to values, (N, S); the inverse of ``to_blocks``."""
    blocks = values.numpy().reshape(-1, rows, BLOCK)
    return np.moveaxis(blocks, 1, 0).reshape(rows, -1)[:, :count]


def gather_texels(values: Any, rows: int, lanes: Any) -> Any:
    """Return blocks with the values of the texels ``lanes`` (UInt32), in this order."""
    if not dr.width(lanes):
        return type(values)()
    place, held = _places(rows, lanes)
    result = dr.gather(type(values), values, place, held)
    dr.eval(result)
    return result


def scatter_texels(values: Any, rows: int, lanes: Any, others: Any) -> Any:
    """Return a copy with values of the texels ``lanes`` replaced (see ``gather_texels``)."""
    if not dr.width(lanes):
        return values
    place, held = _places(rows, lanes)
    result = type(values)(values)
    dr.scatter(result, others, place, held, dr.ReduceMode.NoConflicts)
    dr.eval(result)
    return result


def _places(rows: int, lanes: Any) -> tuple[Any, Any]:
    """Return source indices of all values of new blocks, and a mask that is False in padding."""
    count = dr.width(lanes)
    place, block = dr.arange(mi.UInt32, block_size(rows, count)), dr.opaque(mi.UInt32, rows * BLOCK)
    lane, row = place // block * BLOCK + place % BLOCK, place % block // BLOCK
    held = lane < dr.opaque(mi.UInt32, count)
    first = texel_offset(dr.gather(mi.UInt32, lanes, lane, held), dr.opaque(mi.UInt32, rows))
    return first + row * BLOCK, held


class BlockReader:
    """Reader of N rows of values of the texels ``lane`` (default: all)."""

    def __init__(self, values: Any, rows: int, count: int, lane: Any | None = None) -> None:
        self._values = values
        lane = dr.arange(mi.UInt32, count) if lane is None else lane
        self._start = texel_offset(lane, dr.opaque(mi.UInt32, rows))

    def read(self, row: Any) -> Any:
        """Return the values of a row for all lanes."""
        return dr.gather(type(self._values), self._values, self._start + row * BLOCK)
