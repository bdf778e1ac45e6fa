"""Texels of a UV-mapped mesh as surface points."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.capture.capture import Capture
from svu_mi.capture.mesh import MeshArrays, arrays, has_uvs, unit_vectors
from svu_mi.capture.normal_map import normal_map
from svu_mi.capture.scene import require_variant
from svu_mi.capture.uv_charts import covering_faces
from svu_mi.core.arrays import to_drjit
from svu_mi.core.validation import indices_of
from svu_mi.errors import MeshError, OptionError, ShapeError
from svu_mi.geometry.mapped_normals import mapped_normals

MAX_RESOLUTION = 16384
CHUNK = 2**19  # texels interpolated at once, at 700 bytes each
COARSEST = 1e-4  # largest rounding step of coordinates, relative to the mesh's extent


@dataclass(frozen=True, kw_only=True, repr=False)
class Texels:
    """The T texels whose centre is on the surface, sorted along a Morton curve.

    Attributes:
        resolution: Size (W, H) of the texel grid.
        index: (T,) UInt32, flat row-major texel index (row 0 is v = 0).
        face: (T,) UInt32, index of the face under the texel.
        position: (T,) Point3f, world space, strictly inside the face.
        normal: (T,) Normal3f, unit shading normal, tilted by a normal or bump map.
        geometric_normal: (T,) Normal3f, unit face normal, flipped to the shading normal's side.
        uv: (T,) Point2f, centre of the texel.
        footprint: (T,) Float, square root of the texel's area on the surface, in world units.
        sides: Two (T,) Vector3f, sides of the texel along u and v in world space.
        turns: Two (T,) Vector3f, changes of the mesh's unit normal along both sides.
        overlapping: Number of omitted texels that several faces cover.
        degenerate: Number of omitted texels whose face has no area.
        extent: Diagonal of the mesh's bounding box, in world units.
        step: Rounding step of the largest coordinate in single precision.

    Example:
        >>> texels.resolution, texels.overlapping
        ((64, 64), 0)
        >>> image = texels.to_image(texels.footprint)
        >>> image.shape
        (64, 64)
        >>> int((image > 0).sum()) == texels.count
        True
    """

    resolution: tuple[int, int]
    index: Any
    face: Any
    position: Any
    normal: Any
    geometric_normal: Any
    uv: Any
    footprint: Any
    sides: tuple[Any, Any]
    turns: tuple[Any, Any]
    overlapping: int
    degenerate: int
    extent: float
    step: float

    def __repr__(self) -> str:
        width, height = self.resolution
        return f"<Texels: {self.count} on the surface, of {width} x {height}>"

    @property
    def count(self) -> int:
        """Number of texels T."""
        return int(dr.width(self.index))

    @property
    def layout(self) -> "TexelLayout":
        """Layout of the texels in the texture, without Dr.Jit."""
        return TexelLayout(self.resolution, np.array(self.index))

    def to_image(self, values: Any, fill: float = 0.0) -> np.ndarray:
        """Convert per-texel values to an image.

        Args:
            values: (T,) or (T, C), array or tensor.
            fill: Value outside the charts.

        Returns:
            (H, W) or (H, W, C) array of the same type, row 0 at v = 0.

        Raises:
            ShapeError: The number of values is not T.
        """
        return self.layout.to_image(values, fill)

    def inside(self) -> np.ndarray:
        """Return the mask of the charts, (H, W) bool."""
        return self.layout.inside()

    def subset(self, numbers: np.ndarray) -> "Texels":
        """Return the texels of given numbers in [0, T), which may repeat."""
        chosen = indices_of(numbers, self.count, "Texels.subset()", "texel")
        values: dict[str, Any] = {
            name: getattr(self, name) for name in (
                "index", "face", "position", "normal", "geometric_normal", "uv", "footprint",
                "sides", "turns",
            )
        }  # fmt: skip
        taken = dr.gather(dict, values, to_drjit(mi.UInt32, chosen.astype(np.uint32)))
        dr.eval(taken)
        return replace(self, **taken)


@dataclass(frozen=True)
class TexelLayout:
    """Layout of T texels in a texture, without Dr.Jit, for use in any thread."""

    resolution: tuple[int, int]
    index: np.ndarray

    @property
    def count(self) -> int:
        """Number of texels T."""
        return len(self.index)

    def to_image(self, values: Any, fill: float = 0.0) -> np.ndarray:
        """Convert per-texel values to an image (see ``Texels.to_image``)."""
        flat = np.array(values)
        if flat.ndim == 0 or len(flat) != self.count:
            raise ShapeError(
                f"to_image(): expected one value for each of {self.count} texels, "
                f"got shape {flat.shape}."
            )
        width, height = self.resolution
        image = np.full((width * height, *flat.shape[1:]), fill, flat.dtype)
        image[self.index] = flat
        return image.reshape(height, width, *flat.shape[1:])

    def inside(self) -> np.ndarray:
        """Return the mask of the charts, (H, W) bool."""
        return self.to_image(np.ones(self.count, bool), False)


def texels(mesh: Any, resolution: int | tuple[int, int] = 512) -> Texels:
    """Rasterise the UV charts of a mesh into texels.

    Args:
        mesh: An ``mi.Mesh`` with UVs in the unit square, or a capture (for its ``mesh``).
        resolution: Texels per side, or (width, height).

    Raises:
        OptionError: ``mesh`` has the wrong type, or the resolution is not in [1, 16384].
        MeshError: UVs are missing, outside [0, 1] or overlapping, or no texel is covered.

    Example:
        >>> svu.texels(capture.mesh, (64, 32)).resolution
        (64, 32)
        >>> grid = svu.texels(capture, 16)
        >>> 0 < grid.count <= 256
        True
    """
    require_variant()
    width, height = size_of(resolution)
    if not (0 < width <= MAX_RESOLUTION and 0 < height <= MAX_RESOLUTION):
        raise OptionError(
            f"The texel grid must have 1 to {MAX_RESOLUTION} texels per side, "
            f"got {width} x {height}."
        )
    mesh = mesh.mesh if isinstance(mesh, Capture) else mesh
    if not isinstance(mesh, mi.Shape):
        raise OptionError(
            f"texels(): mesh must be a mesh or a capture, got a {type(mesh).__name__}; use "
            "capture.mesh."
        )
    name = f"Shape '{mesh.id()}'"
    if not mesh.is_mesh():
        raise MeshError(f"{name} is not a triangle mesh; convert it to a PLY or OBJ mesh with UVs.")
    if not has_uvs(mesh):
        raise MeshError(
            f"{name} has no UVs; load it with svu.load_capture, which unwraps it, and use "
            "capture.mesh."
        )
    source = arrays(mesh)
    if len(source.positions) and _step(source) > COARSEST * _extent(source):
        raise MeshError(
            f"{name} is {_extent(source):g} units wide, but single precision resolves only "
            f"{_step(source):g} at its position; move the scene closer to the origin."
        )
    owner, count = covering_faces(source, name, (width, height))
    overlapping = int((count > 1).sum())
    single = np.flatnonzero(count == 1)
    face_area = _face_normals(source)[1]
    flat = face_area[owner[single]] <= 0
    kept = single[~flat]
    if len(kept) == 0:
        raise MeshError(
            f"{name}: no texel centre of a {width} x {height} grid is on a chart; "
            "increase the resolution or check the UVs."
        )
    kept = kept[np.argsort(_morton(kept % width, kept // width), kind="stable")]
    made = _surface_points(source, kept, owner[kept], (width, height), overlapping, int(flat.sum()))
    layer = normal_map(mesh.bsdf())
    if layer is None:
        return made
    normal = mapped_normals(
        layer, made.normal, made.geometric_normal, made.sides, made.uv, made.resolution, name
    )
    return replace(made, normal=normal)


def _extent(source: MeshArrays) -> float:
    return float(np.linalg.norm(np.ptp(source.positions, axis=0)))


def _step(source: MeshArrays) -> float:
    return float(np.spacing(np.float32(np.abs(source.positions).max(initial=0))))


def filled_image(texels: Texels, values: np.ndarray) -> np.ndarray:
    """Convert (T, C) values to an image (H, W, C); gaps get the nearest value."""
    image: np.ndarray = texels.to_image(values)
    gaps = ~texels.inside()
    rows = scipy.ndimage.distance_transform_edt(gaps, return_distances=False, return_indices=True)
    return image[tuple(rows)]


def size_of(resolution: Any) -> tuple[int, int]:
    """Return the (width, height) that one or two Python or NumPy integers specify."""
    width, height = resolution if np.iterable(resolution) else (resolution, resolution)
    return int(width), int(height)


def _face_normals(source: MeshArrays) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals of faces by their winding, (F, 3), and areas, (F,)."""
    cross = source.crosses
    return unit_vectors(cross), np.linalg.norm(cross, axis=1) / 2


