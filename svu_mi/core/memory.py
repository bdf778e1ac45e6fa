"""Free memory, and estimates of the peak memory of commands.

``COSTS`` and ``MODELS`` are fitted to measured peaks of whole processes: vases with 24 to 60
photographs of 64^2 to 512^2 pixels, and grids of 64^2 to 1024^2 texels, nearly all on charts;
``SEEN`` to one with 1000 photographs of 256^2 and 2048^2 texels.
Imports and renderings had up to 3000 x 2000 pixels, exports up to 2048^2 texels. No command exceeds
its estimate in the runs of ``tests/support/announced.py``.
"""

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path, PurePosixPath

from svu_mi.errors import CaptureError, SvuEnvironmentError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

PROCESS = Path("/proc/self")
MEMINFO = Path("/proc/meminfo")
GROUPS = Path("/sys/fs/cgroup")
# Files of control groups, by folder (version 2, 1): limit, usage; and the prefix of ``DROPPED``.
GROUP_FILES = {
    "": ("memory.max", "memory.current", ""),
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_"),
}
DROPPED = ("inactive_file", "active_file")  # entries of memory.stat: pages that the kernel can drop
_allowed: list[int] = []  # limit of this process in bytes, set by ``allow``

Size = tuple[int, int]  # width and height


@dataclass(frozen=True)
class Cost:
    """Coefficients of the terms whose sum is the peak memory of a command.

    Attributes:
        start: bytes of a process with negligible input.
        pixel: bytes per pixel of all photographs.
        texel: bytes per texel on charts, in addition to ``MODELS``.
        candidate: bytes per candidate view of guidance.
        film: bytes per pixel of the largest photograph, during rendering.
        light: bytes per pixel of the environment map; None if it is prefiltered (``light_bytes``).
    """

    start: float
    pixel: float
    texel: float = 0
    candidate: float = 0
    film: float = 0
    light: float | None = None


COSTS = {
    "entropy": Cost(430e6, 23),
    "recover": Cost(410e6, 28, 1200),
    "inpaint": Cost(410e6, 28, 1200),
    "guide": Cost(600e6, 24, 600, 1.25e6),
    "relight": Cost(480e6, 23, texel=120),
    "report": Cost(480e6, 23),
    "view": Cost(540e6, 23),
    "check": Cost(620e6, 23),
    "compare": Cost(360e6, 20),
    "render": Cost(260e6, 45, film=100, light=66),
    "import": Cost(280e6, 64, light=66),
    "export": Cost(350e6, 0, texel=540),
    "light": Cost(440e6, 20),
}
# Bytes per texel, by preset, and for power spectra, which have no preset.
MODELS = {
    "default": 2900,
    "bounces": 4300,
    "fixed": 1300,
    "fast": 1100,
    "paper": 2000,
    "spectrum": 560,
}
GRID = 100  # bytes per texel outside of all charts
SEEN = 0.32  # bytes per texel and photograph, of an estimate: bits of visibility
# These commands process more than TILE texels in tiles, except with power spectra. They then take
# LAID_OUT bytes per texel on charts, and MODELS bytes per texel of two batches of AT_WORK texels.
TILE = 2**18
ABOUT = 1.1  # factor of TILE, because the chart coverage is an upper bound
LAID_OUT = {"entropy": 230, "report": 230, "view": 230, "guide": 1500, "recover": 2800,
            "inpaint": 3700}  # fmt: skip
