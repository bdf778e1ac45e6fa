"""Local memory: values of a lane for look-ups in loops, in blocks, and their output.

A block has one local array per position: all are read with one index, so that uniformity (load or
gather) is tested once per block. Groups of four are read and written as Vector4f, three times as
fast where lanes diverge.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

Block = list[Any]
"""The numbers of one block: Dr.Jit arrays."""


def allocate(Float: type, entries: int, count: int) -> list[Any]:
    """Return local memory for ``count`` blocks of ``entries`` numbers, not initialised."""
    # No `value=`: a literal initial value becomes an inline memset, slow to compile and,
    # above some size, a crash (Dr.Jit 1.5.0).
    return [dr.alloc_local(Float, max(count, 1)) for _ in range(entries)]


def load(memory: list[Any], index: Any) -> Block:
    """Read one block."""
    return [slot[index] for slot in memory]


def store(memory: list[Any], index: Any, block: Block) -> None:
    """Write one block."""
    for slot, value in zip(memory, block, strict=True):
        slot[index] = value


def scatter_rows(target: Any, rows: list[list[Any]], texel: Any) -> Any:
    """Write rows of channels to (texel, row, channel) memory, in the kernel that computes them."""
    values = [value for channels in rows for value in channels]
    return scatter_strided(target, values, texel * len(values), 1)


@dr.syntax
def scatter_strided(target: Any, values: list[Any], start: Any, stride: Any) -> Any:
    """Write value k of every lane to ``start + k * stride``, within the kernel that computes it."""
    # Scatters outside a symbolic loop would each become a kernel that computes all over
    # again, and dr.concat one per number of lanes.
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
    """Return ceil(count / 4), the number of Vector4f that hold ``count`` values."""
    return -(-count // QUAD)


def padded_to_quads(count: int) -> int:
    """Return ``count`` rounded up to a multiple of 4."""
    return QUAD * quad_count(count)
