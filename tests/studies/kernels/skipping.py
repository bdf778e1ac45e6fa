"""What it saves to leave out work that a scene does not need, and that nothing else changes.

The scene: an object whose charts cover 40 % of the map, under grey light, without metal. With
all skipping it is known that metallic is 0; without, a prior on the whole grid says so, and the
entropies are compared in nats; all texels of the charts are worked on in all views, seen or not.
*Every texel* counts the rest of the map as well: without a list of the texels in charts, those
outside them cost as much (here: as their nearest inside).
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from studies.captures import in_memory
from studies.clock import WARM_UP
from svu_mi.bench.text import Bar
from svu_mi.capture import Capture
from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.poses import sphere_sensors
from svu_mi.interop import owned
from svu_mi.options import NOTHING, Skip, preset
from svu_mi.pipeline import Estimate, estimate
from svu_mi.scenes import lights, meshes
from svu_mi.surface import Texels, texels

COVERAGE = 0.4  # of the map by charts
NODES = 8
SPP = 4
SPEED_BAR, ERROR_BAR = 2.5, 1e-5
SEED = 77


@dataclass(frozen=True)
class Way:
    """One way to compute the same thing.

    Attributes:
        layout: which texels.
        skip: what is left out.
        known: parameters that are no part of the grid; by a prior on the whole grid if None.
    """

    layout: Texels
    skip: Skip
    known: dict[str, float] | None

    def run(self, capture: Capture, method: Any) -> Estimate:
        """Estimate with three colour channels."""
        prior = None
        if self.known is None:
            prior = np.zeros((NODES, NODES, NODES))
            prior[:, 0] = 1  # metallic = 0
        # Where cells are integrated, a value is not what all of its cell is.
        named = "fixed" if method == "angular" else "default"
        switches = preset(named, method=method, channels="joint")
        return estimate(
            capture, self.layout, method, switches, prior=prior, known=self.known, skip=self.skip
        )

    def nats(self, found: Estimate) -> np.ndarray:
        """Entropy of every texel that was seen, not normalised."""
        cells = NODES ** (3 if self.known is None else 2)
        seen = np.array(found.coverage) > 0
        return np.array(found.entropy, np.float64)[seen] * np.log(cells)


def measure_skipping(
    views: int, film: int, resolution: int, repeats: int, methods: tuple[str, ...]
) -> dict[str, Any]:
    """Time estimates with and without skipping, in turns.

    Args:
        views: number of photographs.
        film: pixels per side of each.
        resolution: texels per side of the map.
        repeats: runs of each that count.
        methods: of ``estimate``.

    Returns:
        ``texels`` and ``coverage`` of the map; ``rows``, by photographs and method: median
        seconds ``by_way``, ``error`` (the largest difference of normalised entropies), and
        what was ``skipped``; and ``bars``.
    """
    rows = []
    for paint in ("coloured", "grey"):
        capture = bare_capture(paint == "coloured", views, film)
        layout = texels(capture.mesh, resolution)
        for method in methods:
            rows.append({"photographs": paint, "method": method,
                         **_row(capture, layout, method, repeats)})  # fmt: skip
    return {
        "texels": layout.count,
        "coverage": layout.count / resolution**2,
        "views": views,
        "rows": rows,
        "bars": [
            *(_speed_bar(rows, way) for way in ("every texel", "nothing skipped")),
            Bar("skipping, largest change of entropy", max(row["error"] for row in rows),
                ERROR_BAR, "").record(),
        ],
    }  # fmt: skip


def _speed_bar(rows: list[dict[str, Any]], way: str) -> dict[str, Any]:
    least = min(row["by_way"][way] / row["by_way"]["skipping"] for row in rows)
    return Bar(f"skipping against '{way}', times faster", least, SPEED_BAR, "", least=True).record()


def _row(capture: Capture, layout: Texels, method: str, repeats: int) -> dict[str, Any]:
    ways = {
        "skipping": Way(layout, Skip(), {"metallic": 0.0}),
        "nothing skipped": Way(layout, NOTHING, None),
        "every texel": Way(every_texel(layout), NOTHING, None),
    }
    functions = {name: partial(way.run, capture, method) for name, way in ways.items()}
    times, results = _in_turns(functions, repeats)
    skipping, nothing = (ways[name].nats(results[name]) for name in list(ways)[:2])
    return {
        "by_way": times,
        "error": float(np.abs(skipping - nothing).max() / np.log(NODES**2)),
        "skipped": results["skipping"].skipped,
    }


def _in_turns(
    functions: Mapping[str, Callable[[], Estimate]], repeats: int
) -> tuple[dict[str, float], dict[str, Estimate]]:
    """Median seconds of each, and its result; a slow spell of the machine hits them all."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    results = {}
    for _ in range(WARM_UP + repeats):
        for name, function in functions.items():
            dr.sync_thread()
            start = time.perf_counter()
            results[name] = function()
            dr.sync_thread()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(found[WARM_UP:]) for name, found in times.items()}, results


