"""How much memory this process can have: what is free, and what it is allowed."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

PROCESS = Path("/proc/self")
MEMINFO = Path("/proc/meminfo")
GROUPS = Path("/sys/fs/cgroup")
# Of a control group, version 2 and 1: its limit, what it uses, and how the names begin of what of
# that are files, which the kernel drops when memory is short.
GROUP_FILES = (
    ("", "memory.max", "memory.current", ""),
    ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_"),
)
DROPPED = ("inactive_file", "active_file")
_allowed: list[int] = []  # bytes that this process may take, if anybody has said so


def free_memory() -> int | None:
    """Return bytes that can still be had, all that there are at worst; None where nobody says."""
    own = [max(size - _own(), 0) for size in _allowed]
    known = [size for size in (_available(), *_group_rooms(), *own) if size is not None]
    return min(known, default=None)


def allow(size: int) -> None:
    """Let this process take so many bytes at most, as one of several that share a machine."""
    _allowed[:] = [size]


def resident() -> int:
    """Return bytes of memory that this process holds; 0 where nobody says."""
    return held("VmRSS") or 0


def _own() -> int:
    """Return bytes of memory that this process holds, other than of files."""
    anonymous = held("RssAnon")
    return resident() if anonymous is None else anonymous


def address_space() -> tuple[int, int] | None:
    """Return bytes of address space that this process may use (``ulimit -v``), and does use.

    None without a limit.
    """
    try:
        import resource  # not on Windows
    except ImportError:
        return None
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if most in (-1, resource.RLIM_INFINITY) else (most, held("VmSize") or 0)


def _available() -> int | None:
    found = _field(MEMINFO, "MemAvailable")
    if found is not None:
        return found
    with suppress(OSError, ValueError, AttributeError):  # not on Windows
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def held(name: str) -> int | None:
    """Return bytes of memory of this process, such as ``VmHWM``, the most that was resident; None
    where the system does not tell. ``getrusage`` tells no less than what the parent's peak was."""
    return _field(PROCESS / "status", name)


def _field(path: Path, name: str) -> int | None:
    """Return a number of a file such as ``/proc/meminfo``, in bytes."""
    with suppress(OSError, ValueError, IndexError):
        for line in path.read_text().splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) * 1024
    return None


def _group_rooms() -> list[int | None]:
    """Return what each control group around this process still allows."""
    rooms = []
    for place in _groups():
        kind, group = place
        folder = GROUPS / GROUP_FILES[kind][0]
        # In a container the path may be that of the machine outside; its root is always there.
        for path in (folder / group, *(folder / group).parents):
            if not path.is_relative_to(folder):
                break
            rooms.append(_group_room(path, *GROUP_FILES[kind][1:]))
    return rooms


def _groups() -> set[tuple[int, str]]:
    """Return version (0 for the second, 1 for the first) and path of this process's groups."""
    found = {(0, ""), (1, "")}
    with suppress(OSError, ValueError):
        for line in (PROCESS / "cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if not controllers:
                found.add((0, path.lstrip("/")))
            elif "memory" in controllers.split(","):
                found.add((1, path.lstrip("/")))
    return found


def _group_room(path: Path, limit: str, usage: str, prefix: str) -> int | None:
    with suppress(OSError, ValueError):  # "max" is not a number
        most = int((path / limit).read_text())
        with suppress(OSError, ValueError):
            used = int((path / usage).read_text())
            files = (_statistic(path / "memory.stat", prefix + name) for name in DROPPED)
            return max(most - used + sum(files), 0)
        return most
    return None


def _statistic(path: Path, name: str) -> int:
    with suppress(OSError, ValueError, IndexError):
        for line in path.read_text().splitlines():
            if line.split(" ", 1)[0] == name:
                return int(line.split()[1])
    return 0
