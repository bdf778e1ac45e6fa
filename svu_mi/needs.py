"""How much memory a command takes, told from sizes before it begins.

The figures are peaks of whole processes, measured on vases of 24 to 60 photographs of 64^2 to 512^2
pixels, on grids of 64^2 to 1024^2 texels that charts nearly fill; of importing and rendering, with
up to 3000 x 2000 pixels; of exporting, with up to 2048^2 texels. What is announced is a bound:
in the tests no command is more than 10 % above it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

from svu_mi.errors import CaptureError, SvuEnvironmentError
from svu_mi.memory import address_space, free_memory, resident

Size = tuple[int, int]  # width and height


@dataclass(frozen=True)
class Cost:
    """Memory of a command at its peak, as a sum.

    Attributes:
        start: bytes of a process that works on next to nothing.
        pixel: bytes per pixel of a photograph.
        texel: bytes per texel of the grid, beyond what the model takes.
        candidate: bytes per candidate of guidance.
        film: bytes per pixel of the largest photograph, while it is rendered.
        light: bytes per pixel of the environment map; None where it is filtered (``light_bytes``).
        look: bytes per texel, photograph and cell of the light that is looked for.
    """

    start: float
    pixel: float
    texel: float = 0
    candidate: float = 0
    film: float = 0
    light: float | None = None
    look: float = 0


COSTS = {
    "entropy": Cost(430e6, 23),
    "recover": Cost(410e6, 28, 1200),
    "guide": Cost(600e6, 24, 600, 1.25e6),
    "relight": Cost(480e6, 23, texel=120),
    "report": Cost(480e6, 23),
    "view": Cost(540e6, 23),
    "check": Cost(370e6, 23),
    "compare": Cost(360e6, 20),
    "render": Cost(260e6, 45, film=100, light=66),
    "import": Cost(260e6, 64, light=66),
    "export": Cost(260e6, 0, texel=540),
    "light": Cost(350e6, 20, look=17),
}
# Bytes per texel, by preset, and by the method that has none of its own.
MODELS = {"default": 2900, "fixed": 1300, "fast": 1100, "paper": 2000, "spectrum": 560}
GRID = 100  # bytes per texel of the grid that no chart covers
# More texels than TILE are worked on tile by tile by these commands, but for power spectra: that
# takes what the model does of two tiles, AT_WORK texels each, and so many bytes of every texel on
# charts.
TILE = 2**18
ABOUT = 1.1  # times TILE, from which on it is certain that there are more: charts are told at most
LAID_OUT = {"entropy": 230, "report": 230, "view": 230, "guide": 1500, "recover": 2800}
AT_WORK = 2**15  # whose statistics take 65 MB, several times at their peak
STORED = 14  # bytes of a photograph's pixel that can lie in a file
FLAGS = 4  # bytes of those that have to be in memory all the same
READING = 25  # bytes per pixel of a photograph, while it is decoded and made smaller
AT_A_TIME = 0.25  # part of the free memory that those take which are decoded together
KEPT_NODE = 180  # bytes per pixel of an environment map
NODE = 80  # bytes per pixel of a larger one, which is averaged
KEPT_NODES = 2048 * 1025
# What to do with fewer pixels, or texels, where not ``svu import --shrink``, or ``--resolution``.
FEWER_PIXELS = {
    "render": "rendering at most {} pixels per film",
    "import": "reading photographs of at most {} pixels",
}
FEWER_TEXELS = {"export": "svu recover --resolution {}"}
SPARE = 0.45  # address space that is reserved besides, per byte of texels
ARENAS = 0.15e9, 0.13e9  # and by allocators: in all, and for every thread beyond two
START = 0.25e9  # memory of a process that has loaded everything
START_ADDRESS = 1.2e9  # and its address space
STACK = 9e6  # address space of every thread beyond two
MOST_SHRUNK = 64
GIGA = 1e9


@dataclass(frozen=True)
class Sizes:
    """How large a capture is, known before its photographs are read.

    Attributes:
        photographs: (width, height) of each, as it is kept.
        light: (width, height) of the environment map; (0, 0) for other lights.
        charts: part of the texture that the mesh's UV charts cover, in [0, 1], at most.
        lit: whether there is a light.
        stored: (width, height) of each, as it is stored.
        memory: bytes that photographs may take, before they go to a file.
        asked: whether somebody has asked for just that.
    """

    photographs: Sequence[Size]
    light: Size = (0, 0)
    charts: float = 1.0
    lit: bool = True
    stored: Sequence[Size] = ()
    memory: float = inf
    asked: bool = True


@dataclass(frozen=True)
class Need:
    """Memory that a command takes at its peak, known from sizes alone.

    Attributes:
        command: ``entropy``, ``recover``, ...: one of ``COSTS``.
        sizes: (width, height) of each photograph.
        resolution: texels, (width, height); (0, 0) without any.
        candidates: views that guidance compares.
        looks: texels times cells that the light is looked for with.
        light: (width, height) of the environment map; (0, 0) for other lights.
        model: what is estimated with: one of ``MODELS``; empty where nothing is estimated.
        charts: part of the texture that has texels, at most.
        stored: (width, height) of the files that larger photographs are read from.
        memory: bytes that photographs may take, before they go to a file.
    """

    command: str
    sizes: Sequence[Size]
    resolution: Size = (0, 0)
    candidates: int = 0
    looks: int = 0
    light: Size = (0, 0)
    model: str = "default"
    charts: float = 1.0
    stored: Sequence[Size] = ()
    memory: float = inf

    @property
    def bytes(self) -> float:
        """What the whole process takes."""
        cost, (width, height) = COSTS[self.command], self.light
        light = light_bytes(self.light) if cost.light is None else cost.light * width * height
        found = cost.candidate * self.candidates + cost.look * self.looks * len(self.sizes)
        photographs, texels = self._parts()
        return cost.start + light + photographs + max(found + texels, self._reading())

    def _reading(self) -> float:
        """Return what is needed besides while photographs are read, which are made smaller."""
        kept = max((width * height for width, height in self.sizes), default=0)
        largest = max((width * height for width, height in self.stored), default=0)
        return READING * largest * decoders(largest) if largest > kept else 0.0

    def _parts(self) -> tuple[float, float]:
        """Return what photographs and what texels take."""
        cost = COSTS[self.command]
        pixels = [width * height for width, height in self.sizes]
        photographs = cost.pixel * sum(pixels) + cost.film * max(pixels, default=0)
        if STORED * sum(pixels) > self.memory:
            photographs = FLAGS * sum(pixels)
        grid = self.resolution[0] * self.resolution[1]
        covered, model = self.charts * grid, MODELS[self.model] if self.model else 0
        texels = cost.texel * covered + (1 - self.charts) * grid * GRID
        laid_out = LAID_OUT.get(self.command)
        if laid_out is not None and self.model != "spectrum" and covered > ABOUT * TILE:
            at_work = 2 * model * AT_WORK + (1 - self.charts) * grid * GRID
            return photographs, laid_out * covered + at_work
        return photographs, texels + model * covered

    @property
    def fits(self) -> bool:
        """Whether there is that much memory, as far as anybody knows."""
        room = _room()
        return room is None or self.bytes <= room

    def sentence(self) -> str:
        """Return what is announced: "Needs up to 1.4 GB of memory, 23 are there"."""
        room = _room()
        return f"Needs up to {_giga(self.bytes)} GB of memory" + (
            "" if room is None else f", {_giga(room)} are there"
        )

    def require(self, label: str = "") -> None:
        """Refuse what takes more memory, or address space, than there is.

        Args:
            label: begins the sentence: the scene, or the folder of the photographs.

        Raises:
            CaptureError: there is less; the sentence says what needs less.
        """
        label = f"{label}: " if label else ""
        room = _room()
        if room is not None and not self.fits:
            raise CaptureError(
                f"{label}needs {_giga(self.bytes)} GB of memory, {_giga(room)} are there; "
                f"{self._less(room) or 'work on a machine with more'}."
            )
        space = address_space()
        if space is None:
            return
        most, used = space
        begun = used - resident() + ARENAS[0] + ARENAS[1] * max(_threads() - 2, 0)
        if begun + self.reserved > most:
            less = self._less(most - begun, reserved=True)
            raise CaptureError(
                f"{label}needs {_giga(begun + self.reserved)} GB of address space, ulimit -v "
                f"allows {_giga(most)}; raise it{less and f'; {less} of memory'}."
            )

    @property
    def reserved(self) -> float:
        """Bytes of address space for what is in ``bytes``."""
        return self.bytes + SPARE * self._parts()[1]

    def _less(self, room: float, reserved: bool = False) -> str:
        """Say what fits, with photographs or texels made smaller, those that take more.

        Empty if nothing does.
        """

        def fits(need: Need) -> bool:
            return (need.reserved if reserved else need.bytes) <= room

        shrink, small = 1, self
        while not fits(small) and shrink < MOST_SHRUNK and max(small.resolution) != 1:
            photographs, texels = small._parts()
            if photographs >= texels:
                shrink += 1
                sizes = [(width // shrink, height // shrink) for width, height in self.sizes]
                small = replace(small, sizes=sizes)
            else:
                width, height = small.resolution
                small = replace(small, resolution=(max(width // 2, 1), max(height // 2, 1)))
        if not fits(small):
            return ""
        return f"{' and '.join(self._words(small, shrink))} needs {_giga(small.bytes)}"

    def _words(self, small: Need, shrink: int) -> list[str]:
        """Return what to do to need no more than ``small``, of photographs so much shrunk."""
        words = []
        if shrink > 1:
            width, height = max(small.sizes, key=lambda size: size[0] * size[1])
            default = f"svu import --shrink {shrink}"
            words.append(FEWER_PIXELS.get(self.command, default).format(f"{width} x {height}"))
        if small.resolution != self.resolution:
            size = " ".join(map(str, dict.fromkeys(small.resolution)))
            words.append(FEWER_TEXELS.get(self.command, "--resolution {}").format(size))
        return words


def decoders(pixels: int) -> int:
    """Return how many photographs of so many pixels are decoded at a time."""
    free = free_memory()
    fit = _threads() if free is None else int(AT_A_TIME * free / (READING * max(pixels, 1)))
    return max(min(_threads(), fit), 1)


def light_bytes(size: Size) -> float:
    """Return what an environment map of (width, height) takes."""
    nodes = size[0] * size[1]
    return KEPT_NODE * min(nodes, KEPT_NODES) + NODE * max(nodes - KEPT_NODES, 0)


def require_start() -> None:
    """Refuse to begin where libraries cannot even be loaded: they end the process.

    Raises:
        SvuEnvironmentError: there is too little memory or address space.
    """
    room, space = _room(), address_space()
    if room is not None and room < START:
        raise SvuEnvironmentError(
            f"needs {_giga(START)} GB of memory to start, {_giga(room)} are there; end something "
            "else."
        )
    least = START_ADDRESS + STACK * max(_threads() - 2, 0)
    if space is not None and space[0] < least:
        raise SvuEnvironmentError(
            f"needs {_giga(least)} GB of address space to start, ulimit -v allows "
            f"{_giga(space[0])}; raise it."
        )


def _threads() -> int:
    """Return how many threads this process has, or will have."""
    drjit = sys.modules.get("drjit")
    if drjit is not None:
        return int(drjit.thread_count())
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _room() -> float | None:
    """Return bytes that this process may come to hold."""
    free = free_memory()
    return None if free is None else free + resident()


def _giga(size: float) -> str:
    """Write gigabytes with two digits: 0.43, 1.4, 23, 118."""
    giga = size / GIGA
    return f"{giga:.0f}" if giga >= 10 else f"{giga:.2g}"
