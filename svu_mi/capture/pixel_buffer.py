"""The pixels of all photographs of a capture, in one block of memory or of a mapped file.

Kernels look pixels up in the block without a copy. Photographs that do not fit into memory lie in a
file, of which the operating system keeps the pages in use. The file has no name, so nothing is left
of it, however the process ends.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.core.io.files import require_files
from svu_mi.core.memory import READING, STORED, Size, decoders, free_memory
from svu_mi.errors import CaptureError

SHARE = 0.5  # of the free memory that photographs take, before they go to a file
ON_DISK = Path("/var/tmp")  # what is in /tmp is memory on some systems
GIGA = 1e9
SPARE = 32  # files that are open at once: of photographs, decoders, libraries and results


@dataclass(frozen=True, eq=False)
class PixelBuffer:
    """The pixels of V photographs, one photograph after the other, P in all.

    Attributes:
        pixels: (3 P,) float32, interleaved RGB.
        masked: (P,) bool, values of masks.
        clipped: (P,) uint8, bits of saturated channels.
        sizes: V (width, height).
        offsets: (V,) int64, number of the first pixel of each photograph.
        file: that ``pixels`` are mapped from, from its first byte on; None for memory.
    """

    pixels: np.ndarray
    masked: np.ndarray
    clipped: np.ndarray
    sizes: tuple[Size, ...]
    offsets: np.ndarray
    file: mmap.mmap | None = None

    @staticmethod
    def allocate(sizes: Sequence[Size], memory: float = math.inf) -> PixelBuffer:
        """Make a buffer of zeros; beyond ``memory`` bytes of pixels, it lies in files."""
        counts = np.array([width * height for width, height in sizes], np.int64)
        count, file = int(counts.sum()), None
        parts: list[tuple[int, Any]] = [(3 * count, np.float32), (count, bool), (count, np.uint8)]
        if STORED * count <= memory:
            pixels, masked, clipped = (np.zeros(*part) for part in parts)
        else:
            files = [_unnamed_file(size * np.dtype(kind).itemsize) for size, kind in parts]
            pixels, masked, clipped = map(np.frombuffer, files, [kind for _, kind in parts])
            file = files[0]
        return PixelBuffer(pixels, masked, clipped, tuple(sizes), np.cumsum(counts) - counts, file)

    @staticmethod
    def of(images: Sequence[np.ndarray]) -> PixelBuffer:
        """Copy V photographs (H, W, 3) into memory."""
        made = PixelBuffer.allocate([(image.shape[1], image.shape[0]) for image in images])
        for own, image in zip(made.images, images, strict=True):
            own[:] = image
        return made

    @cached_property
    def images(self) -> tuple[np.ndarray, ...]:
        """V views (H, W, 3) of ``pixels``."""
        return self._views(self.pixels, 3)

    @cached_property
    def masks(self) -> tuple[np.ndarray, ...]:
        """V views (H, W) of ``masked``."""
        return self._views(self.masked)

    @cached_property
    def channels(self) -> tuple[np.ndarray, ...]:
        """V views (H, W) of ``clipped``."""
        return self._views(self.clipped)

    def places(self, images: Sequence[np.ndarray]) -> list[int] | None:
        """Return which photographs of the buffer these are; None unless they are its own views,
        each once."""
        numbers = {id(own): number for number, own in enumerate(self.images)}
        order = [numbers.get(id(image), -1) for image in images]
        return order if -1 not in order and len(set(order)) == len(order) else None

    def masks_at(self, places: Sequence[int], masks: Sequence[np.ndarray | None]) -> np.ndarray:
        """Return (P,) bool, True outside of the masks' photographs and where one has none."""
        return self._flat(self.masked, self.masks, places, masks, True)

    def channels_at(
        self, places: Sequence[int], channels: Sequence[np.ndarray | None]
    ) -> np.ndarray:
        """Return (P,) uint8, bits of saturated channels; 0 where nothing is saturated."""
        return self._flat(self.clipped, self.channels, places, channels, 0)

    def advise_random_access(self) -> None:
        """Turn off the operating system's read-ahead, which would evict pages in use."""
        if self.file is not None and hasattr(mmap, "MADV_RANDOM"):
            self.file.madvise(mmap.MADV_RANDOM)

    def _views(self, block: np.ndarray, *channels: int) -> tuple[np.ndarray, ...]:
        parts = np.split(block, math.prod(channels) * self.offsets[1:])
        shapes = ((height, width, *channels) for width, height in self.sizes)
        return tuple(part.reshape(shape) for part, shape in zip(parts, shapes, strict=False))

    def _flat(
        self, block: np.ndarray, own: Sequence[np.ndarray], places: Sequence[int],
        planes: Sequence[np.ndarray | None], fill: int,
    ) -> np.ndarray:  # fmt: skip
        """Return the planes of photographs as one array: ``block`` itself if they lie in it."""
        pairs = list(zip(places, planes, strict=True))
        if all(own[k] is plane or (plane is None and (own[k] == fill).all()) for k, plane in pairs):
            return block
        result = np.full_like(block, fill)
        for k, plane in pairs:
            if plane is not None:
                result[self.offsets[k] : self.offsets[k] + plane.size] = plane.ravel()
        return result


def room_for_photographs(films: Sequence[Size]) -> float:
    """Return the default of bytes that photographs of these sizes may take: half of the free
    memory, less what decoding takes."""
    free, largest = free_memory(), max((width * height for width, height in films), default=0)
    if free is None:
        return math.inf
    return max(SHARE * free - READING * largest * decoders(largest), 0)


def _unnamed_file(size: int) -> mmap.mmap:
    folder = os.environ.get("TMPDIR") or (str(ON_DISK) if ON_DISK.is_dir() else None)
    require_files(SPARE)
    try:
        with tempfile.TemporaryFile(dir=folder, prefix="svu_") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a full disk is not noticed later on
            else:
                file.truncate(size)
            return mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise CaptureError(
            f"{folder or tempfile.gettempdir()}: no room for {size / GIGA:.1f} GB of photographs "
            f"({error.strerror}); set TMPDIR to a folder with more, or give --memory more."
        ) from error
