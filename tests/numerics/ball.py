"""Small captures of a ball, made in memory, and what an estimate of them should be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from oracle.levels import levels as levels_of
from oracle.rounded_integrals import calibrated_entropies
from oracle.rounding import Exact, angular_entropy
from support.helpers import ball as sphere
from support.helpers import render_views

from numerics.samples import noise_of
from svu_mi.bench.captures import capture_in_memory
from svu_mi.capture.capture import Capture
from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.capture.sensors import make_sensor
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import TexelLanes, ViewSample, sample_view, sample_visible
from svu_mi.posterior.estimate import Estimate

METAL = {"metallic": 1.0, "roughness": 0.3, "base_color": 0.8}
DISTANCE = 4.0  # of a camera from the middle of the ball, in radii
FOV = 35.0


def lamps(contrast: float = 40.0, rows: int = 32, seed: int = 20260) -> np.ndarray:
    """A lat-long map (rows, 2 rows, 3): a dim sky, and five texels ``contrast`` times as bright."""
    rng = np.random.default_rng(seed)
    image = np.exp(0.3 * rng.normal(size=(rows, 2 * rows, 3)))
    place = rng.integers(4, rows - 4, 5), rng.integers(0, 2 * rows, 5)
    image[place] *= contrast
    return image.astype(np.float32)


def map_light(image: np.ndarray, scale: float = 1.0, to_world: Any = None) -> dict[str, Any]:
    """An environment map as a Mitsuba dictionary."""
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(image), "scale": scale}
    return emitter if to_world is None else {**emitter, "to_world": to_world}


def around(count: int) -> np.ndarray:
    """(count, 3) unit directions, evenly spread (Fibonacci)."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / max(count, 1), i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), z, r * np.sin(turn)], axis=-1)


@dataclass(frozen=True)
class Ball:
    """A ball, its light and where its cameras stand; ``to_world`` moves all of them.

    Attributes:
        light: dictionary of the emitter, already turned as ``to_world`` turns.
        paint: parameters of Mitsuba's ``principled``; base colour is a number or three.
        directions: (V, 3) from the ball's centre to its cameras.
        mesh: of the ball, before ``to_world``.
        to_world: (4, 4) similarity.
        size: pixels along a side of a photograph.
    """

    light: dict[str, Any]
    paint: dict[str, Any]
    directions: np.ndarray
    mesh: MeshArrays
    to_world: np.ndarray
    size: int = 24

    def capture(self, folder: Path, images: Sequence[np.ndarray] | None = None) -> Capture:
        """Load the scene and photograph it, unless photographs are given.

        Args:
            folder: for the mesh.
            images: V photographs (H, W, 3).
        """
        scene = self._scene(folder)
        sensors = tuple(self._sensor(d, k) for k, d in enumerate(self.directions))
        if images is None:
            images = render_views(scene, sensors, 16)
        return capture_in_memory(scene, scene.shapes()[0], sensors, images)

    def _scene(self, folder: Path) -> Any:
        path = folder / "ball.ply"
        linear, shift = self.to_world[:3, :3], self.to_world[:3, 3]
        unit = linear / np.cbrt(np.linalg.det(linear))
        moved = MeshArrays(
            self.mesh.positions @ linear.T + shift, self.mesh.faces,
            None if self.mesh.normals is None else self.mesh.normals @ unit.T, self.mesh.uvs,
        )  # fmt: skip
        make_mesh("ball", moved).write_ply(str(path))
        color = {"type": "rgb", "value": np.resize(self.paint["base_color"], 3).tolist()}
        bsdf = {"type": "principled", **self.paint, "base_color": color}
        return mi.load_dict(
            {"type": "scene", "integrator": {"type": "direct"}, "light": self.light,
             "ball": {"type": "ply", "filename": str(path), "bsdf": bsdf}},
            optimize=False,
        )  # fmt: skip

    def _sensor(self, direction: np.ndarray, number: int) -> Any:
        up = [0, 1, 0] if abs(direction[1]) < 0.99 else [0, 0, 1]
        pose = mi.ScalarTransform4f().look_at((DISTANCE * direction).tolist(), [0, 0, 0], up)
        scale = float(np.cbrt(np.linalg.det(self.to_world[:3, :3])))
        matrix = self.to_world @ np.array(pose.matrix, np.float64)
        matrix[:3, :3] /= scale
        reach = DISTANCE * scale
        record = {"to_world": matrix, "x_fov": FOV, "principal_point_offset": [0.0, 0.0],
                  "clip": [reach * 1e-2, reach * 1e2], "film": [self.size] * 2,
                  "crop_offset": [0, 0], "crop_size": [self.size] * 2}  # fmt: skip
        return make_sensor(record, f"view_{number:04d}")