def every_texel(layout: Texels) -> Texels:
    """Return all texels of the map: those outside the charts are the nearest ones inside."""
    slot = layout.to_image(np.arange(layout.count), -1)
    _, (row, column) = ndimage.distance_transform_edt(slot < 0, return_indices=True)
    # The layout's own first, so that results can be compared one by one.
    rest = slot[row, column][slot < 0]
    chosen = owned(mi.UInt32, np.concatenate([np.arange(layout.count), rest]).astype(np.uint32))
    fields = ("index", "face", "position", "normal", "geometric_normal", "uv", "footprint")
    values = {name: getattr(layout, name) for name in fields}
    return replace(
        layout, **{n: dr.gather(type(v), v, chosen) for n, v in values.items()},
        sides=tuple(dr.gather(type(v), v, chosen) for v in layout.sides),
    )  # fmt: skip


def bare_capture(coloured: bool, views: int, film: int) -> Capture:
    """Render a vase without metal in a grey studio, without files.

    Args:
        coloured: the base colour is, too; else all photographs are grey.
        views: number of photographs, on a sphere around it.
        film: pixels per side of each.
    """
    points, faces, uvs = meshes.vase()
    mesh = capture_mesh.MeshArrays(points, faces, None, uvs)
    covered = texels(capture_mesh.make("vase", mesh), 256).count / 256**2
    mesh = replace(mesh, uvs=uvs * min(np.sqrt(COVERAGE / covered), 1))
    sky = lights.studio().mean(axis=2, keepdims=True).repeat(3, axis=2)
    rng = np.random.default_rng(SEED)
    color = rng.uniform(0.1, 0.9, (16, 16, 3 if coloured else 1)).astype(np.float32)
    roughness = rng.uniform(0.1, 0.9, (16, 16, 1)).astype(np.float32)
    with tempfile.TemporaryDirectory(prefix="svu-skipping-") as folder:
        path = Path(folder) / "vase.ply"
        capture_mesh.make("vase", mesh).write_ply(str(path))
        scene = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "direct"},
            "light": {"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32))},
            "vase": {"type": "ply", "filename": str(path), "bsdf": {
                "type": "principled", "metallic": 0.0,
                "base_color": _texture(color), "roughness": _texture(roughness),
            }},
        }, optimize=False)  # fmt: skip
    shape = scene.shapes()[0]
    sensors = sphere_sensors(shape, views, (film, film))
    images = (
        np.array(mi.render(scene, sensor=sensor, spp=SPP, seed=seed))[..., :3]
        for seed, sensor in enumerate(sensors)
    )
    return in_memory(scene, shape, sensors, images)


def _texture(values: np.ndarray) -> dict[str, Any]:
    return {"type": "bitmap", "data": mi.TensorXf(values), "raw": True}
