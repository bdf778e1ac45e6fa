"""Photographs that lie in a file, read ahead of the kernels.

A kernel that looks a pixel up waits until the disk has brought its page, one page per thread at a
time. Which pages a few texels need can be told before, without reading any; asked for all at once,
a disk brings several times as many in the same time.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.memory import free_memory
from svu_mi.visibility.observe import MIN_COSINE, Surface
from svu_mi.visibility.pixels import read_camera, taps_at
from svu_mi.visibility.views import Views

PIXEL = 12  # bytes
SHARE = 0.6  # of the free memory that is read at a time
PORTION = 2**15  # texels whose pixels are read at a time
GAP = 4  # pages that are read, too, where only they lie between others: rows of one window


@dataclass(frozen=True)
class Pages:
    """Pages of a file.

    Attributes:
        first, count: (N,) int64, runs of neighbouring pages.
    """

    first: np.ndarray
    count: np.ndarray

    @staticmethod
    def of(wanted: np.ndarray) -> Pages:
        """Return the runs of (P,) bool, which pages are wanted."""
        edges = np.flatnonzero(np.diff(wanted, prepend=False, append=False))
        return Pages(edges[::2], edges[1::2] - edges[::2])

    def joined(self, gap: int) -> Pages:
        """Return the same with all gaps of so many pages closed."""
        if not len(self.first):
            return self
        end = self.first + self.count
        apart = np.flatnonzero(self.first[1:] - end[:-1] > gap)
        first = self.first[np.append(0, apart + 1)]
        return Pages(first, end[np.append(apart, len(end) - 1)] - first)

    @property
    def bytes(self) -> int:
        """How much that is."""
        return int(self.count.sum()) * mmap.PAGESIZE


def read_ahead(views: Views, surface: Surface) -> None:
    """Ask for the pixels that texels may be seen in, unless that is more than memory can hold.

    Args:
        views: photographs, in a file or not.
        surface: the texels.
    """
    if views.file is None or not hasattr(mmap, "MADV_WILLNEED"):
        return
    exact, free = pages_of(views, surface), free_memory()
    room = np.inf if free is None else SHARE * free
    # Few long reads are faster than many short ones, by more than what they read in vain.
    pages = next((p for p in (exact.joined(GAP), exact) if p.bytes <= room), None)
    if pages is None:
        return
    page = mmap.PAGESIZE
    for first, count in zip(pages.first.tolist(), pages.count.tolist(), strict=True):
        views.file.madvise(mmap.MADV_WILLNEED, first * page, count * page)


def portions(views: Views, surface: Surface) -> Iterator[Surface]:
    """Yield parts of a surface, whose pixels are read ahead if photographs lie in a file; else all
    of it at once."""
    if views.file is None or surface.count <= PORTION:
        yield surface
        return
    for first in range(0, surface.count, PORTION):
        number = min(PORTION, surface.count - first)
        part = surface.at(dr.arange(mi.UInt32, number) + dr.opaque(mi.UInt32, first))
        read_ahead(views, part)
        yield part


def pages_of(views: Views, surface: Surface) -> Pages:
    """Return the pages that hold the pixels around texels in all photographs they face."""
    assert views.file is not None
    size = -(-len(views.file) // mmap.PAGESIZE)
    wanted = dr.zeros(mi.Bool, size)
    dr.eval(wanted)

    def mark(view: Any) -> Any:
        camera = read_camera(views, view)
        direction = dr.normalize(camera.position - surface.position)
        taps = taps_at(camera, surface.position)
        needed = taps.on_film & (dr.dot(surface.normal, direction) > MIN_COSINE)
        for pixel in taps.pixels:
            for byte in (0, PIXEL - 1):
                place = (mi.UInt64(pixel) * PIXEL + byte) // mmap.PAGESIZE
                dr.scatter(wanted, mi.Bool(True), mi.UInt32(place), needed)
        return view + 1

    dr.eval(dr.while_loop((mi.UInt32(0),), lambda view: view < views.count, lambda v: (mark(v),)))
    dr.eval(wanted)
    return Pages.of(wanted.numpy())