def ball(**changes: Any) -> Ball:
    """Return a metal ball under five lamps, seen by 12 cameras; ``changes`` replace fields."""
    fields: dict[str, Any] = {"paint": METAL, "directions": around(12), "mesh": sphere(),
                              "to_world": np.eye(4)}  # fmt: skip
    if "light" not in changes:
        fields["light"] = map_light(lamps())
    return Ball(**(fields | changes))


# --- the same estimate in double precision, from samples that are kept ----------------------


def exact(estimate: Estimate, chosen: np.ndarray) -> list[Exact]:
    """What the angular entropy of chosen texels is, in double precision from single samples on.

    Args:
        estimate: the estimate, which knows its capture.
        chosen: (t,) indices of texels that are seen.
    """
    grid: Any = estimate.posterior.grid
    switches: Any = estimate.preset
    observed: Any = estimate.observed
    levels = grid.roughness_nodes
    if switches.noise == "estimated":
        levels = levels_of(switches.levels)
    model = observed.model(levels, switches, switches.colors, chosen)
    fields: list[Any] = []
    for view in range(observed.views.number):
        seen = _look(observed, model.surface, view)
        free = mi.Bool(True)
        if switches.traced and switches.occluded:
            free = _mirror(observed.views, model.surface, seen)[1]
        cosine = dr.maximum(seen.cosine, 1e-3)
        columns = model.columns(seen.direction, cosine, free, bend=seen.bend)
        radiance = as_channels(seen.radiance, model.channels)
        dr.eval(seen, radiance, columns)
        parts = np.stack([_table(level, len(chosen)) for level in columns])  # (R, C, 4, t)
        contrast = seen.contrast.numpy().astype(np.float64)
        fields.append((seen.seen.numpy(), _table([radiance], len(chosen))[0], parts, contrast))
    on, b, parts, contrast = (np.stack(column, axis=-1) for column in zip(*fields, strict=True))
    weights = np.ones(on.shape)
    if switches.noise == "estimated":
        kappa = switches.knee * observed.unit
        weights = on / (1 + (b.mean(axis=0) ** 2 + switches.edges * contrast) / kappa**2)
        noise = noise_of(estimate.posterior)[observed.lane[chosen]]
        columns = np.moveaxis(parts, (2, 3), (0, 1))  # (4, t, R, C, V)
        return calibrated_entropies(weights, *columns, np.moveaxis(b, 1, 0), noise, switches)
    result = []
    for t, seen in enumerate(on):
        e, p, q, d = np.moveaxis(parts[:, :, :, t, seen], 2, 0)
        own = weights[t, seen], e, p, q, d, b[:, t, seen]
        result.append(angular_entropy(*own, switches, grid, observed.unit))
    return result


def _look(observed: Any, surface: TexelLanes, number: int) -> ViewSample:
    """What a view shows, if its own ray says that it sees a texel."""
    view = dr.opaque(mi.UInt32, number)
    seen = sample_view(observed.views, surface, view).seen
    return sample_visible(observed.views, surface, view, seen)


def _mirror(views: Views, surface: TexelLanes, seen: ViewSample) -> tuple[Any, Any]:
    """The mirror direction, and whether nothing stands there."""
    normal = mi.Vector3f(surface.normal)
    mirror = 2 * dr.dot(normal, seen.direction) * normal - seen.direction
    origin = surface.position + surface.offset * surface.geometric_normal
    ray = mi.Ray3f(origin, mirror, dr.largest(mi.Float), 0.0, [])
    return mirror, (dr.dot(surface.geometric_normal, mirror) > 0) & ~views.scene.ray_test(ray)


def _table(rows: Any, count: int) -> np.ndarray:
    """(len(rows), len(rows[0]), count) float64 of nested lists of Floats."""
    return np.array([[np.broadcast_to(x.numpy(), count) for x in row] for row in rows], np.float64)
