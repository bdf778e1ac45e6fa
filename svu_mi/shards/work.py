"""What a worker does: load the photographs of a shard, and sum up what they say.

One task at a time: a process has one Dr.Jit. What a task has loaded and traced is kept for the
next ones of the same job; photographs that take more than their part of the memory lie in files
(``capture/block.py``).
"""

from __future__ import annotations

import os
import socket
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from threading import RLock
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture, load_capture
from svu_mi.capture.block import SHARE
from svu_mi.capture.fingerprint import scene_key
from svu_mi.errors import CaptureError, SvuWarning
from svu_mi.evidence import Wanted
from svu_mi.illumination.finding import illuminated
from svu_mi.interop import owned
from svu_mi.limits import FEWEST_THREADS
from svu_mi.memory import allow, free_memory
from svu_mi.needs import Need, Sizes
from svu_mi.npz import read_arrays, write_arrays
from svu_mi.observed import Observed
from svu_mi.shards.job import Ask, Done, Job, Task, texels_key
from svu_mi.statistics.censored import Models
from svu_mi.statistics.gather import Weighting
from svu_mi.surface import Texels, texels
from svu_mi.visibility import Surface, Survey, Views, pack_views, survey

LOG = "shards.log"  # a line per task that was begun, and ended

_lock = RLock()
_kept: dict[str, Kept] = {}


@dataclass
class Kept:
    """What a process keeps of a job.

    Attributes:
        texels: laid out once.
        shards: what was loaded, by shard.
        of_light: what was made of the light, for all shards.
        reached: what texels see of the light, by the inputs of a task, of the last ones.
    """

    texels: Texels | None = None
    shards: dict[int, Loaded] = field(default_factory=dict)
    of_light: dict[Any, Any] = field(default_factory=dict)
    reached: tuple[Path | None, dict[Any, Any]] = (None, {})


@dataclass(frozen=True)
class Loaded:
    """The photographs of a shard; ``views`` and ``found`` are None if none of them can be used."""

    capture: Capture
    views: Views | None
    found: Survey | None
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Worker:
    """Where a task runs.

    Attributes:
        address: of a worker of a cluster; empty for this process.
        threads: that it may use; 0 for as many as there are.
        memory: bytes that it may use; None for what is free.
    """

    address: str = ""
    threads: int = 0
    memory: int | None = None


def work(task: Task, worker: Worker | None = None) -> Done:
    """Make the sums of a shard, unless they are there; they are on disk when this returns.

    Raises:
        CaptureError: photographs cannot be read, or are not those that the job is about.
    """
    worker = worker or Worker()
    with _lock:
        if is_whole(task.path):
            return Done(task.shard, False, worker.address)
        _log(task, "begins")
        if worker.address:  # a process of its own: nobody else has chosen
            mi.set_variant(task.job.variant)  # noqa: TID251
            dr.set_thread_count(max(worker.threads, FEWEST_THREADS))
            if worker.memory:
                allow(worker.memory)
        loaded = _loaded(task)
        arrays = _surveyed(loaded, task.job) if task.ask.kind == "survey" else _summed(task, loaded)
        write_arrays(task.path, arrays)
        _log(task, "done")
    return Done(task.shard, True, worker.address)


def forget() -> None:
    """Give back what this process has kept of jobs."""
    with _lock:
        _kept.clear()


def is_whole(path: Path) -> bool:
    """Return whether arrays are there; what is damaged is taken away."""
    if not path.exists():
        return False
    try:
        read_arrays(path)
    except ValueError:
        path.unlink(missing_ok=True)
        return False
    return True


def _loaded(task: Task) -> Loaded:
    """Load the photographs of a shard and find out what they see, once per process."""
    job = task.job
    if job.key not in _kept:
        _kept.clear()
    kept = _kept.setdefault(job.key, Kept())
    if task.shard not in kept.shards:
        capture, notes = _read(job, task.shard)
        kept.texels = kept.texels or _laid_out(capture, job)
        views, found = None, None
        if any(capture.used):
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                views = pack_views(capture)
                found = survey(views, Surface.of(kept.texels))
            notes += _sentences(said)
        kept.shards[task.shard] = Loaded(capture, views, found, notes)
    return kept.shards[task.shard]


def _laid_out(capture: Capture, job: Job) -> Texels:
    found = texels(capture.mesh, job.resolution)
    if texels_key(found) != job.texels:
        raise CaptureError(
            f"{job.load['path']}: the texels are not of the capture's mesh; lay them out on that, "
            "in the same size."
        )
    return found