def _morton(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the Morton code: the interleaved bits of x and y."""
    code = np.zeros(x.shape, np.int64)
    for bit in range(int(max(x.max(initial=0), y.max(initial=0))).bit_length()):
        code |= ((x >> bit) & 1) << (2 * bit) | ((y >> bit) & 1) << (2 * bit + 1)
    return code


POINTS = dict(
    position=3, normal=3, geometric_normal=3, uv=2, footprint=1, along_u=3, along_v=3, turn_u=3,
    turn_v=3,
)  # fmt: skip
"""Number of components of each interpolated attribute of ``Texels``."""


def _surface_points(
    source: MeshArrays, index: np.ndarray, face: np.ndarray, resolution: tuple[int, int],
    overlapping: int, degenerate: int,
) -> Texels:  # fmt: skip
    """Interpolate the mesh at texel centres, in double precision and in chunks."""
    faces = _face_normals(source)
    points = {name: np.empty((n, len(index)), np.float32) for name, n in POINTS.items()}
    for first in range(0, len(index), CHUNK):
        span = slice(first, first + CHUNK)
        for name, values in _interpolated(source, faces, index[span], face[span], resolution):
            points[name][:, span] = values.T
    return Texels(
        resolution=resolution,
        index=to_drjit(mi.UInt32, index.astype(np.uint32)),
        face=to_drjit(mi.UInt32, face.astype(np.uint32)),
        position=to_drjit(mi.Point3f, points["position"]),
        normal=to_drjit(mi.Normal3f, points["normal"]),
        geometric_normal=to_drjit(mi.Normal3f, points["geometric_normal"]),
        uv=to_drjit(mi.Point2f, points["uv"]),
        footprint=to_drjit(mi.Float, points["footprint"][0]),
        sides=(to_drjit(mi.Vector3f, points["along_u"]), to_drjit(mi.Vector3f, points["along_v"])),
        turns=(to_drjit(mi.Vector3f, points["turn_u"]), to_drjit(mi.Vector3f, points["turn_v"])),
        overlapping=overlapping,
        degenerate=degenerate,
        extent=_extent(source),
        step=_step(source),
    )


def _interpolated(
    source: MeshArrays, faces: tuple[np.ndarray, np.ndarray], index: np.ndarray, face: np.ndarray,
    resolution: tuple[int, int],
) -> Iterator[tuple[str, np.ndarray]]:  # fmt: skip
    """Yield the name of each attribute, and its values at t texel centres, (t, components)."""
    assert source.uvs is not None
    (width, height), (normals, areas) = resolution, faces
    uv = np.stack([(index % width + 0.5) / width, (index // width + 0.5) / height], axis=-1)
    corner_uv, corner = source.uvs[source.faces[face]], source.positions[source.faces[face]]
    weights = barycentric(corner_uv, uv)
    normal = geometric = normals[face]
    of_corners = np.repeat(normal[:, None], 3, axis=1)
    if source.normals is not None:
        of_corners = source.normals[source.faces[face]]
        smooth = np.einsum("tk,tki->ti", weights, of_corners)
        length = np.linalg.norm(smooth, axis=1, keepdims=True)
        # Opposite vertex normals cancel; use the face normal instead.
        normal = np.where(length > 1e-6, smooth / np.maximum(length, 1e-6), geometric)
    side = np.sign(np.einsum("ti,ti->t", geometric, normal))
    edges = corner_uv[:, 1:] - corner_uv[:, :1]
    (a, b), (c, d) = np.moveaxis(edges, 0, 2)
    determinant = a * d - b * c
    # Position is linear in uv within a face: edges = sides of the unit square times uv edges.
    inverse = np.array([[d, -b], [-c, a]]) / determinant
    along, turn = (  # u or v, xyz
        np.einsum("ijt,tjk->tik", inverse, x[:, 1:] - x[:, :1]) for x in (corner, of_corners)
    )
    turn -= np.einsum("tik,tk,tj->tij", turn, normal, normal)
    yield "position", np.einsum("tk,tki->ti", weights, corner)
    yield "normal", normal
    yield "geometric_normal", geometric * np.where(side == 0, 1, side)[:, None]
    yield "uv", uv
    uv_area = np.abs(determinant) / 2
    yield "footprint", np.sqrt(areas[face] / (uv_area * width * height))[:, None]
    yield "along_u", along[:, 0] / width
    yield "along_v", along[:, 1] / height
    yield "turn_u", turn[:, 0] / width
    yield "turn_v", turn[:, 1] / height


def barycentric(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return barycentric coordinates (T, 3) of points in UV triangles."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = point - corners[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    second = (p[:, 0] * b[:, 1] - p[:, 1] * b[:, 0]) / area
    third = (a[:, 0] * p[:, 1] - a[:, 1] * p[:, 0]) / area
    # Rounding may put a centre on an edge outside by 1e-17; rays must start inside.
    weights = np.clip(np.stack([1 - second - third, second, third], axis=-1), 1e-6, None)
    return weights / weights.sum(axis=1, keepdims=True)
