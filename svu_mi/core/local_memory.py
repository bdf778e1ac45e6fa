"""Local memory of Dr.Jit: per-lane arrays with variable indices, and scatters of them.

A block of k numbers is stored in k local arrays that share one index. Dr.Jit then tests once per
block whether the index is uniform (a load) or not (a gather). Groups of four numbers are stored
as Vector4f, which is three times as fast in divergent lanes.
"""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.core.arrays import fold

Block = list[Any]
"""Numbers of one block, as Dr.Jit arrays."""


def allocate(Float: type, entries: int, count: int) -> list[Any]:
    """Return uninitialised local memory for ``count`` blocks of ``entries`` numbers."""
    # No `value=`: Dr.Jit 1.5.0 turns a literal initial value into an inline memset, which
    # compiles slowly and crashes above some size.
    return [dr.alloc_local(Float, max(count, 1)) for _ in range(entries)]


def load(memory: list[Any], index: Any) -> Block:
    """Read the block at ``index``."""
    return [slot[index] for slot in memory]


def store(memory: list[Any], index: Any, block: Block) -> None:
    """Write a block at ``index``."""
    for slot, value in zip(memory, block, strict=True):
        slot[index] = value


def filled(number: int, read: Callable[[Any], Block]) -> list[Any]:
    """Return local memory with ``number`` blocks, those of ``read(index)``.

    It is filled in a loop: Dr.Jit 1.5 unrolls an initial value. The loop's end is a literal: with
    an opaque one, Dr.Jit 1.5 reuses a kernel of another size.
    """

    def fill(k: Any, memory: list[Any]) -> tuple[Any, Any]:
        store(memory, k, read(k))
        return k + 1, memory

    first = read(mi.UInt32(0))
    (memory,) = fold(0, number, fill, allocate(type(first[0]), len(first), number))
    return list(memory)


def zeros(Float: type, entries: int, number: int) -> list[Any]:
    """Return local memory with ``number`` blocks of ``entries`` zeros."""
    return filled(number, lambda _: [Float(0)] * entries)


def scatter_rows(target: Any, rows: list[list[Any]], texel: Any) -> Any:
    """Scatter rows of channels to (texel, row, channel), in the kernel that computes them."""
    values = [value for channels in rows for value in channels]
    return scatter_strided(target, values, texel * len(values), 1)


@dr.syntax
def scatter_strided(target: Any, values: list[Any], start: Any, stride: Any) -> Any:
    """Scatter value k of each lane to ``start + k * stride``, in the kernel that computes it."""
    # Outside of a symbolic loop, each scatter becomes a kernel that repeats the computation;
    # dr.concat compiles a kernel for each number of lanes.
    count, kind = len(values), type(target)
    memory = dr.alloc_local(kind, count)
    for k, value in enumerate(values):
        memory[k] = kind(value)
    k = mi.UInt32(0)
    while k < dr.opaque(mi.UInt32, count):
        dr.scatter(target, memory[k], start + k * stride)
        k += 1
    return target


QUAD = 4


def quad_count(count: int) -> int:
    """Return ceil(count / 4), the number of Vector4f for ``count`` values."""
    return -(-count // QUAD)


def padded_to_quads(count: int) -> int:
    """Return ``count`` rounded up to a multiple of 4."""
    return QUAD * quad_count(count)
