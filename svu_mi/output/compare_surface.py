"""The texels that two results have in common: one layout, and maps of any size read onto it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from svu_mi.capture.mesh import MeshArrays, arrays
from svu_mi.errors import CaptureError
from svu_mi.output.maps import GUTTER
from svu_mi.surface import Texels, texels
from svu_mi.surface.gutter import dilate
from svu_mi.surface.raster import rasterize

COMMON = 0.9  # part of the texels of either mesh that the other must have, too
ALIKE = 0.02  # distance between the same texel of two meshes, in parts of their size
LEAST = 1e-3  # weight of a texel below which a map says nothing about it
COINCIDENT = 1e-5  # of a mesh's extent and of the UV square: corners that close are one


@dataclass(frozen=True, kw_only=True)
class Surface:
    """T texels of a map, and what they stand for.

    It does for the functions of ``figures.py`` what ``Texels`` does.

    Attributes:
        size: (W, H) of the map.
        index: (T,) int64, flat row-major texel index (row 0 is v = 0).
        area: (T,) float64, of each texel on the surface; all 1 without a mesh.
        chart: (T,) int64, which UV chart it lies in, the largest of which is 0.
        mesh: the ``mi.Mesh``, None if nobody has given one.
    """

    size: tuple[int, int]
    index: np.ndarray
    area: np.ndarray
    chart: np.ndarray
    mesh: Any | None

    @classmethod
    def of(cls, meshes: Sequence[Any], size: tuple[int, int], names: Sequence[str]) -> Surface:
        """Lay texels out on what is one mesh, or on all of the map if there is none.

        Args:
            meshes: none, one, or two whose texels must be the same points of one object.
            size: (W, H).
            names: of what the meshes are from, for messages.

        Raises:
            CaptureError: they are of different objects, or have different UVs.
            MeshError: one cannot carry texels.
        """
        if not meshes:
            count = size[0] * size[1]
            every = np.arange(count)
            return cls(
                size=size, index=every, area=np.ones(count), chart=0 * every, mesh=None
            )
        first, *others = (texels(mesh, size) for mesh in meshes)
        for other in others:
            _require_alike(first, other, names)
        area = np.array(first.footprint, np.float64) ** 2
        label = charts_of(arrays(meshes[0]))[np.array(first.face, np.int64)]
        largest = np.argsort(-np.bincount(label, area), kind="stable")
        return cls(
            size=size, index=np.array(first.index, np.int64), area=area,
            chart=np.argsort(largest)[label], mesh=meshes[0],
        )  # fmt: skip

    @property
    def resolution(self) -> tuple[int, int]:
        """(W, H), under the name that ``Texels`` has for it."""
        return self.size

    @property
    def count(self) -> int:
        """T."""
        return len(self.index)

    def to_image(self, values: Any, fill: float = 0.0) -> np.ndarray:
        """Lay values (T,) or (T, C) out as a map (H, W) or (H, W, C)."""
        flat = np.asarray(values)
        width, height = self.size
        image = np.full((width * height, *flat.shape[1:]), fill, flat.dtype)
        image[self.index] = flat
        return image.reshape(height, width, *flat.shape[1:])

    def inside(self) -> np.ndarray:
        """Return (H, W) bool: True where there is a texel."""
        return self.to_image(np.ones(self.count, bool), False)

    def read(self, image: np.ndarray, counts: np.ndarray | None = None) -> np.ndarray:
        """Read a map of any size at the texels.

        One of another size is resampled, without what lies outside the charts.

        Args:
            image: (H', W') or (H', W', C).
            counts: (H', W') bool, what of it counts; all of it by default.

        Returns:
            (T, C) float32; NaN where nothing that counts is near.
        """
        planes = image.reshape(*image.shape[:2], -1).astype(np.float32)
        weight = np.ones(image.shape[:2], np.float32) if counts is None else counts
        height, width = weight.shape
        if (width, height) == self.size:
            kept = np.where(weight[..., None] > 0, planes, np.nan)
            return kept.reshape(-1, kept.shape[2])[self.index]
        found = _resampled(planes, weight * self._charts((width, height)), self.size)
        return found.reshape(-1, found.shape[2])[self.index]

    def near_charts(self, shape: tuple[int, int]) -> np.ndarray:
        """Return (H', W') bool: what of a map of any size is on a chart, or in its gutter."""
        inside = self._charts((shape[1], shape[0]))
        return dilate(inside, inside, GUTTER + 1)

    def _charts(self, size: tuple[int, int]) -> np.ndarray:
        """Return (H', W') bool: where a map of another size (W', H') has texels."""
        if self.mesh is None:
            return np.ones(size[::-1], bool)
        source = arrays(self.mesh)
        assert source.uvs is not None
        return rasterize(source.uvs[source.faces], size)[1].reshape(size[::-1]) > 0


def charts_of(mesh: MeshArrays) -> np.ndarray:
    """Return which UV chart every face is in, (F,) int64; vertices may be split within charts."""
    assert mesh.uvs is not None
    extent = max(float(np.ptp(mesh.positions, axis=0).max()), 1e-30)
    corner = np.concatenate([mesh.positions / extent, mesh.uvs], axis=1)
    steps = np.rint(corner / COINCIDENT).astype(np.int64)
    point = np.unique(steps, axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces]
    count = int(point.max(initial=0)) + 1
    ends = point[:, :2].ravel(), point[:, 1:].ravel()
    links = scipy.sparse.csr_array((np.ones(len(ends[0]), np.int8), ends), shape=(count, count))
    label = scipy.sparse.csgraph.connected_components(links, directed=False)[1][point[:, 0]]
    return np.asarray(np.unique(label, return_inverse=True)[1].reshape(-1), np.int64)


def _require_alike(first: Texels, second: Texels, names: Sequence[str]) -> None:
    """Refuse meshes of which equal texels are not the same point of one object."""
    index = [np.array(each.index, np.int64) for each in (first, second)]
    _, here, there = np.intersect1d(index[0], index[1], return_indices=True)
    if len(here) < COMMON * max(map(len, index)):
        raise CaptureError(
            f"{names[0]} and {names[1]} have different UV charts, so their texels are not the "
            "same; compare results of one mesh with one layout of UVs."
        )
    points = [
        np.array(each.position, np.float64).T[chosen]
        for each, chosen in ((first, here), (second, there))
    ]
    if _distance(*points) > ALIKE:
        raise CaptureError(
            f"{names[0]} and {names[1]} are of different objects: equal texels are not the same "
            "point; compare results of one mesh."
        )


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return the rms distance of points (N, 3) from others, moved, turned and scaled to fit.

    In units of the rms distance from their centre (orthogonal Procrustes problem).
    """
    first, second = (points - points.mean(axis=0) for points in (first, second))
    first, second = (points / max(np.linalg.norm(points), 1e-30) for points in (first, second))
    return float(np.sqrt(max(0.0, 1 - np.linalg.svd(first.T @ second)[1].sum() ** 2)))


def _resampled(image: np.ndarray, weight: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a map (H, W, C) in another size, by weights (H, W) of its texels; NaN without any."""
    from PIL import Image

    smaller = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    kind = Image.Resampling.BOX if smaller else Image.Resampling.BILINEAR  # means of areas

    def scaled(plane: np.ndarray) -> np.ndarray:
        picture = Image.fromarray(np.ascontiguousarray(plane, np.float32))
        return np.asarray(picture.resize(size, kind), np.float32)

    total = scaled(weight)
    kept = np.where(weight[..., None] > 0, image, 0)
    sums = np.stack([scaled(kept[..., k] * weight) for k in range(image.shape[2])], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(total[..., None] > LEAST, sums / total[..., None], np.nan)
