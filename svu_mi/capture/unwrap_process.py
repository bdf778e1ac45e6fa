"""Process that unwraps a mesh, which Ctrl-C can end: arguments are the input and output files."""

import sys
from collections.abc import Iterator

import numpy as np
import xatlas

MAX_CHART = 4096  # texels, for an atlas of about 1024; packing longer slivers does not end
PIECE = 3000  # faces; the time of xatlas grows faster than the number of faces


def layout(
    points: np.ndarray, faces: np.ndarray, piece: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return source vertices (N,), faces (F, 3) and UVs (N, 2) of an atlas.

    ``points`` fit a box of unit size: xatlas uses single precision and treats small triangles as
    degenerate. With ``piece``, charts do not cross the borders of pieces of so many faces.
    """
    centers = points[faces].mean(axis=1)
    pieces = list(_pieces(centers, np.arange(len(faces)), piece or len(faces)))
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    packing.max_chart_size = MAX_CHART
    used = [np.unique(faces[rows], return_inverse=True) for rows in pieces]
    for vertices, own in used:
        own = own.reshape(-1, 3).astype(np.uint32)
        atlas.add_mesh(points[vertices].astype(np.float32), own)
    atlas.generate(pack_options=packing)
    source, made, uvs, first = [], np.zeros_like(faces, dtype=np.int64), [], 0
    for number, (rows, (vertices, _)) in enumerate(zip(pieces, used, strict=True)):
        vmap, own, places = atlas.get_mesh(number)
        if len(own) != len(rows):
            return np.zeros(0, np.int64), np.zeros((0, 3), np.int64), np.zeros((0, 2))
        source.append(vertices[vmap])
        made[rows] = own.astype(np.int64) + first
        uvs.append(places.astype(np.float64))
        first += len(vmap)
    return np.concatenate(source), made, np.concatenate(uvs)


def _pieces(centers: np.ndarray, rows: np.ndarray, most: int) -> Iterator[np.ndarray]:
    """Yield sorted numbers of faces, halved along the longest axis until there are few."""
    if len(rows) <= most:
        yield np.sort(rows)
        return
    axis = np.ptp(centers[rows], axis=0).argmax()
    ordered = rows[np.argsort(centers[rows, axis], kind="stable")]
    half = len(rows) // 2
    yield from _pieces(centers, ordered[:half], most)
    yield from _pieces(centers, ordered[half:], most)


if __name__ == "__main__":
    with np.load(sys.argv[1]) as given:
        vmap, faces, uvs = layout(given["points"], given["faces"], PIECE)
    np.savez(sys.argv[2], vmap=vmap, faces=faces, uvs=uvs)
