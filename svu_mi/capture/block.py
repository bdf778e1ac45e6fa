"""Photographs in one block, where kernels look them up without a copy: of memory, or of a file.

What does not fit into memory lies in a file that is mapped: kernels read it as they read memory,
and the operating system keeps those parts of it that are looked at, as long as nobody else needs
the room. The file has no name, so nothing is left of it, however the process ends.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.errors import CaptureError
from svu_mi.limits import require_files
from svu_mi.memory import free_memory
from svu_mi.needs import READING, Size, decoders

SHARE = 0.5  # of the free memory that photographs take, before they go to a file
ON_DISK = Path("/var/tmp")  # what is in /tmp is memory on some systems
GIGA = 1e9
SPARE = 32  # files that are open at once: of photographs, decoders, libraries and results


def room_for_photographs(films: Sequence[Size]) -> float:
    """Return bytes of memory that photographs may take, unless somebody says otherwise: half of
    what is free, less what decoding takes.

    Args:
        films: (width, height) of their files.
    """
    free, largest = free_memory(), max((width * height for width, height in films), default=0)
    if free is None:
        return math.inf
    return max(SHARE * free - READING * largest * decoders(largest), 0)


def allocate(
    sizes: Sequence[Size], kind: Any = np.float32, channels: int = 3,
    memory: float = math.inf,
) -> list[np.ndarray]:  # fmt: skip
    """Make room for photographs, one after the other in one block.

    Args:
        sizes: V (width, height).
        kind: type of their values.
        channels: number of values per pixel.
        memory: bytes from which on they lie in a file.

    Returns:
        V arrays (H, W, channels) of zeros.

    Raises:
        CaptureError: there is no room for the file, or too many are open.
    """
    shapes = [(height, width, channels) for width, height in sizes]
    ends = np.cumsum([math.prod(shape) for shape in shapes], dtype=np.int64)
    count = int(ends[-1]) if shapes else 0
    fits = count * np.dtype(kind).itemsize <= memory
    block = np.zeros(count, kind) if fits else _in_file(count, kind)
    parts = np.split(block, ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=False)]


def _in_file(count: int, kind: Any) -> np.ndarray:
    """Make an array in a file without a name."""
    size = count * np.dtype(kind).itemsize
    folder = os.environ.get("TMPDIR") or (str(ON_DISK) if ON_DISK.is_dir() else None)
    require_files(SPARE)
    try:
        with tempfile.TemporaryFile(dir=folder, prefix="svu_") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a full disk is not noticed later on
            else:
                file.truncate(size)
            return np.frombuffer(mmap.mmap(file.fileno(), size), kind)
    except OSError as error:
        raise CaptureError(
            f"{folder or tempfile.gettempdir()}: no room for {size / GIGA:.1f} GB of photographs "
            f"({error.strerror}); set TMPDIR to a folder with more, or give --memory more."
        ) from error


def look_up_here_and_there(block: np.ndarray) -> None:
    """Tell the operating system that photographs in a file are no longer read in their order:
    what it reads ahead, some of it megabytes, would push out what is needed."""
    found = in_file(block)
    if found is not None and hasattr(mmap, "MADV_RANDOM"):
        found.memory.madvise(mmap.MADV_RANDOM)


@dataclass(frozen=True)
class InFile:
    """Where an array is in a file.

    Attributes:
        memory: the file, mapped.
        first: byte of it that the array begins with.
    """

    memory: mmap.mmap
    first: int


def in_file(block: np.ndarray) -> InFile | None:
    """Return where an array is in the file that it lies in; None for one in memory."""
    base: Any = block
    while isinstance(base, np.ndarray) and base.base is not None:
        base = base.base
    mapped = base.obj if isinstance(base, memoryview) else base
    if not isinstance(mapped, mmap.mmap):
        return None
    start = np.frombuffer(mapped, np.uint8).__array_interface__["data"][0]
    return InFile(mapped, block.__array_interface__["data"][0] - start)


def in_one_block(images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Find the block that photographs lie in, or copy them into one.

    Args:
        images: V (H, W, 3) float32 arrays.

    Returns:
        (3 P,) float32, all pixels, and (V,) int64, index of each photograph's first pixel.
    """
    found = _shared(images)
    if found is not None:
        return found
    made = allocate([(image.shape[1], image.shape[0]) for image in images])
    for room, image in zip(made, images, strict=True):
        room[:] = image
    return _shared(made) or (np.empty(0, np.float32), np.empty(0, np.int64))


def laid_out(
    parts: Sequence[np.ndarray | None], starts: np.ndarray, count: int, fill: bool | int
) -> np.ndarray:
    """Return one value per pixel of all photographs: where they are, if they lie as these do.

    Args:
        parts: V (H, W) arrays, bool or uint8 as ``fill`` is; None for a photograph without.
        starts: (V,) index of each photograph's first pixel.
        count: P, number of all pixels.
        fill: what stands for None.

    Returns:
        (P,) array.
    """
    kind = np.dtype(bool if isinstance(fill, bool) else np.uint8)
    found = _in_place(parts, starts, count, kind)
    if found is not None and not _differs(found, parts, starts, fill):
        return found
    result = np.full(count, fill, kind)
    for start, part in zip(starts, parts, strict=True):
        if part is not None:
            result[start : start + part.size] = part.ravel()
    return result


def _in_place(
    parts: Sequence[np.ndarray | None], starts: np.ndarray, count: int, kind: np.dtype[Any]
) -> np.ndarray | None:
    """Return the (P,) values of the block that all parts are views of, each in its place."""
    there = [(part, int(start)) for part, start in zip(parts, starts, strict=True)
             if part is not None]  # fmt: skip
    block = there[0][0].base if there else None
    if not (isinstance(block, np.ndarray) and block.dtype == kind and block.ndim == 1):
        return None
    address = block.__array_interface__["data"][0]
    firsts = {part.__array_interface__["data"][0] - address - start for part, start in there}
    first = firsts.pop()
    alike = all(part.base is block and part.flags.c_contiguous for part, _ in there)
    if firsts or not alike or not 0 <= first <= block.size - count:
        return None
    return block[first : first + count]


def _differs(
    found: np.ndarray, parts: Sequence[np.ndarray | None], starts: np.ndarray, fill: bool | int
) -> bool:
    """Return whether something else than ``fill`` stands where a photograph has none."""
    ends = [*starts[1:], len(found)]
    return any(
        part is None and (found[start:end] != fill).any()
        for part, start, end in zip(parts, starts, ends, strict=True)
    )


def _shared(images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return what ``in_one_block`` does if the photographs lie in one array, each by itself."""
    block = images[0].base if images else None
    if block is None or not all(_is_plain(image) and image.base is block for image in images):
        return None
    if not _is_plain(block):
        return None
    sizes = np.array([image.size for image in images])
    address = block.__array_interface__["data"][0]
    starts = np.array([image.__array_interface__["data"][0] - address for image in images]) // 4
    order = np.argsort(starts)
    first, end = starts[order[0]], starts[order[-1]] + sizes[order[-1]]
    apart = (starts[order][1:] >= (starts + sizes)[order][:-1]).all()
    if not apart or ((starts - first) % 3).any():
        return None
    return block.reshape(-1)[first:end], (starts - first) // 3


def _is_plain(array: object) -> bool:
    return isinstance(array, np.ndarray) and array.dtype == np.float32 and array.flags.c_contiguous
