"""Rasterisation of UV charts, which must be in the unit square and must not overlap.

One lane per face loops over its bounding box. Edge functions are exactly antisymmetric, and with
the top-left rule a texel centre on a shared edge belongs to one face: counts above 1 are overlaps.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.mesh import MeshArrays
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import MeshError

OVERLAP_LIMIT = 0.05  # largest fraction of overlapping texels, which are omitted
OUTSIDE_LIMIT = 1e-3  # largest fraction of faces outside the unit square
UNWRAP = "use --unwrap"
CHECKED = (256, 256)  # texels of a check


def covering_faces(
    mesh: MeshArrays, name: str, resolution: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the last face (-1: none) and the number of faces at each texel centre, (H * W,).

    Args:
        mesh: A mesh with UVs.
        name: Name of the mesh, for messages.
        resolution: (width, height) in texels.

    Raises:
        MeshError: UVs are not finite, outside of the unit square, or overlap.
    """
    assert mesh.uvs is not None
    if not np.isfinite(mesh.uvs).all():
        raise MeshError(f"{name} has UVs that are NaN or infinite; lay them out again.")
    center = mesh.uvs[mesh.faces].mean(axis=1)
    outside = ((center < -1e-6) | (center > 1 + 1e-6)).any(axis=1)
    if outside.sum() > OUTSIDE_LIMIT * len(outside):
        raise _error(
            f"{name}: {int(outside.sum())} of {len(outside)} faces have UVs outside [0, 1] "
            "(tiles or UDIMs are not supported); {}."
        )
    owner, count = rasterize(mesh.uvs[mesh.faces], resolution)
    overlapping, covered = int((count > 1).sum()), int((count > 0).sum())
    if overlapping > OVERLAP_LIMIT * covered:
        raise _error(
            f"{name} has overlapping UV charts: {overlapping} of {covered} texels are "
            "covered by several faces; {}, or lay out UVs without overlap."
        )
    return owner, count


def unusable_uvs(mesh: MeshArrays, name: str, remedy: str = UNWRAP) -> str | None:
    """Return a sentence if ``covering_faces`` refuses the UVs of a mesh, with this remedy."""
    try:
        covering_faces(mesh, name, CHECKED)
    except MeshError as error:
        return error.shell.replace(UNWRAP, remedy)
    return None


def _error(words: str) -> MeshError:
    """Return an error; ``{}`` in its text is replaced by advice on computing new UVs."""
    unwrap = words.replace("{}", "use load_capture(unwrap=True)")
    return MeshError(unwrap, shell=words.replace("{}", UNWRAP))


def rasterize(uvs: np.ndarray, resolution: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the last face (-1: none) and the number of faces at each texel centre, (H * W,)."""
    width, height = resolution
    if len(uvs) == 0:
        empty = np.zeros(width * height, np.int64)
        return empty - 1, empty
    corners = [
        (to_drjit(mi.Float64, uvs[:, k, 0] * width), to_drjit(mi.Float64, uvs[:, k, 1] * height))
        for k in range(3)
    ]
    # Face index plus one; zero means no face.
    owner = dr.zeros(mi.UInt32, width * height)
    count = dr.zeros(mi.UInt32, width * height)
    _walk(corners, dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height), owner, count)
    return (owner.numpy().astype(np.int64) - 1, count.numpy().astype(np.int64))


@dr.syntax
def _walk(corners: list[Any], width: Any, height: Any, owner: Any, count: Any) -> None:
    face = dr.arange(mi.UInt32, dr.width(corners[0][0]))
    first_x, last_x = _span([c[0] for c in corners], width)
    first_y, last_y = _span([c[1] for c in corners], height)
    sign = dr.sign(_edge(corners[0], corners[1], *corners[2]))
    x, y = mi.Int32(first_x), mi.Int32(first_y)
    active = (sign != 0) & (first_x <= last_x) & (first_y <= last_y)
    while active:
        inside = _inside(corners, sign, mi.Float64(x) + 0.5, mi.Float64(y) + 0.5)
        texel = mi.UInt32(y) * width + mi.UInt32(x)
        dr.scatter_add(count, mi.UInt32(1), texel, inside)
        dr.scatter_reduce(dr.ReduceOp.Max, owner, face + 1, texel, inside)
        x += 1
        wrap = x > last_x
        x = dr.select(wrap, first_x, x)
        y = dr.select(wrap, y + 1, y)
        active &= y <= last_y


def _span(values: list[Any], size: Any) -> tuple[Any, Any]:
    """Return first and last texel whose centre may be in a triangle."""
    low = dr.minimum(dr.minimum(values[0], values[1]), values[2])
    high = dr.maximum(dr.maximum(values[0], values[1]), values[2])
    first = dr.maximum(mi.Int32(dr.ceil(low - 0.5)), 0)
    last = dr.minimum(mi.Int32(dr.floor(high - 0.5)), mi.Int32(size) - 1)
    return first, last


def _edge(a: Any, b: Any, x: Any, y: Any) -> Any:
    """Return twice the signed area of the triangle a, b, (x, y); antisymmetric in a and b."""
    swap = (b[0] < a[0]) | ((b[0] == a[0]) & (b[1] < a[1]))
    ax, ay = dr.select(swap, b[0], a[0]), dr.select(swap, b[1], a[1])
    bx, by = dr.select(swap, a[0], b[0]), dr.select(swap, a[1], b[1])
    area = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
    return dr.select(swap, -area, area)


def _inside(corners: list[Any], sign: Any, x: Any, y: Any) -> Any:
    inside = mi.Bool(True)
    for k in range(3):
        a, b = corners[k], corners[(k + 1) % 3]
        area = sign * _edge(a, b, x, y)
        dx, dy = sign * (b[0] - a[0]), sign * (b[1] - a[1])
        # Of the two directions of an edge, exactly one is "top or left".
        top_left = (dy > 0) | ((dy == 0) & (dx < 0))
        inside &= (area > 0) | ((area == 0) & top_left)
    return inside
