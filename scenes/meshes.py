"""Meshes of the scenes: +Y up, centred, radius about 1.

A mesh is a tuple (positions (N, 3), faces (F, 3), uvs (N, 2)) with float64 values. v = 0 is row 0
of a bitmap, as in Mitsuba. UVs keep a distance of MARGIN from the borders of their chart. Faces
are counter-clockwise seen from outside.
"""

from __future__ import annotations

import numpy as np

MARGIN = 0.012  # in units of the map; 3 texels at a resolution of 256
KNOT_CHARTS = 3

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]


def grid_faces(columns: int, rows: int) -> np.ndarray:
    """Return two triangles per cell of a (rows + 1) x (columns + 1) grid of vertices."""
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (i * (columns + 1) + j).ravel()
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])


def join(meshes: list[Mesh]) -> Mesh:
    """Concatenate several meshes."""
    starts = np.cumsum([0] + [len(positions) for positions, _, _ in meshes[:-1]])
    return (
        np.concatenate([m[0] for m in meshes]),
        np.concatenate([m[1] + start for m, start in zip(meshes, starts, strict=True)]),
        np.concatenate([m[2] for m in meshes]),
    )


def sheet(surface: np.ndarray, low: tuple[float, float], high: tuple[float, float]) -> Mesh:
    """Convert a (rows + 1, columns + 1, 3) grid of points to a mesh with one chart.

    v increases with the row, u with the column. ``low`` and ``high`` are corners of the chart.
    """
    rows, columns = surface.shape[0] - 1, surface.shape[1] - 1
    u = np.linspace(low[0] + MARGIN, high[0] - MARGIN, columns + 1)
    v = np.linspace(low[1] + MARGIN, high[1] - MARGIN, rows + 1)
    uv = np.stack(np.meshgrid(u, v), axis=-1)
    faces = grid_faces(columns, rows)
    points = surface.reshape(-1, 3)
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return points, faces[area > 1e-12], uv.reshape(-1, 2)


def planes() -> Mesh:
    """Return two upright squares that face +Z, with charts in the left and right half."""
    x = np.linspace(-0.95, -0.05, 17)
    y = np.linspace(0.45, -0.45, 17)
    left = np.stack([*np.meshgrid(x, y), np.zeros((17, 17))], axis=-1)
    return join([
        sheet(left, (0, 0), (0.5, 1)),
        sheet(left + [1.0, 0, 0], (0.5, 0), (1, 1)),
    ])  # fmt: skip


def revolve(profile: np.ndarray, columns: int) -> np.ndarray:
    """Revolve (rows + 1, 2) profile points (radius, height) around +Y."""
    angle = np.linspace(0, 2 * np.pi, columns + 1)
    radius, height = profile[:, :1], profile[:, 1:]
    y = np.broadcast_to(height, (len(profile), columns + 1))
    return np.stack([radius * np.sin(angle), y, radius * np.cos(angle)], axis=-1)


def spheres() -> Mesh:
    """Return two rows of four spheres, each with a lat-long chart, two charts per row."""
    theta = np.linspace(0, np.pi, 25)
    ball = revolve(0.23 * np.stack([np.sin(theta), np.cos(theta)], axis=-1), 48)
    parts = []
    for row in range(2):
        for column in range(4):
            index = row * 4 + column
            center = np.array([0.5 * (column - 1.5), 0.25 - 0.5 * row, 0.0])
            low = (0.5 * (index % 2), 0.25 * (index // 2))
            parts.append(sheet(ball + center, low, (low[0] + 0.5, low[1] + 0.25)))
    return join(parts)


def vase() -> Mesh:
    """Return a vase with foot, belly, neck and open mouth, inside and outside."""
    # Profile from the inner bottom up the inner wall, over the lip, and down the outer wall.
    control = np.array([
        [0.00, -0.62], [0.30, -0.60], [0.44, -0.30], [0.36, 0.10], [0.20, 0.45], [0.19, 0.66],
        [0.27, 0.86], [0.31, 0.90], [0.32, 0.86], [0.24, 0.66], [0.25, 0.45], [0.42, 0.10],
        [0.52, -0.30], [0.42, -0.66], [0.26, -0.80], [0.33, -0.90], [0.22, -0.92], [0.00, -0.90],
    ])  # fmt: skip
    return sheet(revolve(_smooth(control, 8), 96), (0, 0), (1, 1))


def knot() -> Mesh:
    """Return a tube along a (2, 3) torus knot, which occludes itself in every view.

    Each of three charts contains a third of the tube, with u along and v around it. A single chart
    would be eight times longer than wide.
    """
    rings = 86 * KNOT_CHARTS
    t = 2 * np.pi * np.arange(rings) / rings
    out = 2 + np.cos(3 * t)
    center = np.stack([out * np.cos(2 * t), out * np.sin(2 * t), 1.4 * np.sin(3 * t)], axis=-1)
    center = 0.27 * (center - (center.min(axis=0) + center.max(axis=0)) / 2)
    normal, side = _frames(center)
    angle = np.linspace(0, 2 * np.pi, 25)[:, None, None]
    tube = center + 0.17 * (np.cos(angle) * normal + np.sin(angle) * side)
    tube = np.concatenate([tube, tube[:, :1]], axis=1)
    parts = []
    for k in range(KNOT_CHARTS):
        part = tube[:, 86 * k : 86 * (k + 1) + 1]
        parts.append(sheet(part, (0, k / KNOT_CHARTS), (1, (k + 1) / KNOT_CHARTS)))
    return join(parts)


def _frames(center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return normals and binormals (N, 3) of a closed curve, with minimal twist.

    Frames are transported without twist by double reflection [Wang et al., ACM TOG 27(1), 2008].
    The angle between the last and the first frame is then distributed over the curve.
    """
    count = len(center)
    tangent = np.roll(center, -1, 0) - np.roll(center, 1, 0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = [np.cross(tangent[0], [0.0, 0.0, 1.0])]
    normal[0] /= np.linalg.norm(normal[0])
    for k in range(count):
        after = (k + 1) % count
        chord = center[after] - center[k]
        moved = normal[k] - 2 * (chord @ normal[k]) / (chord @ chord) * chord
        turned = tangent[k] - 2 * (chord @ tangent[k]) / (chord @ chord) * chord
        change = tangent[after] - turned
        normal.append(moved - 2 * (change @ moved) / (change @ change) * change)
    missing = np.arctan2(np.cross(normal[-1], normal[0]) @ tangent[0], normal[-1] @ normal[0])
    normals = np.array(normal[:-1])
    sides = np.cross(tangent, normals)
    twist = (missing * np.arange(count) / count)[:, None]
    turned_normals = np.cos(twist) * normals + np.sin(twist) * sides
    return turned_normals, np.cross(tangent, turned_normals)


def _smooth(control: np.ndarray, steps: int) -> np.ndarray:
    """Interpolate control points by a Catmull-Rom spline, with repeated ends."""
    padded = np.concatenate([control[:1], control, control[-1:]])
    t = np.arange(steps)[:, None] / steps
    pieces = []
    for p, q, r, s in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        pieces.append(
            0.5 * (2 * q + (r - p) * t + (2 * p - 5 * q + 4 * r - s) * t**2
                   + (3 * q - p - 3 * r + s) * t**3)
        )  # fmt: skip
    curve = np.concatenate([*pieces, control[-1:]])
    curve[:, 0] = np.maximum(curve[:, 0], 0)
    return curve
