"""Texel graph for filling: positions, pieces, known values and coarser levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.capture.mesh import unit_vectors
from svu_mi.geometry.neighbors import connected_components, group_means, group_sums, texel_squares
from svu_mi.geometry.texels import Texels
from svu_mi.recovery.inpaint.fill_result import LEAST_SD
from svu_mi.recovery.uncertainty.gmrf import GROUPING_LIMIT, Smoother
from svu_mi.recovery.uncertainty.texture_field import TextureField

PIECE_DISTANCE = 1e3  # distance between pieces in feature space, in extents of the object


@dataclass(frozen=True)
class Pieces:
    """Positions, normals and connected pieces of T texels.

    Attributes:
        point: (T, 3) positions relative to the bounding box centre, in units of its diagonal.
        normal: (T, 3) unit normals.
        piece: (T,) int64, index of the connected piece of the surface.
    """

    point: np.ndarray
    normal: np.ndarray
    piece: np.ndarray

    @staticmethod
    def of(texels: Texels, around: Sequence[Any]) -> Pieces:
        """Find connected pieces of the surface from the texels' neighbours ``around``."""
        position, normal = (np.array(x, np.float64).T for x in (texels.position, texels.normal))
        return Pieces(normalized_points(position), normal, connected_components(around))

    @cached_property
    def middle(self) -> np.ndarray:
        """Bounding box centre of each texel's piece, (T, 3)."""
        order = np.argsort(self.piece, kind="stable")
        starts = np.flatnonzero(np.diff(self.piece[order], prepend=-1))
        low, high = (end.reduceat(self.point[order], starts) for end in (np.minimum, np.maximum))
        return np.asarray((low + high)[self.piece] / 2)

    def grouped(self, owner: np.ndarray) -> Pieces:
        """Return means of groups of texels, given the group (T,) of each texel."""
        point, normal = (group_sums(table.T, owner).T for table in (self.point, self.normal))
        first = np.unique(owner, return_index=True)[1]
        size = np.bincount(owner)[:, None]
        return Pieces(point / size, unit_vectors(normal), self.piece[first])

    def separated(self, places: np.ndarray) -> np.ndarray:
        """Append a column to features (T, d) that makes distances between pieces large."""
        return np.concatenate([places, PIECE_DISTANCE * self.piece[:, None]], axis=1)


def normalized_points(points: np.ndarray) -> np.ndarray:
    """Return points (T, 3) relative to their bounding box centre and diagonal."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float(np.linalg.norm(high - low)) or 1.0
    return np.asarray((points - (low + high) / 2) / extent)


MOST_TEXELS = 2**14  # limit for cross-validation, which uses groups of more texels


@dataclass(frozen=True)
class TexelGraph:
    """Graph of T nodes, texels or groups of texels. Some have known values.

    Attributes:
        values: (N, T), mean values of the nodes.
        weights: (N, T), precisions of the values.
        single: (N, T), values of one texel per node, to measure errors of texels, not of means.
        known: (T,) bool, True for known values; others are ignored.
        size: (T,), number of texels per node.
        square: (T, 2) int64, row and column in the map.
        pieces: Positions, normals and pieces of the nodes.
        smoother: Links between the nodes.
    """

    values: np.ndarray
    weights: np.ndarray
    single: np.ndarray
    known: np.ndarray
    size: np.ndarray
    square: np.ndarray
    pieces: Pieces
    smoother: Smoother

    @staticmethod
    def of(field: TextureField, known: np.ndarray) -> TexelGraph:
        """Create the graph of a field's texels."""
        weights = 1 / np.maximum(field.deviation, LEAST_SD) ** 2
        return TexelGraph(
            field.values, weights, field.values, known, np.ones(len(known)),
            texel_squares(field.texels), Pieces.of(field.texels, field.smoother.around),
            field.smoother,
        )  # fmt: skip

    def with_hidden(self, hidden: np.ndarray) -> TexelGraph:
        """Return a copy in which ``hidden`` texels, (T,) bool, are unknown."""
        return replace(self, known=self.known & ~hidden)

    def near(self, nodes: np.ndarray, steps: int) -> np.ndarray:
        """Add to a set of nodes, (T,) bool, those within a number of links."""
        columns = np.stack([np.array(column) for column in self.smoother.around])
        reached, border = nodes.copy(), np.flatnonzero(nodes)
        for _ in range(steps):
            border = np.unique(columns[:, border])
            border = border[~reached[border]]
            reached[border] = True
        return reached

    @property
    def is_large(self) -> bool:
        """True if there are more than MOST_TEXELS nodes, and grouping reduces them."""
        count = len(self.known)
        return count > MOST_TEXELS and len(self.halved[0].known) < GROUPING_LIMIT * count

    @property
    def coarsest(self) -> TexelGraph:
        """First coarser graph that is not large."""
        return self.halved[0].coarsest if self.is_large else self

    @cached_property
    def known_variance(self) -> np.ndarray:
        """Variance of known values, (N, 1): lower limit for predictions."""
        return np.asarray(self.values[:, self.known].var(axis=1, keepdims=True))

    @cached_property
    def halved(self) -> tuple[TexelGraph, np.ndarray]:
        """Graph of 2 x 2 groups (all known or all unknown), and the group (T,) of each node."""
        square, own = self.square // 2, np.arange(len(self.known))
        alike = np.concatenate([square, self.known[:, None]], axis=1)
        columns = [np.array(column, np.int64) for column in self.smoother.around]
        owner = connected_components([
            np.where((alike[column] == alike).all(axis=1), column, own) for column in columns
        ])  # fmt: skip
        first = np.unique(owner, return_index=True)[1]
        values, weights = group_means(self.values, self.weights, owner)
        smoother = self.smoother.halved(owner, weights, values)
        coarse = TexelGraph(
            values, weights, self.single[:, first], self.known[first],
            np.bincount(owner, self.size), square[first], self.pieces.grouped(owner), smoother,
        )  # fmt: skip
        return coarse, owner
