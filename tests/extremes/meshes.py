"""Stability of whole estimates: meshes of any size, anywhere, and with bad faces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from oracle.rounding import U

from extremes.captures import around, ball, lamps, map_light, sphere
from extremes.cases import Axis, Case, Found, compared
from extremes.estimates import (
    RESOLUTION,
    WAYS,
    Taken,
    both,
    photographed,
    refused_run,
    same_coverage,
    same_entropy,
)
from svu_mi.capture import Capture
from svu_mi.capture.mesh import MeshArrays
from svu_mi.options import preset
from svu_mi.surface import texels


def _moved(folder: Path, start: Taken, to_world: np.ndarray) -> Capture:
    return ball(to_world=to_world).capture(folder, start().images)


def similarity(scale: float = 1.0, shift: float = 0.0) -> np.ndarray:
    """(4, 4): scale, then move by ``shift`` along a diagonal."""
    matrix = np.eye(4)
    matrix[:3, :3] *= scale
    matrix[:3, 3] = shift * np.array([1.0, -1.0, 1.0]) / np.sqrt(3)
    return matrix


def _scales(folder: Path, quick: bool) -> Iterator[Case]:
    start = photographed(folder)
    for power in (-10, 10) if quick else (-20, -10, 10, 20):  # 1e-6, 1e-3, 1e3 and 1e6
        moved = cache(partial(_moved, folder, start, similarity(2.0**power)))
        for method, named in WAYS:
            switches = preset(named, method=method)
            yield (
                f"2^{power}, {method}, {named}",
                partial(same_entropy, start, moved, method, switches),
            )
    for scale in (1e-3,) if quick else (1e-3, 1e3):
        moved = cache(partial(_moved, folder, start, similarity(scale)))
        yield from both(f"{scale:g} units", moved, quick)


def _offsets(folder: Path, quick: bool) -> Iterator[Case]:
    """Far from the origin, coordinates lose digits: texels must stay visible, or be refused."""
    start = photographed(folder)
    extent = float(np.linalg.norm([2, 2, 2]))
    for distance in (1e1, 1e3) if quick else (1e1, 1e2, 3e2, 1e3):
        moved = cache(partial(_moved, folder, start, similarity(1.0, distance * extent)))
        yield f"{distance:g} extents away, coverage", partial(same_coverage, start, moved)
        yield from both(f"{distance:g} extents away", moved, quick)
    for distance in (1e4, 1e5):
        moved = cache(partial(_moved, folder, start, similarity(1.0, distance * extent)))
        yield f"{distance:g} extents away", partial(refused_run, moved, "angular")


def spoiled(kind: str) -> MeshArrays:
    """A ball with faces added that have no area in space, or none on the UV map."""
    plain = sphere()
    first = len(plain.positions)
    if kind == "degenerate":
        # One line in space, on a part of the map that is free.
        points = np.stack([[0, 1.0 - 0.1 * k, 0] for k in range(3)])
        uvs = np.array([[0.0, 0.0], [0.005, 0.0], [0.0, 0.005]])
    else:  # a face whose three corners have one UV; inside the ball, where nobody sees it
        points = 0.1 * np.eye(3)
        uvs = np.full((3, 2), 0.5)
    assert plain.normals is not None and plain.uvs is not None
    return MeshArrays(
        np.concatenate([plain.positions, points]),
        np.concatenate([plain.faces, [[first, first + 1, first + 2]]]),
        np.concatenate([plain.normals, np.tile([0.0, 1, 0], (3, 1))]),
        np.concatenate([plain.uvs, uvs]),
    )


def _faces(folder: Path, _: bool) -> Iterator[Case]:
    start = photographed(folder)

    def of_mesh(mesh: MeshArrays) -> Capture:
        return ball(mesh=mesh).capture(folder, start().images)

    for kind in ("degenerate", "zero-area UVs"):
        taken = cache(partial(of_mesh, spoiled(kind)))
        for method, named in WAYS:
            switches = preset(named, method=method)
            yield (
                f"{kind}, {method}, {named}",
                partial(same_entropy, start, taken, method, switches),
            )
    plain = sphere()
    flat = replace(plain, positions=plain.positions * [0, 1, 0], normals=None)
    point = replace(plain, uvs=np.full((len(plain.positions), 2), 0.5))
    for name, mesh in (("all faces degenerate", flat), ("all UVs one point", point)):
        yield name, partial(refused_run, partial(of_mesh, mesh), "angular")


def _layout(folder: Path, _: bool) -> Iterator[Case]:
    for scale in (1e-6, 1e-3, 1.0, 1e3, 1e6):
        for distance in (0.0, 1e3):
            matrix = similarity(scale, distance * scale)
            yield f"{scale:g} units, {distance:g} away", partial(_positions, folder, matrix)


def _positions(folder: Path, matrix: np.ndarray) -> Found:
    """Positions of texels, as a part of the largest coordinate: of vertices, then of texels."""
    start, moved = (texels(_mesh_of(folder, m), RESOLUTION) for m in (np.eye(4), matrix))
    truth = start.position.numpy().T.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    size = np.abs(truth).max()
    return compared(moved.position.numpy().T / size, truth / size, 4 * U)


def _mesh_of(folder: Path, matrix: np.ndarray) -> Any:
    there = ball(to_world=matrix, light={"type": "constant"}, directions=around(0))
    return there.capture(folder, []).mesh


def _rotation(folder: Path, quick: bool) -> Iterator[Case]:
    """Object, light and cameras turned together: the same photographs."""
    start = photographed(folder)
    rng = np.random.default_rng(30011)
    for number in range(1 if quick else 4):
        axis, angle = rng.normal(size=3), float(rng.uniform(20, 160))
        turn = mi.ScalarTransform4f().rotate((axis / np.linalg.norm(axis)).tolist(), angle)
        matrix = np.array(turn.matrix, np.float64)

        def turned(turn: Any = turn, matrix: np.ndarray = matrix) -> Capture:
            light = map_light(lamps(), to_world=turn)
            return ball(light=light, to_world=matrix).capture(folder, start().images)

        taken = cache(turned)
        yield from both(f"turn {number}", taken, quick)
        yield f"turn {number}, coverage", partial(same_coverage, start, taken)


EXACT = "entropy with double precision from the same samples"
SAME = "entropy with that before"
AXES = (
    Axis("size of the mesh", "1e-6 to 1e6 units", SAME, _scales),
    Axis("distance from the origin", "10 to 1e3 extents; 1e4 and more are refused",
         "entropy with double precision; part of texels with other views", _offsets),
    Axis("faces", "without area in space, or on the map; nothing else (refused)", SAME, _faces),
    Axis("texels", "1e-6 to 1e6 units, 1e3 units away", "positions, of the largest coordinate",
         _layout),
    Axis("rotation", "of object, light and cameras", EXACT, _rotation),
)  # fmt: skip