AT_WORK = 2**15  # texels per batch; their statistics take 65 MB, and a multiple at the peak
STORED = 14  # bytes per pixel of photographs that can be moved to a file
FLAGS = 4  # bytes per pixel of photographs in a file that stay in memory
READING = 25  # bytes per pixel of a photograph that is decoded and downsampled
AT_A_TIME = 0.25  # share of the free memory for photographs that are decoded in parallel
KEPT_NODE = 180  # bytes per pixel of an environment map, up to KEPT_NODES
NODE = 80  # bytes per further pixel of a larger map, which is averaged
KEPT_NODES = 2048 * 1025
# Bytes of an estimate of the light: per sample; per sample and cell; per texel and cell; and per
# two cells, for equations while they are made, and for their inverse.
SAMPLE, PAIR, OF_TEXEL, EQUATIONS, INVERSE = 2300, 45, 60, 180, 290
PAIRS = 2**22  # pairs of samples and cells at a time
# Advice by command; for the others it is ``svu import --shrink``, and ``--resolution``.
FEWER_PIXELS = {
    "render": "rendering at most {} pixels per film",
    "import": "reading photographs of at most {} pixels",
}
FEWER_TEXELS = dict.fromkeys(("export", "inpaint"), "svu recover --resolution {}")
SPARE = 0.45  # bytes of address space that are reserved in addition, per byte of texels
ARENAS = 0.15e9, 0.13e9  # address space of allocators: constant, and per thread beyond two
START, START_ADDRESS = 0.25e9, 1.2e9  # memory and address space of a process with all libraries
STACK = 9e6  # address space of every thread beyond two
MOST_SHRUNK = 64
GIGA = 1e9


