"""The texels of an object as places in space, and the connected pieces that they lie on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from svu_mi.capture.mesh import unit_vectors
from svu_mi.surface import Texels
from svu_mi.surface.neighbors import sums

APART = 1e3  # distance between pieces that are not to be mixed up, in extents of the object


@dataclass(frozen=True)
class Pieces:
    """T texels of an object.

    Attributes:
        point: (T, 3) about the middle of its bounding box, in units of its diagonal.
        normal: (T, 3) unit.
        piece: (T,) int64, which connected piece of the surface each is of.
    """

    point: np.ndarray
    normal: np.ndarray
    piece: np.ndarray

    @staticmethod
    def of(texels: Texels, around: Sequence[Any]) -> Pieces:
        """Take texels and their neighbours (``Neighbors.around``)."""
        position, normal = (np.array(x, np.float64).T for x in (texels.position, texels.normal))
        return Pieces(centred(position), normal, connected(around))

    @cached_property
    def middle(self) -> np.ndarray:
        """(T, 3), the middle of the bounding box of each texel's piece."""
        order = np.argsort(self.piece, kind="stable")
        starts = np.flatnonzero(np.diff(self.piece[order], prepend=-1))
        low, high = (end.reduceat(self.point[order], starts) for end in (np.minimum, np.maximum))
        return np.asarray((low + high)[self.piece] / 2)

    def grouped(self, owner: np.ndarray) -> Pieces:
        """Return groups of texels of one piece each, by the group (T,) that every texel is of."""
        point, normal = (sums(table.T, owner).T for table in (self.point, self.normal))
        first = np.unique(owner, return_index=True)[1]
        size = np.bincount(owner)[:, None]
        return Pieces(point / size, unit_vectors(normal), self.piece[first])

    def apart(self, places: np.ndarray) -> np.ndarray:
        """Return places (T, d) with another column, by which pieces are far from each other."""
        return np.concatenate([places, APART * self.piece[:, None]], axis=1)


def connected(around: Sequence[Any]) -> np.ndarray:
    """Return the connected piece of every texel, (T,) int64, given columns of neighbours."""
    columns = [np.array(column, np.int64) for column in around]
    count = len(columns[0])
    rows = np.tile(np.arange(count), len(columns))
    places = rows, np.concatenate(columns)
    links = scipy.sparse.csr_array((np.ones(len(rows), bool), places), (count, count))
    return np.asarray(scipy.sparse.csgraph.connected_components(links, directed=False)[1], np.int64)


def centred(points: np.ndarray) -> np.ndarray:
    """Return points (T, 3) about the middle of their bounding box, in units of its diagonal."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float(np.linalg.norm(high - low)) or 1.0
    return np.asarray((points - (low + high) / 2) / extent)
