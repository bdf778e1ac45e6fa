"""Pixels of all photographs, in one block of memory or a mapped file.

Kernels gather pixels from the block without a copy. Photographs that do not fit into memory are
mapped from a file, and the operating system caches the pages in use. The file is unnamed, so the
system removes it when the process ends, even after a crash.
"""

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
from svu_mi.core.memory import GIGA, READING, STORED, Size, decoders, free_memory
from svu_mi.errors import CaptureError

SHARE = 0.5  # fraction of the free memory for photographs; larger captures are mapped files
ON_DISK = Path("/var/tmp")  # on some systems, /tmp is in memory
SPARE = 32  # file descriptors needed in addition: photographs, decoders, libraries and results


@dataclass(frozen=True, eq=False)
class PixelBuffer:
    """The P pixels of V photographs, one photograph after the other.

    Attributes:
        pixels: (3 P,) float32, interleaved RGB.
        masked: (P,) bool, values of masks.
        clipped: (P,) uint8, bit c is set where channel c is saturated.
        sizes: V sizes (width, height).
        offsets: (V,) int64, index of the first pixel of each photograph.
        file: Mapped file that contains ``pixels``; None if they are in memory.
    """

    pixels: np.ndarray
    masked: np.ndarray
    clipped: np.ndarray
    sizes: tuple[Size, ...]
    offsets: np.ndarray
    file: mmap.mmap | None = None

    @staticmethod
    def allocate(sizes: Sequence[Size], memory: float = math.inf) -> "PixelBuffer":
        """Make a buffer of zeros; above ``memory`` bytes it is mapped from files."""
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
    def of(images: Sequence[np.ndarray]) -> "PixelBuffer":
        """Copy V photographs (H, W, 3) into memory."""
        made = PixelBuffer.allocate([(image.shape[1], image.shape[0]) for image in images])
        for own, image in zip(made.images, images, strict=True):
            own[:] = image
        return made

    @cached_property
    def images(self) -> tuple[np.ndarray, ...]:
        """Views of ``pixels``: V arrays (H, W, 3)."""
        return self._views(self.pixels, 3)

    @cached_property
    def masks(self) -> tuple[np.ndarray, ...]:
        """Views of ``masked``: V arrays (H, W)."""
        return self._views(self.masked)

    @cached_property
    def channels(self) -> tuple[np.ndarray, ...]:
        """Views of ``clipped``: V arrays (H, W)."""
        return self._views(self.clipped)

    def places(self, images: Sequence[np.ndarray]) -> list[int] | None:
        """Return each image's index in the buffer; None if one is not a view of ``pixels``."""
        numbers = {id(own): number for number, own in enumerate(self.images)}
        order = [numbers.get(id(image), -1) for image in images]
        return order if -1 not in order and len(set(order)) == len(order) else None

    def masks_at(self, places: Sequence[int], masks: Sequence[np.ndarray | None]) -> np.ndarray:
        """Return masks of the photographs ``places`` as (P,) bool; True without a mask."""
        return self._flat(self.masked, self.masks, places, masks, True)

    def channels_at(self, places: Sequence[int], bits: Sequence[np.ndarray | None]) -> np.ndarray:
        """Return bits of saturated channels of the photographs ``places`` as (P,) uint8."""
        return self._flat(self.clipped, self.channels, places, bits, 0)

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
        """Return planes as one array (P,); ``block`` itself if it contains them."""
        pairs = list(zip(places, planes, strict=True))
        if all(own[k] is plane or (plane is None and (own[k] == fill).all()) for k, plane in pairs):
            return block
        result = np.full_like(block, fill)
        for k, plane in pairs:
            if plane is not None:
                result[self.offsets[k] : self.offsets[k] + plane.size] = plane.ravel()
        return result


def room_for_photographs(films: Sequence[Size]) -> float:
    """Return the default memory limit in bytes: half of the free memory, less decoding."""
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
                os.posix_fallocate(file.fileno(), 0, size)  # later, a full disk means SIGBUS
            else:
                file.truncate(size)
            return mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise CaptureError(
            f"{folder or tempfile.gettempdir()}: no space for {size / GIGA:.1f} GB of photographs "
            f"({error.strerror}); set TMPDIR to a folder with more space, or increase --memory."
        ) from error