def _read(job: Job, shard: int) -> tuple[Capture, tuple[str, ...]]:
    """Read the photographs of a shard, and make sure that they are those of the job."""
    free = free_memory()
    room = None if free is None else SHARE * free / len(job.shards)

    def preflight(sizes: Sizes) -> None:
        need = Need(
            "entropy", sizes.photographs, job.resolution, light=sizes.light, charts=sizes.charts,
            stored=sizes.stored, memory=sizes.memory,
        )  # fmt: skip
        need.require(f"{job.load['path']}, shard {shard}")

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        capture = load_capture(
            **job.load, light="optional", views=job.shards[shard], preflight=preflight, memory=room
        )
        capture = capture if job.light is None else illuminated(capture, job.light)
    if scene_key(capture.scene, capture.shape) != job.scene:
        raise CaptureError(
            f"{job.load['path']}: a worker reads another scene or light than was given; give the "
            "light as a file, and files that all workers see alike."
        )
    if tuple(capture.exposures) != job.exposures:
        raise CaptureError(
            f"{job.load['path']}: the photographs' exposures were changed after they were loaded; "
            "write them into capture.json, which workers read."
        )
    return capture, _sentences(said)


def _sentences(said: list[warnings.WarningMessage]) -> tuple[str, ...]:
    return tuple(str(one.message) for one in said if issubclass(one.category, SvuWarning))


def _surveyed(loaded: Loaded, job: Job) -> dict[str, Any]:
    """Return what the views of a shard see."""
    kept = _kept[job.key]
    assert kept.texels is not None
    count, found = kept.texels.count, loaded.found
    arrays: dict[str, Any] = {
        "used": np.array(loaded.capture.used), "notes": np.array(loaded.notes, dtype=np.str_),
    }  # fmt: skip
    if found is None or loaded.views is None:
        return arrays | {
            "coverage": np.zeros(count, np.uint32), "total": np.zeros(count),
            "per_view": np.zeros(0, np.int64), "grey": True,
        }  # fmt: skip
    arrays |= {
        "coverage": found.coverage.numpy(), "total": found.total.numpy(),
        "per_view": found.per_view, "grey": loaded.views.grey,
    }  # fmt: skip
    return arrays if found.clipped is None else arrays | {"clipped": found.clipped_coverage}


def _summed(task: Task, loaded: Loaded) -> dict[str, Any]:
    """Return sums over the views of a shard; nothing, if none of them has anything to add."""
    ask, kept = task.ask, _kept[task.job.key]
    assert ask.inputs is not None and kept.texels is not None
    if loaded.views is None or loaded.found is None:
        return {}
    inputs = read_arrays(ask.inputs)
    if "models" in inputs and loaded.found.clipped is None:
        return {}
    if kept.reached[0] != ask.inputs:
        kept.reached = (ask.inputs, {})
    observed = Observed(
        capture=loaded.capture, texels=kept.texels, seen=inputs["texels"], lit_for=ask.lit_for,
        views=loaded.views, found=loaded.found, _of_light=kept.of_light, _reached=kept.reached[1],
    )  # fmt: skip
    weighting = _weighting(ask, inputs)
    if ask.kind == "rounding":
        total = observed._rounded(weighting)
        return {} if total is None else {"total": total}
    assert ask.switches is not None
    found = observed._gather(Wanted(
        roughness=np.array(ask.roughness), switches=ask.switches, channels=ask.channels,
        light_channels=ask.light_channels, weighting=weighting, texels=None,
    ))  # fmt: skip
    return {"sums": found.sums.numpy(), "counts": found.counts.numpy()}


def _weighting(ask: Ask, inputs: dict[str, np.ndarray]) -> Weighting:
    models = None
    if "models" in inputs:
        values, sigma = (owned(mi.Float, inputs[name]) for name in ("models", "sigma"))
        models = Models(values, sigma, ask.channels)
    return Weighting(ask.kappa, ask.edges, models=models)


def _log(task: Task, what: str) -> None:
    """Add a line to what all workers write: short ones stay whole."""
    stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime())
    line = f"{stamp} {socket.gethostname()} {os.getpid()} {task.path.stem} {what}\n"
    with (task.job.folder / LOG).open("a", encoding="utf-8") as log:
        log.write(line)