@dataclass(frozen=True)
class Sizes:
    """Sizes of a capture, known before its photographs are read.

    Attributes:
        photographs: (width, height) of each photograph in memory.
        light: (width, height) of the environment map; (0, 0) for other lights.
        charts: upper bound of the share of the texture that UV charts cover, in [0, 1].
        lit: True if the scene has a light.
        stored: (width, height) of each photograph in its file.
        memory: limit of bytes for photographs in memory; beyond it, they are kept in a file.
        asked: True if the user has set ``memory``.
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
    """Peak memory of a command, computed from sizes alone.

    Attributes:
        command: name of the command, a key of ``COSTS``.
        sizes: sizes of the capture.
        resolution: (width, height) of the texel grid; (0, 0) without one.
        model: key of ``MODELS``; empty without an estimate.
        candidates: number of candidate views of guidance.
        search: bytes for the estimate of a light (``search_bytes``).
    """

    command: str
    sizes: Sizes
    resolution: Size = (0, 0)
    model: str = ""
    candidates: int = 0
    search: float = 0

    @property
    def bytes(self) -> float:
        """Peak memory of the process in bytes."""
        cost, light = COSTS[self.command], light_bytes(self.sizes.light)
        if cost.light is not None:
            light = cost.light * _pixels(self.sizes.light)
        photographs, texels = self._parts()
        work = cost.candidate * self.candidates + self.search + texels
        return cost.start + light + photographs + max(work, self._reading())

    def _reading(self) -> float:
        """Return the bytes for decoding photographs at full size before they are downsampled."""
        kept = max(map(_pixels, self.sizes.photographs), default=0)
        largest = max(map(_pixels, self.sizes.stored), default=0)
        return READING * largest * decoders(largest) if largest > kept else 0.0

    def _parts(self) -> tuple[float, float]:
        """Return the bytes of photographs, and of texels."""
        cost, pixels = COSTS[self.command], list(map(_pixels, self.sizes.photographs))
        photographs = cost.pixel * sum(pixels) + cost.film * max(pixels, default=0)
        if STORED * sum(pixels) > self.sizes.memory:
            photographs = FLAGS * sum(pixels)
        grid, model = _pixels(self.resolution), MODELS.get(self.model, 0)
        covered, bare = self.sizes.charts * grid, (1 - self.sizes.charts) * grid * GRID
        laid_out, seen = LAID_OUT.get(self.command), SEEN * len(pixels) if model else 0
        if laid_out is not None and self.model != "spectrum" and covered > ABOUT * TILE:
            return photographs, (laid_out + seen) * covered + 2 * model * AT_WORK + bare
        return photographs, (cost.texel + model + seen) * covered + bare

    @property
    def fits(self) -> bool:
        """True if the estimate fits into the free memory, or if that is unknown."""
        return self.bytes <= _room()

    def sentence(self) -> str:
        """Return "Needs up to 1.4 GB of memory; 23 GB available"."""
        room = _room()
        there = f"; {_giga(room)} GB available" if room < inf else ""
        return f"Needs up to {_giga(self.bytes)} GB of memory{there}"

    def require(self, label: str = "") -> None:
        """Raise CaptureError if memory or address space is insufficient."""
        label = f"{label}: " if label else ""
        room = _room()
        if self.bytes > room:
            raise CaptureError(
                f"{label}needs {_giga(self.bytes)} GB of memory, {_giga(room)} GB available; "
                f"{self._advice(room) or 'use a machine with more memory'}."
            )
        most, used = address_space() or (inf, 0)
        begun = used - resident() + ARENAS[0] + ARENAS[1] * max(_threads() - 2, 0)
        needed = begun + self._reserved()
        if needed > most:
            less = self._advice(most - begun, reserved=True)
            raise CaptureError(
                f"{label}needs {_giga(needed)} GB of address space, but ulimit -v allows "
                f"{_giga(most)} GB; raise the limit{less and f'; {less} of memory'}."
            )

    def _reserved(self) -> float:
        """Return the bytes of address space for ``bytes`` of memory."""
        return self.bytes + SPARE * self._parts()[1]

    def _advice(self, room: float, reserved: bool = False) -> str:
        """Return advice on how many pixels or texels fit into ``room``; empty if none do."""
        shrink, small = 1, self
        while (small._reserved() if reserved else small.bytes) > room:
            photographs, texels = small._parts()
            if shrink == MOST_SHRUNK or max(small.resolution) == 1:
                return ""
            if photographs >= texels:
                shrink += 1
                sides = [(w // shrink, h // shrink) for w, h in self.sizes.photographs]
                small = replace(small, sizes=replace(self.sizes, photographs=sides))
            else:
                width, height = small.resolution
                small = replace(small, resolution=(max(width // 2, 1), max(height // 2, 1)))
        words = []
        if shrink > 1:
            width, height = max(small.sizes.photographs, key=_pixels)
            default = f"svu import --shrink {shrink}"
            words.append(FEWER_PIXELS.get(self.command, default).format(f"{width} x {height}"))
        if small.resolution != self.resolution:
            size = " ".join(map(str, dict.fromkeys(small.resolution)))
            words.append(FEWER_TEXELS.get(self.command, "--resolution {}").format(size))
        return f"{' and '.join(words)} needs {_giga(small.bytes)} GB"


def _pixels(size: Size) -> int:
    return size[0] * size[1]


def decoders(pixels: int) -> int:
    """Return the number of photographs of ``pixels`` pixels to decode in parallel."""
    free = free_memory()
    fit = _threads() if free is None else int(AT_A_TIME * free / (READING * max(pixels, 1)))
    return max(min(_threads(), fit), 1)


def light_bytes(size: Size) -> float:
    """Return the bytes of an environment map of (width, height) pixels."""
    nodes = _pixels(size)
    return KEPT_NODE * min(nodes, KEPT_NODES) + NODE * max(nodes - KEPT_NODES, 0)


def search_bytes(samples: int, texels: int, cells: int) -> float:
    """Return the bytes for the estimate of a light; a texel costs as much as four samples."""
    matrices = PAIR * min(samples * cells, PAIRS) + OF_TEXEL * texels * cells + EQUATIONS * cells**2
    return SAMPLE * (samples + 4 * texels) + max(matrices, INVERSE * cells**2)


def require_start() -> None:
    """Raise SvuEnvironmentError if memory is too small to load all libraries.

    A library that cannot allocate memory while it is loaded ends the process without an error.
    """
    room = _room()
    if room < START:
        raise SvuEnvironmentError(
            f"needs {_giga(START)} GB of memory to start, {_giga(room)} GB available; close other "
            "programs."
        )
    least, most = START_ADDRESS + STACK * max(_threads() - 2, 0), (address_space() or (inf,))[0]
    if most < least:
        raise SvuEnvironmentError(
            f"needs {_giga(least)} GB of address space to start, but ulimit -v allows "
            f"{_giga(most)} GB; raise the limit."
        )


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _threads() -> int:
    """Return the number of threads that this process has or will start."""
    drjit = sys.modules.get("drjit")
    return cores() if drjit is None else int(drjit.thread_count())


def _room() -> float:
    """Return the bytes that this process can hold in total; infinite if unknown."""
    free = free_memory()
    return inf if free is None else free + resident()


def _giga(size: float) -> str:
    """Format bytes as gigabytes with two digits: 0.43, 1.4, 23, 118."""
    giga = size / GIGA
    return f"{giga:.0f}" if giga >= 10 else f"{giga:.2g}"


def free_memory() -> int | None:
    """Return the free memory in bytes, within the limits of this process; None if unknown."""
    anonymous = held("RssAnon")  # without file pages
    used = resident() if anonymous is None else anonymous
    there = _field(MEMINFO, "MemAvailable", 1024)
    there = physical_memory() if there is None else there
    own = [max(size - used, 0) for size in _allowed]
    return min((size for size in (there, *_group_rooms(), *own) if size is not None), default=None)


def allow(size: int) -> None:
    """Set the memory in bytes that this process may use, its share of a machine."""
    _allowed[:] = [size]


def resident() -> int:
    """Return the resident memory of this process in bytes; 0 if unknown."""
    return held("VmRSS") or 0


def address_space() -> tuple[int, int] | None:
    """Return (limit, use) of the address space in bytes; None without ``ulimit -v``."""
    if resource is None:
        return None
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if most in (-1, resource.RLIM_INFINITY) else (most, held("VmSize") or 0)


def held(name: str) -> int | None:
    """Return a field of ``/proc/self/status``, such as ``VmHWM`` (peak), in bytes; or None.

    Unlike ``getrusage``, it excludes the peak of the parent process.
    """
    return _field(PROCESS / "status", name, 1024)


def physical_memory() -> int | None:
    """Return the main memory of the machine in bytes; None if the system does not provide it."""
    with suppress(OSError, ValueError, AttributeError):  # not on Windows
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _field(path: Path, name: str, unit: int = 1) -> int | None:
    """Return a number from a file of names and values, such as ``/proc/meminfo``."""
    with suppress(OSError, ValueError, IndexError):
        for line in path.read_text().splitlines():
            words = line.replace(":", " ").split()
            if words[:1] == [name]:
                return int(words[1]) * unit
    return None


def _group_rooms() -> list[int | None]:
    """Return the free bytes of each control group that contains this process."""
    lines = []
    with suppress(OSError):
        lines = (PROCESS / "cgroup").read_text().splitlines()
    rooms = []
    # In a container, the path may be the host's; the root group always exists.
    for line in ["0::/", "0:memory:/", *lines]:
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        kind = "memory" if "memory" in controllers.split(",") else controllers
        if kind in GROUP_FILES:
            folder, group = GROUPS / kind, PurePosixPath(path.lstrip("/"))
            rooms += [
                _group_room(folder / each, *GROUP_FILES[kind]) for each in (group, *group.parents)
            ]
    return rooms


def _group_room(path: Path, limit: str, usage: str, prefix: str) -> int | None:
    try:
        most = int((path / limit).read_text())
    except (OSError, ValueError):  # "max" is not a number
        return None
    try:
        used = int((path / usage).read_text())
    except (OSError, ValueError):
        return most
    files = sum(_field(path / "memory.stat", prefix + name) or 0 for name in DROPPED)
    return max(most - used + files, 0)
