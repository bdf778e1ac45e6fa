"""Texels to fill: positions, connected pieces, known values, and coarser groups."""

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

PIECE_DISTANCE = 1e3  # added distance between pieces, in extents of the object


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
        """Collect texels and their neighbours (``Neighbors.around``)."""
        position, normal = (np.array(x, np.float64).T for x in (texels.position, texels.normal))
        return Pieces(normalized_points(position), normal, connected_components(around))

    @cached_property
    def middle(self) -> np.ndarray:
        """(T, 3), the middle of the bounding box of each texel's piece."""
        order = np.argsort(self.piece, kind="stable")
        starts = np.flatnonzero(np.diff(self.piece[order], prepend=-1))
        low, high = (end.reduceat(self.point[order], starts) for end in (np.minimum, np.maximum))
        return np.asarray((low + high)[self.piece] / 2)

    def grouped(self, owner: np.ndarray) -> Pieces:
        """Return groups of texels of one piece each, by the group (T,) that every texel is of."""
        point, normal = (group_sums(table.T, owner).T for table in (self.point, self.normal))
        first = np.unique(owner, return_index=True)[1]
        size = np.bincount(owner)[:, None]
        return Pieces(point / size, unit_vectors(normal), self.piece[first])

    def separated(self, places: np.ndarray) -> np.ndarray:
        """Return features (T, d + 1) with another column that separates pieces."""
        return np.concatenate([places, PIECE_DISTANCE * self.piece[:, None]], axis=1)


def normalized_points(points: np.ndarray) -> np.ndarray:
    """Return points (T, 3) about the middle of their bounding box, in units of its diagonal."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float(np.linalg.norm(high - low)) or 1.0
    return np.asarray((points - (low + high) / 2) / extent)


MOST_TEXELS = 2**16  # texels for cross-validation: of more, groups of neighbours


@dataclass(frozen=True)
class TexelGraph:
    """T texels, or groups of them, some of which have known values.

    Attributes:
        values: (N, T), of groups their mean.
        weights: (N, T), precisions of these, where they are known.
        single: (N, T), the values of one texel of each group: errors are those of texels, whose
            values differ by more than those of means.
        known: (T,) bool; values of others are ignored.
        size: (T,), number of texels of each.
        square: (T, 2) int64, row and column in the map.
        pieces: where they lie.
        smoother: the links between them.
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
        """Collect the texels of a field, with those ``known``, (T,) bool."""
        weights = 1 / np.maximum(field.deviation, LEAST_SD) ** 2
        square = texel_squares(field.texels)
        pieces = Pieces.of(field.texels, field.smoother.around)
        return TexelGraph(
            field.values, weights, field.values, known, np.ones(len(known)), square, pieces,
            field.smoother,
        )  # fmt: skip

    def with_hidden(self, hidden: np.ndarray) -> TexelGraph:
        """Return a copy in which ``hidden`` texels, (T,) bool, are unknown."""
        return replace(self, known=self.known & ~hidden)

    @property
    def count(self) -> int:
        """T."""
        return len(self.known)

    @property
    def is_large(self) -> bool:
        """Whether there are too many texels and fewer groups (not if known ones are scattered)."""
        return self.count > MOST_TEXELS and self.halved[0].count < GROUPING_LIMIT * self.count

    @property
    def coarsest(self) -> TexelGraph:
        """Coarser groups, repeatedly, until there are not too many."""
        return self.halved[0].coarsest if self.is_large else self

    @cached_property
    def halved(self) -> tuple[TexelGraph, np.ndarray]:
        """Groups of 2 x 2 neighbours, all known or none, and the group (T,) of each texel."""
        square, own = self.square // 2, np.arange(self.count)
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
