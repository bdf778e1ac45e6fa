"""Kernel times of each stage; times of the visibility pass and of its rays alone.

``trace_visibility`` projects texels, tests orientation and usable pixels, and then traces rays.
These rays are recorded and traced again alone: in the same loop over views, and as one wavefront.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from svu_mi.bench.captures import capture_in_memory
from svu_mi.bench.experiment import Record
from svu_mi.bench.timing import MILLISECOND, measure_in_turns
from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.capture import Capture
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.core.arrays import to_drjit
from svu_mi.core.progress import Progress, Stage
from svu_mi.geometry.packed_views import Views, pack_views
from svu_mi.geometry.sample_view import TexelLanes, sample_view
from svu_mi.geometry.texels import texels
from svu_mi.geometry.visibility import trace_visibility
from svu_mi.scenes import meshes

MIN_TRIANGLES = 70_000
RATIO_BAR = 0.6
NO_RAY = 2**32 - 1
SEED = 4711


class KernelProgress(Progress):
    """Progress that records the kernels of every stage, except those in inner stages.

    Attributes:
        launches: ``seconds`` in kernels, ``launched`` kernels and ``operations`` by stage.
    """

    def __init__(self) -> None:
        super().__init__()
        self.launches: dict[str, Record] = {}
        self._running: list[str] = []

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[Stage]:
        """Run a stage as ``Progress.stage``; requires the kernel history of Dr.Jit."""
        self._collect()
        self._running.append(name)
        try:
            with super().stage(name, total) as stage:
                yield stage
        finally:
            self._collect()
            self._running.pop()

    def _collect(self) -> None:
        """Count kernels launched since the last call for the innermost stage."""
        dr.sync_thread()
        history = dr.kernel_history()
        dr.kernel_history_clear()
        if self._running:
            empty = {"seconds": 0.0, "launched": 0, "operations": 0}
            totals = self.launches.setdefault(self._running[-1], empty)
            totals["seconds"] += MILLISECOND * sum(kernel["execution_time"] for kernel in history)
            totals["launched"] += len(history)
            totals["operations"] += sum(
                kernel["operation_count"]
                for kernel in history if kernel["type"] == dr.KernelType.JIT
            )  # fmt: skip


def kernels_of(function: Callable[..., Any]) -> dict[str, Record]:
    """Run a function that takes ``progress``; return its kernels by stage."""
    progress = KernelProgress()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        function(progress=progress)
    return progress.launches


# --- visibility ------------------------------------------------------------------------------


def measure_gather(capture: Capture, resolution: int, repeats: int) -> Record:
    """Compare ``trace_visibility`` with bare ``ray_test``.

    Args:
        capture: Photographs and mesh.
        resolution: Texels per side.
        repeats: Number of warm runs.

    Returns:
        Numbers of ``triangles``, ``texels``, ``views`` and ``rays``; ``ways``: times (see
        ``timing.summary``), ``rays_per_second`` and number of unoccluded rays (``free``) of
        ``survey``, ``ray_test, loop over views`` and ``ray_test, flat``; ``ratio``: rate of the
        survey over the larger rate of the other two.
    """
    layout, views = texels(capture.mesh, resolution), pack_views(capture)
    surface = TexelLanes.of(layout)
    rays = record_rays(views, surface)
    functions: dict[str, Callable[[], Any]] = {
        "survey": lambda: trace_visibility(views, surface).coverage,
        "ray_test, loop over views": lambda: _trace_in_loop(views, rays, surface.count),
        "ray_test, flat": lambda: _trace_flat(views, rays),
    }
    ways = measure_in_turns(functions, repeats)
    for name, function in functions.items():
        ways[name]["rays_per_second"] = rays.count / ways[name]["kernel"]["median"]
        ways[name]["free"] = int(np.array(function()).sum(dtype=np.int64))
    bare = max(ways[name]["rays_per_second"] for name in list(ways)[1:])
    ratio = ways["survey"]["rays_per_second"] / bare
    return {
        "triangles": int(capture.mesh.face_count()), "texels": surface.count,
        "views": views.number, "rays": rays.count, "ways": ways, "ratio": ratio,
    }  # fmt: skip


def fine_capture(views: int, film: int) -> Capture:
    """Return a capture of a vase with over MIN_TRIANGLES triangles; its images are noise.

    Args:
        views: Number of photographs, on a sphere around the vase.
        film: Pixels per side of a photograph.
    """
    points, faces, uvs = meshes.vase()
    while len(faces) < MIN_TRIANGLES:
        points, faces, attributes = trimesh.remesh.subdivide(
            points, faces, vertex_attributes={"uv": uvs}
        )
        uvs = attributes["uv"]
    mesh = capture_mesh.make_mesh("vase", capture_mesh.MeshArrays(points, faces, None, uvs))
    scene = mi.load_dict(
        {"type": "scene", "light": {"type": "constant"}, "vase": mesh}, optimize=False
    )
    rng = np.random.default_rng(SEED)
    noise = (rng.random((film, film, 3), np.float32) for _ in range(views))
    return capture_in_memory(scene, mesh, sphere_sensors(mesh, views, (film, film)), noise)


@dataclass(frozen=True)
class Rays:
    """The N visibility rays of a capture, sorted by view.

    Attributes:
        origin: Origins, (N,) Point3f.
        direction: Directions, (N,) Vector3f.
        reach: Lengths, (N,) Float.
        slot: Index of the ray of each view and texel, (V * T,) UInt32; NO_RAY without a ray.
    """

    origin: Any
    direction: Any
    reach: Any
    slot: Any

    @property
    def count(self) -> int:
        """Number of rays, N."""
        return int(dr.width(self.reach))

    def at(self, index: Any, active: Any) -> Any:
        """Return the rays at ``index``, one per lane."""
        origin = dr.gather(mi.Point3f, self.origin, index, active)
        direction = dr.gather(mi.Vector3f, self.direction, index, active)
        return mi.Ray3f(origin, direction, dr.gather(mi.Float, self.reach, index, active), 0.0, [])


class _Recorder:
    """Scene without occluders that records all rays."""

    def __init__(self) -> None:
        self.rays: list[tuple[Any, Any]] = []

    def ray_test(self, ray: Any, active: Any = True, **_: Any) -> Any:
        self.rays.append((ray, mi.Bool(active)))
        return mi.Bool(False)


def record_rays(views: Views, surface: TexelLanes) -> Rays:
    """Record the rays that ``trace_visibility`` traces."""
    parts, slots, first = [], [], 0
    for view in range(views.number):
        recorder = _Recorder()
        # A symbolic branch has no values to record.
        with dr.scoped_set_flag(dr.JitFlag.SymbolicConditionals, False):
            sample_view(replace(views, scene=recorder), surface, dr.opaque(mi.UInt32, view))
        (ray, active), = recorder.rays  # fmt: skip
        kept = np.flatnonzero(np.broadcast_to(np.array(active), surface.count))
        slot = np.full(surface.count, NO_RAY, np.uint32)
        slot[kept] = first + np.arange(len(kept))
        first += len(kept)
        slots.append(slot)
        fields = [*ray.o, *ray.d, ray.maxt]
        parts.append(np.stack([np.array(field)[kept] for field in fields]))
    columns = np.concatenate(parts, axis=1)
    return Rays(
        origin=to_drjit(mi.Point3f, columns[:3]),
        direction=to_drjit(mi.Vector3f, columns[3:6]),
        reach=to_drjit(mi.Float, columns[6]),
        slot=to_drjit(mi.UInt32, np.concatenate(slots)),
    )


def _trace_in_loop(views: Views, rays: Rays, count: int) -> Any:
    lane, stride = dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, count)

    def body(view: Any, free: Any) -> tuple[Any, Any]:
        index = dr.gather(mi.UInt32, rays.slot, view * stride + lane)
        active = index != NO_RAY
        ray = rays.at(index, active)
        reached = active & ~views.scene.ray_test(ray, coherent=True, active=active)
        return view + 1, free + dr.select(reached, mi.UInt32(1), mi.UInt32(0))

    return dr.while_loop(
        state=(mi.UInt32(0), dr.zeros(mi.UInt32, count)),
        cond=lambda view, _: view < views.count,
        body=body,
    )[1]


def _trace_flat(views: Views, rays: Rays) -> Any:
    ray = mi.Ray3f(rays.origin, rays.direction, rays.reach, 0.0, [])
    return ~views.scene.ray_test(ray)
